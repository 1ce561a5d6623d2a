"""The next poses to record on the arm, from the samples had so far."""

from pathlib import Path
from typing import TYPE_CHECKING

from iksamples.answer.adaptive import GUIDES, train_seeds
from iksamples.answer.proposal import Strategy, disagreement_mm, finite, largest_error_mm, propose
from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd


def next_poses(
    study: Study,
    task: Task,
    samples: SampleSet,
    k: int,
    strategy: Strategy = "disagreement",
    weights: Path | None = None,
    progress: bool = False,
) -> "pd.DataFrame":
    """The next poses to record, most wanted first.

    Args:
        study: The study.
        task: Its task.
        samples: What is recorded so far (``recorded.learn.read_samples``).
        k: How many poses.
        strategy: What makes a pose worth recording; see ``propose``.
        weights: Networks trained on these samples; None: 16 seeds are trained as the study says.
        progress: Report the training on stderr.

    Returns:
        The inputs' columns, such as x_mm; the joints', such as q_elbow_rad (the study's branch of
        the inverse kinematics, as a first guess for the arm); disagreement_mm
        (how far apart the seeds send the arm there) and error_mm (the largest position error of a
        seed there, by the arm's model). All poses are inside the workspace and the joint limits.

    Raises:
        IksamplesError: The weights cannot be read or are another arm's, or simulated arms'; or as
            ``propose``.
    """
    import pandas as pd

    if weights is not None and study.arm:
        raise IksamplesError(
            f"{study.name}: its networks learnt simulated arms, no two alike, so what they "
            "disagree about is no pose to record. Leave out --weights."
        )
    if weights is None:
        few = study.training.model_copy(update={"seeds": GUIDES, "snapshots": 2})
        network = train_seeds(study.model_copy(update={"training": few}), samples, progress)
    else:
        network = _load(weights, task)
    positions = propose(task, samples, network, k, strategy)
    joints = task.reach(positions).joints
    network = finite(network)
    columns: dict[str, Floats] = dict(zip(task.x.columns(), positions.T, strict=True))
    columns |= dict(zip(task.q.columns("q_"), joints.T, strict=True))
    columns["disagreement_mm"] = disagreement_mm(network, task.drawing, positions)
    columns["error_mm"] = largest_error_mm(network, task, positions)
    return pd.DataFrame(columns)


def _load(weights: Path, task: Task) -> StackedMLP:
    network = StackedMLP.load(weights)
    found = (network.weights[0].shape[1], network.biases[-1].shape[-1])
    if found != (len(task.x), len(task.q)):
        raise IksamplesError(
            f"{weights}: networks from {found[0]} inputs to {found[1]} joints, but the study's arm "
            f"has {len(task.q)} joints. Name the weights trained for this study."
        )
    return network
