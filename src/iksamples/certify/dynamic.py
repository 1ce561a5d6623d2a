"""The certified worst case along the training: what the paper leaves as future work."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.lipschitz import certify_lipschitz
from iksamples.certify.search import certify_stack
from iksamples.network import StackedMLP, read_tensors


if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def read_snapshots(path: str | Path) -> tuple[StackedMLP, Ints]:
    """Reads the weights kept along a training as one stack, epoch after epoch.

    Args:
        path: ``snapshots.safetensors`` of a training.

    Returns:
        The networks, seeds fastest; the epochs, shape (epochs,).
    """
    tensors, header = read_tensors(path)
    depths = range(sum(key.endswith(".weight") for key in tensors))
    weights = [tensors[f"layers.{depth}.weight"] for depth in depths]
    biases = [tensors[f"layers.{depth}.bias"] for depth in depths]
    epochs = np.asarray(tensors["epochs"], np.int64)
    stack = StackedMLP(
        tuple(weight.reshape(-1, *weight.shape[2:]) for weight in weights),
        tuple(bias.reshape(-1, *bias.shape[2:]) for bias in biases),
        header["activation"],
        tensors["offset_mm"],
        tensors["scale_mm"],
        tuple(header["seeds"]) * len(epochs),
    )
    return stack, epochs


def certify_training(
    snapshots: StackedMLP,
    epochs: Ints,
    chain: SerialChain,
    samples_mm: ArrayLike,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 0.02,
    lipschitz_rtol: float | None = 0.1,
) -> "pd.DataFrame":
    """Certified worst case, training error and Lip(h - id) for every snapshot of a training.

    All snapshots are searched together, which takes less time than starting each search from the
    leaves of the one before.

    Args:
        snapshots: Networks of ``read_snapshots``.
        epochs: Their epochs, shape (epochs,).
        chain: The arm.
        samples_mm: The training samples [mm], shape (n, 3).
        lower_mm: Lower corner of the workspace [mm], shape (3,).
        upper_mm: Upper corner of the workspace [mm], shape (3,).
        rtol: Tolerance of the worst case.
        lipschitz_rtol: Tolerance of the Lipschitz constant; None leaves it out, as it takes about
            ten times as long.

    Returns:
        One row per epoch and seed whose weights are finite: epoch, seed, sup_lower_mm,
        sup_upper_mm, training_mean_mm, training_max_mm, lipschitz_lower, lipschitz_upper, complete.
        Bounds hold whether complete or not.
    """
    import pandas as pd

    n_seeds = snapshots.n_seeds // len(epochs)
    layers = (*snapshots.weights, *snapshots.biases)
    finite = [k for k in range(snapshots.n_seeds) if all(np.isfinite(a[k]).all() for a in layers)]
    sound = snapshots.select(finite)
    samples = np.asarray(samples_mm, float)
    certificates = certify_stack(sound, chain, lower_mm, upper_mm, rtol=rtol, seeds_mm=samples)
    errors = np.linalg.norm(chain.forward_mm(sound.predict(samples)) - samples, axis=-1)
    columns: dict[str, object] = {
        "epoch": np.repeat(epochs, n_seeds)[finite],
        "seed": np.array(sound.seeds),
        "sup_lower_mm": [c.lower_mm for c in certificates],
        "sup_upper_mm": [c.upper_mm for c in certificates],
        "training_mean_mm": errors.mean(axis=1),
        "training_max_mm": errors.max(axis=1),
    }
    complete = np.array([c.complete for c in certificates])
    if lipschitz_rtol is not None:
        # Few boxes: untrained networks have all kinks in one point, where no search gets sharp.
        constants = certify_lipschitz(
            sound, chain, lower_mm, upper_mm, rtol=lipschitz_rtol, max_boxes=4000
        )
        columns["lipschitz_lower"] = [c.lower for c in constants]
        columns["lipschitz_upper"] = [c.upper for c in constants]
        complete &= np.array([c.complete for c in constants])
    return pd.DataFrame({**columns, "complete": complete})
