"""The certification step: a proved worst case and mean for every network, checked independently."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import SerialChain
from iksamples.certify.checker import Claim, verify
from iksamples.certify.lookup import certify_table
from iksamples.certify.mean import certify_mean
from iksamples.certify.search import certify_stack
from iksamples.columns import CERTIFICATES
from iksamples.methods.predictor import NotApplicableError
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd


def certify(
    study: Study, chain: SerialChain, method: str, samples: SampleSet, folder: Path
) -> "pd.DataFrame":
    """Certifies a method on one set of samples.

    Args:
        study: The study.
        chain: Its arm.
        method: Name of the method.
        samples: What it learnt from.
        folder: Where a network's weights are.

    Returns:
        As ``certify_networks``; no row where a table of samples that form no full grid is asked
        for.
    """
    if study.all_methods[method].kind == "network":
        network = StackedMLP.load(folder / "weights.safetensors")
        return certify_networks(study, chain, method, samples, network)
    try:
        return certify_multilinear(study, chain, method, samples)
    except NotApplicableError:
        return _table([])


def certify_networks(
    study: Study, chain: SerialChain, method: str, samples: SampleSet, network: StackedMLP
) -> "pd.DataFrame":
    """Certifies every network of a stack over the study's workspace.

    Args:
        study: The study.
        chain: Its arm.
        method: Name of the method, for the table.
        samples: What the networks learnt from; the search starts at these points.
        network: The networks. One that is not finite gets no row.

    Returns:
        One row per seed, columns as in ``columns.CERTIFICATES``.
    """
    sound = network.select(network.finite_rows())
    certificates = certify_stack(
        sound,
        chain,
        samples.region,
        rtol=study.bounds.sup_rtol,
        seeds_mm=samples.positions_mm,
        keep_leaves=True,
    )
    rows = []
    for row, certificate in enumerate(certificates):
        claim = Claim(
            sound,
            row,
            chain,
            samples.region,
            certificate.upper,
            certificate.lower,
            certificate.argmax,
        )
        proof = verify(claim, certificate.leaves)
        # The checker's own bound holds also where it cannot prove the search's: rounding differs.
        proved = bool(proof.upper < np.inf)
        mean = certify_mean(
            sound,
            row,
            chain,
            samples.region,
            rtol=study.bounds.mean_rtol,
            atol_mm=study.bounds.mean_atol_mm,
        )
        rows.append(
            {
                **_key(method, samples, sound.seeds[row]),
                "sup_lower_mm": min(certificate.lower, proof.lower),
                "sup_upper_mm": max(certificate.upper, proof.upper) if proved else np.nan,
                **dict(zip(_ARGMAX, certificate.argmax, strict=True)),
                "mean_lower_mm": mean.lower_mm,
                "mean_upper_mm": mean.upper_mm,
                "boxes": certificate.boxes,
                "seconds": certificate.seconds,
                "complete": certificate.complete,
                "verified": proved,
            }
        )
    return _table(rows)


def certify_multilinear(
    study: Study, chain: SerialChain, method: str, samples: SampleSet
) -> "pd.DataFrame":
    """Certifies the table look-up of a full grid: one row, of seed 0, not checked independently.

    Args:
        study: The study.
        chain: Its arm.
        method: Name of the method, for the table.
        samples: The grid.
    """
    certificate = certify_table(study, chain, samples, rtol=study.bounds.sup_rtol)
    row = {
        **_key(method, samples, 0),
        "sup_lower_mm": certificate.lower_mm,
        "sup_upper_mm": certificate.upper_mm,
        **dict(zip(_ARGMAX, certificate.argmax_mm, strict=True)),
        "mean_lower_mm": np.nan,
        "mean_upper_mm": np.nan,
        "boxes": certificate.boxes,
        "seconds": certificate.seconds,
        "complete": certificate.complete,
        "verified": False,
    }
    return _table([row])


def _table(rows: list[dict[str, object]]) -> "pd.DataFrame":
    import pandas as pd

    return pd.DataFrame(rows, columns=list(CERTIFICATES))


_ARGMAX = ("argmax_x_mm", "argmax_y_mm", "argmax_z_mm")


def _key(method: str, samples: SampleSet, seed: int) -> dict[str, object]:
    return {
        "method": method,
        "label": samples.label,
        "samples_per_axis": samples.points_per_axis,
        "n_samples": samples.n_samples,
        "seed": seed,
    }
