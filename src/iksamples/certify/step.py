"""The certification step: a proved worst case and mean for every network, checked independently."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.certify.checker import Claim, verify
from iksamples.certify.compared import Measure
from iksamples.certify.mean import MeanError, certify_mean
from iksamples.certify.printing import degrees_down, degrees_up
from iksamples.certify.search import Certificate, certify_stack
from iksamples.certify.table import Table
from iksamples.columns import certificate_columns
from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.tensor import tensor_grid
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd


MOST_INPUTS_OF_A_MEAN = 4
"""A mean is enclosed cell by cell, and in six inputs a million cells leave it a factor of 2.5."""


def certify(
    study: Study, task: Task, method: str, samples: SampleSet, folder: Path
) -> "pd.DataFrame":
    """Certifies a method on one set of samples.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method.
        samples: What it learnt from.
        folder: Where a network's weights are.

    Returns:
        As ``certify_networks``; no row where a table of samples that form no full grid is asked
        for.
    """
    if study.all_methods[method].kind == "network":
        network = StackedMLP.load(folder / "weights.safetensors")
        return certify_networks(study, task, method, samples, network)
    arms = study.all_methods[method].training.all_seeds if samples.arms else (0,)
    rows = []
    for seed in arms:
        try:
            grid = tensor_grid(samples.of(seed), method)
        except NotApplicableError:
            break
        table = Table(grid.axes, grid.joints)
        rows += _rows(study, task, method, samples, table, (seed,))
    return _table(rows, samples, task)


def certify_networks(
    study: Study, task: Task, method: str, samples: SampleSet, network: StackedMLP
) -> "pd.DataFrame":
    """Certifies every network of a stack over the study's region.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method, for the table.
        samples: What the networks learnt from; the search starts at these points.
        network: The networks. One that is not finite gets no row.

    Returns:
        One row per seed, columns as in ``columns.CERTIFICATES``. A bound that the checker does not
        prove is missing.
    """
    sound = network.select(network.finite_rows())
    stacks = [sound]
    if samples.arms:  # each on its own arm
        stacks = [sound.select([row]) for row in range(sound.n_seeds)]
    rows = [row for one in stacks for row in _rows(study, task, method, samples, one, one.seeds)]
    return _table(rows, samples, task)


def _rows(
    study: Study,
    task: Task,
    method: str,
    samples: SampleSet,
    answers: StackedMLP | Table,
    seeds: tuple[int, ...],
) -> list[dict[str, object]]:
    """A row per network, or for a look-up table; all of one arm."""
    if not seeds:
        return []
    chain = task.chain_of(seeds[0])
    positions = _proved(study, task, chain, samples, answers, "position")
    angles = _proved(study, task, chain, samples, answers, "angle") if task.turns else None
    rows = []
    for row, (certificate, lower, upper) in enumerate(positions):
        mean = _mean(study, task, chain, answers, row)
        bounds: dict[str, object] = {"sup_lower_mm": lower, "sup_upper_mm": upper}
        boxes, seconds, done = certificate.boxes, certificate.seconds, certificate.complete
        verified = bool(np.isfinite(upper))
        if angles is not None:
            turned, least, most = angles[row]
            bounds |= {"angle_lower_deg": degrees_down(least), "angle_upper_deg": degrees_up(most)}
            boxes, seconds = boxes + turned.boxes, seconds + turned.seconds
            done, verified = done and turned.complete, verified and bool(np.isfinite(most))
        rows.append(
            {
                **_key(method, samples, seeds[row]),
                **bounds,
                **_argmax(samples, certificate.argmax),
                "mean_lower_mm": mean.lower_mm if mean else np.nan,
                "mean_upper_mm": mean.upper_mm if mean else np.nan,
                "boxes": boxes,
                "seconds": seconds,
                "complete": done,
                "verified": verified,
            }
        )
    return rows


def _mean(
    study: Study, task: Task, chain: SerialChain, answers: StackedMLP | Table, row: int
) -> MeanError | None:
    """The mean error, enclosed; None where there are too many inputs for that."""
    if len(task.x) > MOST_INPUTS_OF_A_MEAN:
        return None
    return certify_mean(
        answers,
        row,
        chain,
        task.region,
        rtol=study.bounds.mean_rtol,
        atol_mm=study.bounds.mean_atol_mm,
        target=task.target,
    )


def _proved(
    study: Study,
    task: Task,
    chain: SerialChain,
    samples: SampleSet,
    answers: StackedMLP | Table,
    measure: Measure,
) -> list[tuple[Certificate, float, float]]:
    """Certificates with the bounds that the checker has proved, NaN where it has none."""
    found = certify_stack(
        answers,
        chain,
        samples.region,
        rtol=study.bounds.sup_rtol,
        atol=np.radians(study.bounds.sup_atol_deg) if measure == "angle" else 0.0,
        seeds=samples.x,
        keep_leaves=True,
        target=task.target,
        measure=measure,
    )
    proved = []
    for row, item in enumerate(found):
        claim = Claim(
            answers,
            row,
            chain,
            samples.region,
            item.upper,
            item.lower,
            item.argmax,
            task.target,
            measure,
        )
        proof = verify(claim, item.leaves)
        # The checker's own bound holds also where it cannot prove the search's: rounding differs.
        upper = max(item.upper, proof.upper)
        lower = min(item.lower, proof.lower)
        proved.append((item, lower, upper if np.isfinite(upper) else np.nan))
    return proved


def _table(rows: list[dict[str, object]], samples: SampleSet, task: Task) -> "pd.DataFrame":
    import pandas as pd

    columns = certificate_columns(samples.space.columns(), turns=task.turns)
    return pd.DataFrame(rows, columns=columns)


def _argmax(samples: SampleSet, x: Floats) -> dict[str, object]:
    return dict(zip(samples.space.columns("argmax_"), x.tolist(), strict=True))


def _key(method: str, samples: SampleSet, seed: int) -> dict[str, object]:
    return {
        "method": method,
        "label": samples.label,
        "samples_per_axis": samples.points_per_axis,
        "n_samples": samples.n_samples,
        "seed": seed,
        "region_share": samples.region_share,
    }
