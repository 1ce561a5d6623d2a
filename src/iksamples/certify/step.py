"""The certification step: a proved worst case and mean for every network, checked independently."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.certify.checker import Claim, verify
from iksamples.certify.lookup import certify_table
from iksamples.certify.mean import certify_mean
from iksamples.certify.residual import Comparison
from iksamples.certify.search import certify_stack
from iksamples.columns import certificate_columns
from iksamples.methods.predictor import NotApplicableError
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd


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
    if task.x.names != ("x", "y", "z"):
        return _table([], samples)  # cells of tables are bounded for three positions alone
    try:
        return certify_multilinear(study, task, method, samples)
    except NotApplicableError:
        return _table([], samples)


def certify_networks(
    study: Study, task: Task, method: str, samples: SampleSet, network: StackedMLP
) -> "pd.DataFrame":
    """Certifies every network of a stack over the study's workspace.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method, for the table.
        samples: What the networks learnt from; the search starts at these points.
        network: The networks. One that is not finite gets no row.

    Returns:
        One row per seed, columns as in ``columns.CERTIFICATES``.
    """
    compare = compared(task)
    sound = network.select(network.finite_rows())
    certificates = certify_stack(
        sound,
        task.arm,
        samples.region,
        rtol=study.bounds.sup_rtol,
        seeds_mm=samples.positions_mm,
        keep_leaves=True,
        compare=compare,
    )
    rows = []
    for row, certificate in enumerate(certificates):
        claim = Claim(
            sound,
            row,
            task.arm,
            samples.region,
            certificate.upper,
            certificate.lower,
            certificate.argmax,
            compare,
        )
        proof = verify(claim, certificate.leaves)
        # The checker's own bound holds also where it cannot prove the search's: rounding differs.
        proved = bool(proof.upper < np.inf)
        mean = certify_mean(
            sound,
            row,
            task.arm,
            samples.region,
            rtol=study.bounds.mean_rtol,
            atol_mm=study.bounds.mean_atol_mm,
            compare=compare,
        )
        rows.append(
            {
                **_key(method, samples, sound.seeds[row]),
                "sup_lower_mm": min(certificate.lower, proof.lower),
                "sup_upper_mm": max(certificate.upper, proof.upper) if proved else np.nan,
                **_argmax(samples, certificate.argmax),
                "mean_lower_mm": mean.lower_mm,
                "mean_upper_mm": mean.upper_mm,
                "boxes": certificate.boxes,
                "seconds": certificate.seconds,
                "complete": certificate.complete,
                "verified": proved,
            }
        )
    return _table(rows, samples)


def compared(task: Task) -> Comparison:
    """The tool's coordinates that are to equal inputs: the positions among these."""
    positions = task.target.positions
    return Comparison(positions, tuple(range(len(positions))))


def certify_multilinear(
    study: Study, task: Task, method: str, samples: SampleSet
) -> "pd.DataFrame":
    """Certifies the table look-up of a full grid: one row, of seed 0, not checked independently.

    Args:
        study: The study.
        task: Its task.
        method: Name of the method, for the table.
        samples: The grid.
    """
    certificate = certify_table(study, task.arm, samples, rtol=study.bounds.sup_rtol)
    row = {
        **_key(method, samples, 0),
        "sup_lower_mm": certificate.lower_mm,
        "sup_upper_mm": certificate.upper_mm,
        **_argmax(samples, certificate.argmax_mm),
        "mean_lower_mm": np.nan,
        "mean_upper_mm": np.nan,
        "boxes": certificate.boxes,
        "seconds": certificate.seconds,
        "complete": certificate.complete,
        "verified": False,
    }
    return _table([row], samples)


def _table(rows: list[dict[str, object]], samples: SampleSet) -> "pd.DataFrame":
    import pandas as pd

    return pd.DataFrame(rows, columns=certificate_columns(samples.space.columns()))


def _argmax(samples: SampleSet, x: Floats) -> dict[str, object]:
    return dict(zip(samples.space.columns("argmax_"), x.tolist(), strict=True))


def _key(method: str, samples: SampleSet, seed: int) -> dict[str, object]:
    return {
        "method": method,
        "label": samples.label,
        "samples_per_axis": samples.points_per_axis,
        "n_samples": samples.n_samples,
        "seed": seed,
    }
