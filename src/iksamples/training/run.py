"""The training step: all seeds of every grid, and the files it leaves."""

import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from iksamples.errors import IksamplesError
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.training.cache import Cache, cache_key
from iksamples.training.files import write_files
from iksamples.training.problem import pose_problem
from iksamples.training.record import Record


LARGE_NETWORK = 100_000
"""Weights from which on 16 networks no longer fit in a core's cache and matrix products win."""

SEEDS_AT_ONCE = 1024
"""Seeds stacked in one fit; a longer list is trained in parts, each kept as soon as it is done."""


def train(
    study: Study,
    sample_sets: Sequence[SampleSet],
    outputs: Sequence[Path],
    cache: Path | None = None,
    progress: bool = False,
) -> None:
    """Trains the study's seeds on each sample set and writes the results.

    Each output folder gets ``weights.safetensors``, ``snapshots.safetensors``, ``history.parquet``
    and ``members.parquet``. A seed that the cache holds is not trained again; what a seed learns is
    the same to the last bit with and without the cache, alone and among others. At the end the
    cache holds what this call has used and nothing else.

    Args:
        study: The study.
        sample_sets: The samples, one set per grid.
        outputs: The folder of each set.
        cache: Folder of trained seeds; None: keep none.
        progress: Report on stderr: a bar in a terminal, else a line per set.
    """
    engine = choose_engine(study, len(sample_sets[0].joint_space))
    store = Cache(cache)
    keys = [cache_key(study, samples, engine) for samples in sample_sets]
    found = [store.load(key, study.seeds) for key in keys]
    missing = []
    for records in found:
        known = {int(seed) for record in records for seed in record.seeds}
        missing.append([seed for seed in study.seeds if seed not in known])

    if any(missing):
        # Before the clock starts: it takes longer than most trainings.
        import iksamples.training.module  # noqa: F401
    bar = _bar(study.training.epochs * sum(map(len, missing)), progress)
    with bar or nullcontext():
        for samples, folder, key, records, seeds in zip(
            sample_sets, outputs, keys, found, missing, strict=True
        ):
            start = time.perf_counter()
            name = samples.label
            if folder.name == name:  # <method>/<samples>
                name = f"{folder.parent.name}/{name}"
            for first in range(0, len(seeds), SEEDS_AT_ONCE):
                part = seeds[first : first + SEEDS_AT_ONCE]
                if bar:
                    bar.set_description(name)
                record = _fit(study, samples, part, engine, bar)
                store.add(key, record)
                records.append(record)
            whole = Record.join(records).select(study.seeds)
            store.settle(key, whole)
            write_files(folder, pose_problem(study, samples, study.seeds), samples, whole)
            if progress and not bar:
                took = f"{time.perf_counter() - start:.1f} s" if seeds else "nothing new"
                old = len(study.seeds) - len(seeds)
                kept = f" ({old} from the cache)" if old else ""
                print(
                    f"{name}: {samples.n_samples} samples, {len(study.seeds)} seeds{kept},"
                    f" {study.training.epochs} epochs, {took}",
                    file=sys.stderr,
                )
    store.prune(keys)


def count_trained(study: Study, samples: SampleSet, cache: Path) -> int:
    """How many of the study's seeds a cache holds.

    Args:
        study: The study.
        samples: What they are trained on.
        cache: The folder ``train`` is given.
    """
    engine = choose_engine(study, len(samples.joint_space))
    records = Cache(cache).load(cache_key(study, samples, engine), study.seeds)
    return sum(len(record.seeds) for record in records)


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


def _bar(total: int, progress: bool) -> Any:
    """A bar of epochs, where there is a terminal to draw it on and something to do."""
    if not (progress and total and sys.stderr.isatty()):
        return None
    from tqdm import tqdm

    return tqdm(total=total, unit=" epochs", unit_scale=True)
