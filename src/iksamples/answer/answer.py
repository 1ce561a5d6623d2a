"""The answer: what ``answer.json`` holds, and what is read out of it.

The file is for other programs too, so its layout has a version; ``answer_schema`` describes it.
Lengths are in millimetres, shares lie between 0 and 1, and null stands for what is not known.
"""

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from iksamples.errors import IksamplesError
from iksamples.study import Tolerance


VERSION = 1
"""Version of the file's layout; a field that is added does not change it."""

FILE = "answer.json"

Status = Literal["answered", "extrapolated", "unreachable", "more-seeds", "open"]


class Part(BaseModel):
    """A part of the answer."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Range(Part):
    """An estimate with its 95 % interval."""

    value: float | None = Field(description="The estimate.")
    low: float | None = Field(description="Lower end; null: too few seeds.")
    high: float | None = Field(description="Upper end; null: too few seeds.")


class Rung(Part):
    """One number of samples."""

    label: str = Field(description="Name of the set of samples.")
    n_samples: int = Field(description="Samples.")
    n_seeds: int = Field(description="Trainings; 1 for a method without chance.")
    n_met: int = Field(description="Trainings that meet the tolerance.")
    n_undecided: int = Field(
        description="Trainings counted as failed though it is not proved that they fail: their "
        "certificate stopped with the tolerance between its bounds."
    )
    n_certified: int = Field(description="Trainings whose error is proved.")
    success: float = Field(description="How often the best of `best_of` trainings meets it.")
    success_lower: float | None = Field(
        description="One-sided Clopper-Pearson lower end of that; null: nothing is left to chance."
    )
    meets: bool = Field(description="Whether `success_lower` reaches `success_share`.")
    kept_mm: float | None = Field(
        description="Smallest tolerance that would be met at that share and confidence [mm]; null: "
        "too few trainings for any, or too many diverged."
    )
    error_best_mm: float | None = Field(description="Smallest error of a training [mm].")
    error_median_mm: float | None = Field(description="Median over trainings [mm].")
    error_worst_mm: float | None = Field(
        description="Largest error of a training [mm]; null: one diverged."
    )


class Below(Part):
    """The rung below the answer, and by how much it fails."""

    n_samples: int = Field(description="Samples.")
    short: float | None = Field(
        description="By how much `success_lower` falls short of `success_share`; null: no chance."
    )
    excess_mm: float | None = Field(
        description="By how much `kept_mm` exceeds the tolerance [mm]; null: not known."
    )


class HeldOut(Part):
    """The largest rung, predicted from the smaller ones."""

    n_samples: int = Field(description="Samples.")
    observed_mm: float = Field(description="Its error [mm].")
    predicted_mm: Range = Field(description="What the curve through the others says [mm].")
    relative_error: float = Field(description="By which share that is too high or too low.")


class LearningCurve(Part):
    """A learning curve fitted to one error for each number of samples."""

    law: Literal["power", "grid"] = Field(
        description="a + b n^(-c), or a + b / (m - 1)^2 for grids of m points per axis."
    )
    n_samples: list[int] = Field(description="Numbers of samples fitted.")
    observed_mm: list[float] = Field(description="The errors fitted [mm].")
    floor_mm: Range = Field(description="a [mm].")
    scale_mm: Range = Field(description="b [mm].")
    exponent: Range = Field(description="c; 2, in m - 1, for the grid law.")
    unidentified: str = Field(description="Why a, b and c cannot be told; empty: they can.")
    held_out: HeldOut | None = Field(description="A test of the curve; null: too few rungs.")


class Extrapolation(Part):
    """What the learning curves say beyond the ladder."""

    curve: LearningCurve | None = Field(
        description="The curve used, of the error that `success_share` of the trainings do not "
        "exceed; null: none."
    )
    n_fit: float | None = Field(description="Where it meets the tolerance; null: nowhere.")
    n_upper: float | None = Field(
        description="Where it does with the confidence asked for; null: nowhere, or no interval."
    )
    reachable: float | None = Field(
        description="Share of the resampled curves that ever come down to the tolerance."
    )
    level_mm: Range | None = Field(
        description="The curve's error at 1000 times the most samples tried [mm]."
    )
    reason: str = Field(description="Why it is not trusted; empty: it is.")


class Cause(Part):
    """Why a method fails, as far as the study's own data show it."""

    kind: Literal["fit", "training", "capacity", "samples-suffice"] = Field(
        description="fit: it misses at its own samples; training: the same network trained "
        "otherwise or longer is better; capacity: another network trained alike is better; "
        "samples-suffice: something else does it with these samples."
    )
    text: str = Field(description="The evidence, in a sentence.")


