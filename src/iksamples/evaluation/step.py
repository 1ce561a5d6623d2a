"""The evaluation step: a method on one set of samples, asked everywhere."""

from pathlib import Path
from typing import TYPE_CHECKING

from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.methods.predictor import NotApplicableError, Predictor
from iksamples.methods.registry import KINDS, fit_each
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd


def evaluate(
    study: Study, task: Task, samples: SampleSet, method: str, folder: Path
) -> "tuple[dict[str, pd.DataFrame], str | None]":
    """Measures a method's errors along the paths and over the workspace.

    Args:
        study: The study.
        task: Its task.
        samples: What the method learnt from, or is fitted to now if it is no network.
        method: Name of the method.
        folder: Where a network's weights are.

    Returns:
        A table for each of ``TABLES``, and None; or empty tables and why the method cannot use
        these samples.
    """
    import pandas as pd

    own = study.all_methods[method]
    try:
        predictor: Predictor = (
            StackedMLP.load(folder / "weights.safetensors")
            if not KINDS[own.kind].fit
            else fit_each(own.kind, task, samples, own.training.all_seeds)
        )
    except NotApplicableError as reason:
        empty = {
            "waypoints": pd.DataFrame({"path": [], "seed": [], "error_mm": []}),
            "cube": pd.DataFrame({"point": [], "seed": [], "error_mm": []}),
        }
        return {**empty, "errors": summarise(**empty)}, str(reason)
    waypoints = track_paths(study.evaluation, task, predictor)
    cube = cube_errors(study.evaluation, task, predictor)
    return {"waypoints": waypoints, "cube": cube, "errors": summarise(waypoints, cube)}, None
