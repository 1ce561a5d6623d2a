"""`iksamples next`: which poses to record next, for a network or to calibrate a drawing."""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iksamples.cli.common import (
    Arm,
    Columns,
    Output,
    app,
    arm_settings,
    columns_of,
    open_study,
    refuse_unused,
    say,
)
from iksamples.errors import IksamplesError
from iksamples.files import whole_file


if TYPE_CHECKING:
    import pandas as pd

    from iksamples.answer.proposal import Strategy as ProposalStrategy
    from iksamples.recorded.poses import Calibration

_POSES = 10
_OF_NETWORKS = {"study_file", "samples_file", "output", "count", "strategy", "weights", "column"}


class Strategy(StrEnum):
    """How the next poses are chosen."""

    DISAGREEMENT = "disagreement"
    WORST = "worst"
    CALIBRATION = "calibration"


@app.command("next")
def next_(
    context: typer.Context,
    output: Output,
    study_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[STUDY]", help="Study file (YAML, or the study.json of a run); or --robot."
        ),
    ] = None,
    robot: Arm = None,
    tip_link: Annotated[str | None, typer.Option(help="Link whose origin is measured.")] = None,
    samples_file: Annotated[
        Path | None,
        typer.Option(
            "--samples",
            help="Samples had so far (CSV or Parquet): x_mm, y_mm, z_mm and q_<joint>_rad, or in "
            "other units that the names say, such as x_m and q1_deg. A calibration can begin "
            "without.",
        ),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            "-k",
            min=1,
            max=1000,
            help="How many poses; by default 10 for a network, and for a calibration the fewest "
            "that are expected to be enough.",
        ),
    ] = None,
    strategy: Annotated[
        Strategy | None,
        typer.Option(
            help="Where trained seeds disagree most (the default of a study), where they are "
            "worst, or where it tells most about the drawing's deviations (of --robot)."
        ),
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Networks trained on these samples; by default, train now.")
    ] = None,
    tolerance_mm: Annotated[
        float | None, typer.Option(help="Calibration: worst error allowed [mm].")
    ] = None,
    confidence: Annotated[
        float | None, typer.Option(help="Calibration: how sure that has to be.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="X Y Z X Y Z",
            help="Calibration of --robot: where the tool is used, two corners [mm]; by default "
            "wherever it gets.",
        ),
    ] = None,
    anywhere: Annotated[
        bool, typer.Option(help="Calibration: record outside the workspace as well.")
    ] = False,
    noise_mm: Annotated[
        float | None,
        typer.Option(
            help="Calibration: standard deviation of a measured coordinate [mm]; by default the "
            "study's, or as the samples show."
        ),
    ] = None,
    deviation_mm: Annotated[
        float | None,
        typer.Option(help="Calibration: how far links may be displaced (standard deviation) [mm]."),
    ] = None,
    deviation_rad: Annotated[
        float | None,
        typer.Option(help="Calibration: how far links may be turned (standard deviation) [rad]."),
    ] = None,
    column: Columns = None,
) -> None:
    """Propose the next poses to record on the arm, inside its limits, as CSV; or say to stop.

    Collisions, of the arm with itself or with what stands around it, are not checked.

    Beside each pose for a network: how far apart the trained seeds send the arm there, and the
    largest error of a seed (disagreement_mm, error_mm), both by the arm's model. Poses for a
    calibration stand in the order of the shortest way.
    """
    if (study_file is None) == (robot is None):
        raise IksamplesError(
            "name a study, iksamples next STUDY, or an arm, iksamples next --robot arm.urdf."
        )
    if robot is not None and strategy not in (None, Strategy.CALIBRATION):
        raise IksamplesError(f"--strategy {strategy} asks networks: name the study they are of.")
    if study_file is not None and strategy is not Strategy.CALIBRATION:
        if samples_file is None:
            raise IksamplesError("--samples: name the samples that the networks learn from.")
        refuse_unused(context, context.params.keys() - _OF_NETWORKS, "to networks")
        from iksamples.answer.next_poses import next_poses
        from iksamples.recorded.learn import read_samples

        study, task = open_study(study_file)
        samples, doubts = read_samples(study, task, samples_file, columns_of(column))
        _note(doubts)
        how: ProposalStrategy = "worst" if strategy is Strategy.WORST else "disagreement"
        poses = next_poses(study, task, samples, count or _POSES, how, weights, progress=True)
        _write(poses.round(4), output)
        say(f"{len(poses)} poses written to {output}")
        return
    refuse_unused(context, ["weights"], "to a calibration, which asks no networks")
    if study_file is not None:
        refuse_unused(context, ["tip_link"], "beside a study, which names its own")
    elif box is None:
        refuse_unused(context, ["anywhere"], "without --box: it is anywhere then")
    if samples_file is None:
        refuse_unused(context, ["column"], "without --samples")
    said = {
        "error_mm": tolerance_mm,
        "confidence": confidence,
        "deviation_mm": deviation_mm,
        "deviation_rad": deviation_rad,
        "noise_mm": noise_mm,
    }
    given = {name: value for name, value in said.items() if value is not None}
    question = _question(study_file, arm_settings(robot, tip_link), box, given)
    _for_calibration(question, samples_file, columns_of(column), output, count, anywhere)


