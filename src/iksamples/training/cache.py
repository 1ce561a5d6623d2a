"""Trained seeds kept by content, so that only what is new is trained.

A folder per key, and in it one file with the seeds that are wanted (more only while a long training
is under way). The key is a digest of all that the numbers depend on, except the seed.
"""

import hashlib
import json
import shutil
from collections.abc import Collection, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from iksamples.files import digest_file, is_intact, kept_file
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.training.record import Record


# What a study may change without changing what any one seed learns.
_IRRELEVANT = {"seeds", "first_seed", "engine"}
# Modules that arrange trainings and keep what they leave, and change no number.
_ARRANGING = {"cache.py", "files.py", "run.py", "step.py"}


def cache_key(study: Study, samples: SampleSet, engine: str) -> str:
    """The name of a training without its seed."""
    parts = {
        "samples": samples.digest(),
        "network": study.network.model_dump(mode="json"),
        "training": study.training.model_dump(mode="json", exclude=_IRRELEVANT),
        "engine": engine,
        "sources": source_digest(),
        "versions": {name: version(name) for name in ("torch", "numpy", "numba")},
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


@cache
def source_digest() -> str:
    """Twelve hexadecimal digits of the source code that trained numbers depend on."""
    content = hashlib.sha256()
    sources = Path(__file__).parent.glob("*.py")
    for path in sorted(path for path in sources if path.name not in _ARRANGING):
        content.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return content.hexdigest()[:12]


class Cache:
    """A folder of trained seeds; without a folder it keeps nothing."""

    def __init__(self, folder: Path | None) -> None:
        """Takes the folder, which need not exist yet."""
        self.folder = folder

    def load(self, key: str, seeds: Collection[int]) -> list[Record]:
        """What is there of the given seeds; a file that is not as it was written is not there."""
        found, missing = [], set(seeds)
        for path in filter(is_intact, self._files(key)):
            record = Record.load(path)
            usable = [int(seed) for seed in record.seeds if int(seed) in missing]
            missing.difference_update(usable)
            if usable:
                found.append(record.select(usable))
        return found

    def add(self, key: str, record: Record) -> None:
        """Keeps a record beside what is there."""
        if self.folder is not None:
            with kept_file(self._path(key, record)) as file:
                record.save(file)

    def settle(self, key: str, record: Record) -> None:
        """Keeps a record instead of what is there."""
        if self.folder is None:
            return
        path = self._path(key, record)
        if not is_intact(path):
            self.add(key, record)
        for other in (self.folder / key).iterdir():
            if other not in (path, digest_file(path)):
                other.unlink(missing_ok=True)

    def prune(self, keys: Collection[str]) -> None:
        """Removes every training that is not among the keys."""
        if self.folder is not None and self.folder.is_dir():
            for entry in self.folder.iterdir():
                if entry.is_dir() and entry.name not in keys:
                    shutil.rmtree(entry, ignore_errors=True)

    def _files(self, key: str) -> Sequence[Path]:
        return sorted((self.folder / key).glob("*.safetensors")) if self.folder else []

    def _path(self, key: str, record: Record) -> Path:
        assert self.folder is not None
        seeds = np.sort(record.seeds)
        digest = hashlib.sha256(seeds.tobytes()).hexdigest()[:8]
        return self.folder / key / f"seeds-{seeds[0]}-{seeds[-1]}-{digest}.safetensors"