class MethodAnswer(Part):
    """The answer for one method on samples placed by one design."""

    method: str = Field(description="Name in the study.")
    design: str = Field(description="How the samples are placed.")
    kind: str = Field(description="Kind of method.")
    description: str = Field(description="What it is, in words.")
    status: Status = Field(
        description="answered: a number of samples tried does it; extrapolated: the curve says "
        "how many would; unreachable: its floor is above the tolerance; more-seeds: too few "
        "trainings to tell; open: more than the most tried, and the curve does not say how many."
    )
    n_samples: int | None = Field(description="The answer: samples; null: none.")
    more_than: int | None = Field(
        description="Most samples tried, where they were not enough; null: answered."
    )
    certified: bool = Field(
        description="Whether every training at the answer (else at the most samples) is certified."
    )
    kept_mm: float | None = Field(description="`kept_mm` of the answer [mm].")
    rungs: list[Rung] = Field(description="Every number of samples, fewest first.")
    below: Below | None = Field(description="The rung below; null: not answered, or none smaller.")
    not_counted: list[int] = Field(
        description="Numbers of samples that meet it though a larger one does not."
    )
    seeds_needed: int | None = Field(
        description="Trainings that would settle it at the share seen; null: not the problem."
    )
    curves: list[LearningCurve] = Field(
        description="Learning curves of the interquartile mean over trainings, a curve per law."
    )
    extrapolation: Extrapolation | None = Field(description="Beyond the ladder; null: no need.")
    causes: list[Cause] = Field(description="Why it fails, where the data show it.")
    sentences: list[str] = Field(description="The same in plain English.")


class Comparison(Part):
    """A method's error over another's at equal numbers of samples, paired by seed."""

    method: str = Field(description="The method.")
    design: str = Field(description="Its samples.")
    other: str = Field(description="The method it is compared with.")
    other_design: str = Field(description="That one's samples.")
    n_samples: int = Field(description="Samples.")
    n_pairs: int = Field(description="Seeds both have.")
    ratio: Range = Field(description="Median of the error over the other's.")
    better: float = Field(description="Share of the seeds with the smaller error.")


class Answer(Part):
    """How many samples a study's tolerance takes, method by method."""

    version: int = Field(description="Version of this layout.")
    study: str = Field(description="Name of the study.")
    digest: str = Field(description="Digest of the study's settings.")
    tolerance: Tolerance = Field(description="The wish, as in the study.")
    n_points: int = Field(description="Points at which errors that are not certified are measured.")
    ladder: list[int] = Field(description="Numbers of samples tried.")
    headline: str = Field(description="The answer in one sentence.")
    methods: list[MethodAnswer] = Field(
        description="Every method on every design, in the study's order."
    )
    comparisons: list[Comparison] = Field(
        description="Every method against the study's own network on the same samples, and that "
        "network on every design against it on the first."
    )

    def method(self, name: str, design: str | None = None) -> MethodAnswer:
        """One method's answer.

        Args:
            name: The method.
            design: How its samples are placed; None: the study's first design.

        Raises:
            IksamplesError: There is none.
        """
        for one in self.methods:
            if one.method == name and design in (None, one.design):
                return one
        names = ", ".join(f"{one.method} on {one.design}" for one in self.methods)
        asked = f"'{name}' on {design}" if design else f"'{name}'"
        raise IksamplesError(f"{self.study}: no method {asked}; there are {names}.")

    def to_json(self) -> str:
        """The text of ``answer.json``."""
        return self.model_dump_json(indent=2) + "\n"


def answer_schema() -> dict[str, Any]:
    """JSON schema of ``answer.json``."""
    return Answer.model_json_schema()


def read_answer(results: str | Path) -> Answer:
    """Reads the answer of a finished study.

    Args:
        results: The study's results folder, such as ``results/paper``.

    Raises:
        IksamplesError: The study is not finished, or the file is of another version.
    """
    path = Path(results) / FILE
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise IksamplesError(_unfinished(Path(results))) from None
    except (OSError, UnicodeDecodeError) as error:
        raise IksamplesError(f"{path}: cannot be read ({error}).") from None
    try:
        answer = Answer.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise IksamplesError(
            f"{path}: not an answer of this version ({where}: {first['msg']}). Run the study again."
        ) from None
    if answer.version != VERSION:
        raise IksamplesError(
            f"{path}: layout version {answer.version}, this iksamples reads {VERSION}. Run the "
            "study again."
        )
    return answer


def recommend(results: str | Path) -> str:
    """What a finished study recommends, in plain English, from its ``answer.json`` alone.

    Args:
        results: The study's results folder, such as ``results/paper``.

    Raises:
        IksamplesError: The study is not finished.
    """
    answer = read_answer(results)
    blocks = [answer.headline]
    for one in answer.methods:
        lines = [
            f"{one.method}, {one.design}: {one.description}",
            *(f"  {text}" for text in one.sentences),
        ]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _unfinished(results: Path) -> str:
    if not results.is_dir():
        known = sorted(path.parent.name for path in results.parent.glob(f"*/{FILE}"))
        hint = f" Studies with an answer there: {', '.join(known)}." if known else ""
        return f"{results}: there is no such results folder.{hint}"
    return (
        f"{results}: no {FILE} yet, so the study is not finished. Run it to its end with "
        "snakemake --cores 2 --configfile <its study file>."
    )