def _question(
    study_file: Path | None, robot: dict[str, object], box: Any, given: dict[str, float]
) -> "Calibration":
    """What is asked: a study's question, or that of an arm, with what the options say instead."""
    from dataclasses import replace

    from iksamples.recorded.poses import Calibration
    from iksamples.region import Region
    from iksamples.study import parse_study

    tolerance: dict[str, float] = {
        key: value for key, value in given.items() if key in ("error_mm", "confidence")
    }
    expected = {key: value for key, value in given.items() if key not in tolerance}
    if study_file is None:
        where = "--robot, --tolerance-mm or --confidence"
        study = parse_study({"name": "arm", "tolerance": tolerance, **robot}, where)
        asked = Calibration.of(study, None)
        if box is not None:
            asked = replace(asked, region=Region.box(box[:3], box[3:]))
    else:
        if box is not None:
            raise IksamplesError("--box: the study has a workspace; give one of the two.")
        study, task = open_study(study_file)
        asked = Calibration.of(study, task)
        asked = replace(asked, tolerance=asked.tolerance.model_copy(update=tolerance))
    if not 0.5 < asked.tolerance.confidence < 1 or asked.tolerance.error_mm <= 0:
        raise IksamplesError("--tolerance-mm has to be above 0, --confidence between 0.5 and 1.")
    if expected.get("noise_mm", 0.0) < 0:
        raise IksamplesError("--noise-mm has to be at least 0.")
    prior = replace(
        asked.prior,
        displacement_mm=expected.get("deviation_mm", asked.prior.displacement_mm),
        rotation_rad=expected.get("deviation_rad", asked.prior.rotation_rad),
    )
    return replace(asked, prior=prior, noise_mm=expected.get("noise_mm", asked.noise_mm))


def _for_calibration(
    asked: "Calibration",
    samples_file: Path | None,
    columns: dict[str, str],
    output: Path,
    count: int | None,
    anywhere: bool,
) -> None:
    from iksamples.recorded.poses import in_order
    from iksamples.recorded.read import read_recording

    recording, n = None, 0
    if samples_file is not None:
        recording = read_recording(samples_file, asked.drawing, columns, fewest=1)
        n = len(recording)
        _note(recording.remarks)
    fitted = asked.fitted(recording)
    advice, joints = asked.next_poses(fitted, count, anywhere)
    sure, limit = f"{asked.tolerance.confidence:.0%} confidence", asked.tolerance.error_mm
    if fitted.noise_estimated and fitted.freedom > 0:
        say(f"Noise, as the residuals show it: {fitted.noise_mm:.2g} mm.")
    where = "wherever the tool gets" if asked.region is None else "over the workspace"
    now = (
        "is not known yet"
        if advice.worst_mm == float("inf")
        else f"is at most {advice.worst_mm:.3g} mm with {sure}"
    )
    say(f"After {n} poses the worst error of the fitted drawing {where} {now}.")
    if advice.stop:
        say(f"Stop: it is within {limit:g} mm. Nothing is written.")
        return
    middle = (asked.drawing.lower + asked.drawing.upper) / 2
    start = middle if recording is None else recording.joints[-1]
    _write(in_order(fitted, joints, start).round(6), output)
    then = f"Then it is expected to be at most {advice.expected_mm:.3g} mm."
    if advice.expected_mm == float("inf"):
        then = "They will be too few to tell how well was measured, and so the error (--noise-mm)."
    say(f"Record {len(joints)} more, in the order in which they stand in {output}. {then}")
    if count is None and advice.expected_mm > limit:
        wider = "" if anywhere or asked.region is None else ", or also elsewhere (--anywhere)"
        say(f"That is not within {limit:g} mm yet. To need fewer, measure better{wider}.")


def _note(doubts: Iterable[str]) -> None:
    for line in doubts:
        say(f"Note: {line}", err=True)


def _write(poses: "pd.DataFrame", output: Path) -> None:
    with whole_file(output) as file:
        poses.to_csv(file, index=False)
    typer.echo(
        "Not checked: whether the arm would meet itself or what stands around it, there or on the "
        "way.",
        err=True,
    )
