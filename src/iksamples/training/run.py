"""The training step: all seeds of every network, and the cache of those that are trained.

The cache is a folder per key, and in it one file with the seeds that are wanted (more only while a
long training is under way). The key is a digest of all that the numbers depend on, except the seed.
"""

import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import nullcontext
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.files import digest_file, is_intact, kept_file
from iksamples.results import networks
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.training.problem import pose_problem
from iksamples.training.record import Record, write_files


LARGE_NETWORK = 100_000
"""Weights from which on 16 networks no longer fit in a core's cache and matrix products win."""

SEEDS_AT_ONCE = 1024
"""Seeds stacked in one fit; a longer list is trained in parts, each kept as soon as it is done."""


def train(
    study: Study,
    samples: SampleSet,
    folder: Path | None,
    cache: Path | None = None,
    progress: bool = False,
    others: Sequence[Path] = (),
) -> None:
    """Trains the study's seeds on a set of samples and writes the results.

    A seed that the cache holds is not trained again; what a seed learns is the same to the last bit
    with and without the cache, alone and among others. At the end the cache holds what this call
    has used and nothing else.

    Args:
        study: The study.
        samples: The samples.
        folder: Gets ``weights.safetensors``, ``snapshots.safetensors``, ``history.parquet`` and
            ``members.parquet``; None: the seeds are only kept in the cache.
        cache: Folder of trained seeds; None: keep none.
        progress: Report on stderr: a bar in a terminal, else a line.
        others: Further caches, which are read and not changed.
    """
    engine = choose_engine(study, len(samples.joint_space))
    key = cache_key(study, samples, engine)
    store, records = Cache(cache, key), list[Record]()
    for place in (cache, *others):
        found = {int(seed) for record in records for seed in record.seeds}
        records += Cache(place, key).load([seed for seed in study.seeds if seed not in found])
    known = {int(seed) for record in records for seed in record.seeds}
    seeds = [seed for seed in study.seeds if seed not in known]
    name, place = samples.label, folder or cache
    if place and place.name == name:  # <method>/<samples>
        name = f"{place.parent.name}/{name}"
    if seeds:
        # Before the clock starts: it takes longer than most trainings.
        import iksamples.training.module  # noqa: F401
    start = time.perf_counter()
    bar = _bar(name, study.training.epochs * len(seeds), progress)
    with bar or nullcontext():
        for first in range(0, len(seeds), SEEDS_AT_ONCE):
            record = _fit(study, samples, seeds[first : first + SEEDS_AT_ONCE], engine, bar)
            store.add(record)
            records.append(record)
    whole = Record.join(records).select(study.seeds)
    store.settle(whole)
    if folder:
        write_files(folder, pose_problem(study, samples, study.seeds), samples, whole)
    if progress and not bar:
        took = f"{time.perf_counter() - start:.1f} s" if seeds else "nothing new"
        kept = f" ({len(known)} from the cache)" if known else ""
        print(
            f"{name}: {samples.n_samples} samples, {len(study.seeds)} seeds{kept}, "
            f"{study.training.epochs} epochs, {took}",
            file=sys.stderr,
        )


def choose_engine(study: Study, n_joints: int) -> str:
    """The engine that trains a study: "fused", "reference" or "levenberg-marquardt".

    Args:
        study: The study.
        n_joints: Joints of its arm.

    Raises:
        IksamplesError: The study asks for the fused engine and for what that cannot do.
    """
    asked, device = study.training.engine, study.training.accelerator
    reason = None
    if study.training.optimizer == "levenberg-marquardt":
        reason = "training.optimizer: levenberg-marquardt"
    elif device == "gpu" or (device == "auto" and _has_gpu()):
        reason = f"training.accelerator: {device}"
    elif os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        reason = "NUMBA_DISABLE_JIT, which leaves it uncompiled"
    if reason and asked == "fused":
        raise IksamplesError(
            f"training.engine: fused cannot do {reason}; set training.engine: auto or reference."
        )
    if study.training.optimizer == "levenberg-marquardt":
        return "levenberg-marquardt"
    large = study.network.n_parameters(len(study.task.inputs), n_joints) > LARGE_NETWORK
    if reason or asked == "reference" or (large and asked == "auto"):
        return "reference"
    return "fused"


def _has_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _fit(study: Study, samples: SampleSet, seeds: Sequence[int], engine: str, bar: Any) -> Record:
    """Trains some seeds; here, not above, torch and Lightning are imported."""
    from iksamples.training.module import EpochBar, fit, make_engine

    problem = pose_problem(study, samples, seeds)
    return fit(
        problem, make_engine(engine, problem), callbacks=[EpochBar(bar, len(seeds))] if bar else []
    )


def _bar(name: str, total: int, progress: bool) -> Any:
    """A bar of epochs, where there is a terminal to draw it on and something to do."""
    if not (progress and total and sys.stderr.isatty()):
        return None
    from tqdm import tqdm

    return tqdm(desc=name, total=total, unit=" epochs", unit_scale=True)


def train_study(
    study: Study,
    sample_sets: Sequence[SampleSet],
    output: Path | None,
    cache: Path | None = None,
    progress: bool = False,
    *,
    seeds: range | None = None,
    others: Sequence[Path] = (),
) -> None:
    """Trains every network of a study on every set of samples, or a part of the seeds.

    Args:
        study: The study.
        sample_sets: The samples.
        output: Gets a folder ``<method>/<samples>`` for each; None: seeds are only kept in the
            cache.
        cache: Folder of trained seeds, one inside it for each of these; None: keep none.
        progress: Report on stderr.
        seeds: Only these; None: all.
        others: Further caches, such as those of jobs that trained a part each.
    """
    for method, samples, own in _trainings(study, sample_sets):
        if seeds:
            some = [seed for seed in own.seeds if seed in seeds]
            if not some:
                continue
            part = {"first_seed": some[0], "seeds": len(some)}
            own = own.model_copy(update={"training": own.training.model_copy(update=part)})
        place = Path(method) / samples.label
        train(
            own,
            samples,
            output / place if output else None,
            cache / place if cache else None,
            progress,
            [other / place for other in others],
        )


def trained_before(study: Study, sample_sets: Sequence[SampleSet], cache: Path) -> dict[str, int]:
    """How many networks of each method the cache holds, so that they are not trained again.

    Args:
        study: The study.
        sample_sets: The samples.
        cache: The cache that ``train_study`` is given.
    """
    found = dict.fromkeys(networks(study), 0)
    for method, samples, own in _trainings(study, sample_sets):
        key = cache_key(own, samples, choose_engine(own, len(samples.joint_space)))
        records = Cache(cache / method / samples.label, key).load(own.seeds)
        found[method] += sum(len(record.seeds) for record in records)
    return found


def _trainings(
    study: Study, sample_sets: Sequence[SampleSet]
) -> Iterator[tuple[str, SampleSet, Study]]:
    """Every method with every set of samples, and the study as if it had that method alone."""
    for method in networks(study):
        training = study.all_methods[method].training
        for samples in sample_sets:
            if samples.design not in study.designs(method):
                continue
            n_trained = training.n_trained(samples.n_samples)
            yield method, samples, study.for_method(method, n_trained)


# What a study may change without changing what any one seed learns.
_IRRELEVANT = {"seeds", "first_seed", "engine"}


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
    # This module arranges trainings and changes no number.
    for path in sorted(path for path in sources if path.name != Path(__file__).name):
        content.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return content.hexdigest()[:12]


class Cache:
    """A folder of trained seeds, and in it the folder of one key; without one it keeps nothing."""

    def __init__(self, root: Path | None, key: str) -> None:
        """Takes the folder, which need not exist yet."""
        self.root, self.folder = root, root / key if root else None

    def load(self, seeds: Collection[int]) -> list[Record]:
        """What is there of the given seeds; a file that is not as it was written is not there."""
        found, missing = [], set(seeds)
        files = sorted(self.folder.glob("*.safetensors")) if self.folder else []
        for path in filter(is_intact, files):
            record = Record.load(path)
            usable = [int(seed) for seed in record.seeds if int(seed) in missing]
            missing.difference_update(usable)
            if usable:
                found.append(record.select(usable))
        return found

    def add(self, record: Record) -> None:
        """Keeps a record beside what is there."""
        if self.folder:
            with kept_file(_file(self.folder, record)) as file:
                record.save(file)

    def settle(self, record: Record) -> None:
        """Keeps a record instead of all that is there."""
        if not (self.root and self.folder):
            return
        path = _file(self.folder, record)
        if not is_intact(path):
            self.add(record)
        for other in self.folder.iterdir():
            if other not in (path, digest_file(path)):
                other.unlink(missing_ok=True)
        for other in self.root.iterdir():
            if other.is_dir() and other != self.folder:
                shutil.rmtree(other, ignore_errors=True)


def _file(folder: Path, record: Record) -> Path:
    seeds = np.sort(record.seeds)
    digest = hashlib.sha256(seeds.tobytes()).hexdigest()[:8]
    return folder / f"seeds-{seeds[0]}-{seeds[-1]}-{digest}.safetensors"
