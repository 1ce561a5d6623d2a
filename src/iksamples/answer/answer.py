"""The answer: what ``answer.json`` holds, and what is read out of it.

The file is for other programs too, so its layout has a version; ``Answer.model_json_schema()``
describes it.
Lengths are in millimetres, shares lie between 0 and 1, and null stands for what is not known.
"""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from iksamples.errors import IksamplesError
from iksamples.files import checked
from iksamples.stats import Interval, Number
from iksamples.study import Study, Tolerance
from iksamples.text import several


VERSION = 2
"""Version of the file's layout; a field that is added does not change it."""

FILE = "answer.json"

Status = Literal["answered", "extrapolated", "more-seeds", "open"]


class Part(BaseModel):
    """A part of the answer."""

    model_config = ConfigDict(frozen=True)


class Size(Part):
    """One number of samples of one variant, held against the tolerance."""

    label: str = Field(description="Name of the set of samples.")
    n_samples: int = Field(description="Samples.")
    n_seeds: int = Field(description="Trainings; 1 for a method without chance.")
    n_points: int = Field(description="Points at which an error that is not proved is measured.")
    n_met: int = Field(description="Trainings that meet the tolerance.")
    n_undecided: int = Field(
        description="Trainings counted as failed though it is not proved that they fail: the "
        "tolerance lies between what they attain and their proved bound."
    )
    n_certified: int = Field(description="Trainings whose error is a proved bound.")
    success_rate: float = Field(description="How often the best of `best_of` trainings meets it.")
    success_rate_lcb: float | None = Field(
        description="One-sided Clopper-Pearson lower bound of that at `confidence.each`; null: "
        "nothing is left to chance."
    )
    meets: bool = Field(description="Whether that reaches `success_share`.")
    tolerance_bound_mm: Number = Field(
        description="Smallest tolerance that would be met at that share and confidence [mm]; null: "
        "too few trainings for any, or too many failed."
    )
    error_best_mm: Number = Field(description="Smallest error of a training [mm].")
    error_median_mm: Number = Field(description="Median over trainings [mm].")
    error_worst_mm: Number = Field(
        description="Largest error of a training [mm]; null: one failed."
    )
    n_failed: int = Field(
        0, description="Trainings without a result, which count as not meeting the tolerance."
    )
    why: str = Field("", description="Why, for most of them; empty: all have a result.")

    @property
    def certified(self) -> bool:
        """Whether the error of every training is a proved bound."""
        return self.n_certified == self.n_seeds


class Extrapolation(Part):
    """What the learning curve says beyond the sizes tried."""

    n_samples: int | None = Field(description="Samples to take; null: not to be said.")
    needed: Interval | None = Field(
        description="Samples at which the curves meet the tolerance, from the fewest to the most "
        "that any of them says; null: not to be said."
    )
    record_next: int = Field(description="The size to record next, to see more of the curve.")
    reason: str = Field(description="Why no number is given; empty: one is.")


class Curve(Part):
    """Whether a learning curve falls, and falls ever more slowly, as most do."""

    monotone: bool = Field(description="No size has a larger error than a smaller one.")
    convex: bool = Field(description="It falls ever more slowly with the samples.")


class Diagnosis(Part):
    """Why a method fails, as far as the study's own data show it."""

    kind: Literal["fit", "training", "capacity", "samples-suffice"] = Field(
        description="fit: it misses at its own samples; training: the same network trained "
        "otherwise or longer is better; capacity: another network trained alike is better; "
        "samples-suffice: something else does it with these samples."
    )
    text: str = Field(description="The evidence, in a sentence.")


class VariantAnswer(Part):
    """The answer for one method on samples placed by one design."""

    method: str = Field(description="Name in the study.")
    design: str = Field(description="How the samples are placed.")
    kind: str = Field(description="Kind of method.")
    description: str = Field(description="What it is, in words.")
    status: Status = Field(
        description="answered: a size tried does it; extrapolated: the learning curve says how "
        "many would; more-seeds: too few trainings to tell; open: more than the most tried, and "
        "the curve does not say how many."
    )
    n_samples: int | None = Field(description="The answer: samples; null: none.")
    sizes: list[Size] = Field(description="Every number of samples, fewest first.")
    seeds_needed: int | None = Field(
        description="Trainings that would settle it at the share seen; null: not the problem."
    )
    curve: Curve | None = Field(description="Its learning curve; null: fewer than three sizes.")
    extrapolation: Extrapolation | None = Field(description="Null: no need.")
    diagnosis: list[Diagnosis] = Field(description="Why it fails, where the data show it.")
    sentences: list[str] = Field(description="The same in plain English.")

    @property
    def found(self) -> Size | None:
        """The size that is the answer."""
        found = self.n_samples if self.status == "answered" else None
        return next((size for size in self.sizes if size.n_samples == found), None)

    @property
    def shown(self) -> Size:
        """The size to speak of: the answer, or else the most samples tried."""
        return self.found or self.sizes[-1]

    @property
    def smaller(self) -> Size | None:
        """The size below the answer."""
        position = self.sizes.index(self.found) if self.found else 0
        return self.sizes[position - 1] if position else None


class Comparison(Part):
    """A method's error over another's at equal numbers of samples, paired by seed."""

    method: str = Field(description="The method.")
    design: str = Field(description="Its samples.")
    other: str = Field(description="The method it is compared with.")
    other_design: str = Field(description="That one's samples.")
    n_samples: int = Field(description="Samples.")
    n_pairs: int = Field(description="Seeds both have.")
    ratio: Interval = Field(description="Median of the error over the other's.")
    better: float = Field(description="Share of the seeds with the smaller error.")


class Confidence(Part):
    """How the confidence asked for is shared, so that all answers hold together."""

    together: float = Field(description="Confidence that every answer of the study holds.")
    n_variants: int = Field(description="Variants that share it: those left to chance.")
    each: float = Field(description="Confidence at which each size of each of them is judged.")


class Floor(Part):
    """What the arms leave of the error of their own inverse: no samples can do better."""

    error_median_mm: Number = Field(description="Median over the arms [mm].")
    error_worst_mm: Number = Field(description="Of the worst arm [mm].")
    n_arms: int = Field(description="Simulated arms.")
    sentence: str = Field(description="The same in plain English.")


class Answer(Part):
    """How many samples a study's tolerance takes, method by method."""

    version: int = Field(description="Version of this layout.")
    study: str = Field(description="Name of the study.")
    digest: str = Field(description="Digest of the study's settings.")
    tolerance: Tolerance = Field(description="What is required, as in the study.")
    confidence: Confidence = Field(description="How sure, of all answers together.")
    n_points: int = Field(description="Points at which errors that are not certified are measured.")
    sizes: list[int] = Field(description="Numbers of samples tried.")
    region_share: float = Field(
        description="Share of the workspace that the arm can use: everything is over this part."
    )
    floor: Floor | None = Field(
        None, description="What no samples can beat; null: the arm is its drawing."
    )
    headline: str = Field(description="The answer in one sentence.")
    failures: list[str] = Field(
        [],
        description="How many combinations of method and samples have a result; then those that "
        "have none, or not of every training, and why. Empty: all have.",
    )
    variants: list[VariantAnswer] = Field(
        description="Every method on every design, in the study's order."
    )
    comparisons: list[Comparison] = Field(
        description="Every method against the study's own network on the same samples, and that "
        "network on every design against it on the first."
    )

    def variant(self, method: str, design: str | None = None) -> VariantAnswer:
        """One variant's answer.

        Args:
            method: The method.
            design: How its samples are placed; None: the study's first design.

        Raises:
            IksamplesError: There is none.
        """
        for one in self.variants:
            if one.method == method and design in (None, one.design):
                return one
        names = ", ".join(f"{one.method} on {one.design}" for one in self.variants)
        asked = f"'{method}' on {design}" if design else f"'{method}'"
        raise IksamplesError(f"{self.study}: no method {asked}; there are {names}.")

    def to_json(self) -> str:
        """The text of ``answer.json``."""
        return self.model_dump_json(indent=2) + "\n"


def read_answer(results: str | Path, study: Study | None = None) -> Answer:
    """Reads the answer of a finished study.

    Args:
        results: The study's results folder, such as ``results/paper``.
        study: The study; None: whichever it is of.

    Raises:
        IksamplesError: The study is not finished, or the file is of another version or run.
    """
    path = Path(results) / FILE
    try:
        text = checked(path).read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise IksamplesError(_unfinished(Path(results))) from None
    except (OSError, UnicodeDecodeError) as error:
        raise IksamplesError(f"{path}: cannot be read ({error}).") from None
    try:
        answer = Answer.model_validate_json(text)
    except ValidationError as error:
        raise IksamplesError(
            f"{path}: not an answer of this version ({first_fault(error)}). Run the study again."
        ) from None
    if answer.version != VERSION:
        raise IksamplesError(
            f"{path}: layout version {answer.version}, this iksamples reads {VERSION}. Run the "
            "study again."
        )
    if study:
        # Not above: `recommend` reads this file alone, and samples and methods take time to import.
        from iksamples.results import own_cells

        own_cells(
            study, path, {(one.method, s.label) for one in answer.variants for s in one.sizes}
        )
    return answer


def first_fault(error: ValidationError) -> str:
    """Where a file is not as its model has it, and why."""
    first = error.errors()[0]
    return f"{'.'.join(str(part) for part in first['loc']) or 'the file'}: {first['msg']}"


def newest(folder: str | Path) -> Path:
    """The results folder of the study that was answered last.

    Args:
        folder: Holds a folder for each study, such as ``results``.

    Raises:
        IksamplesError: No study there is finished.
    """
    answers = list(Path(folder).glob(f"*/{FILE}"))
    if not answers:
        raise IksamplesError(
            f"{folder}: no finished study. Run one to its end with snakemake --cores 2, or name "
            "another results folder with --results."
        )
    return max(answers, key=lambda file: (file.stat().st_mtime, file)).parent


def recommend(results: str | Path) -> str:
    """What a finished study recommends, in plain English, from its ``answer.json`` alone.

    Args:
        results: The study's results folder, such as ``results/paper``.

    Raises:
        IksamplesError: The study is not finished.
    """
    answer = read_answer(results)
    blocks = [answer.floor.sentence] if answer.floor else []
    blocks.append("\n".join([answer.headline, *answer.failures]))
    for one in answer.variants:
        lines = [
            f"{one.method}, {one.design}: {one.description}",
            *(f"  {text}" for text in one.sentences),
        ]
        blocks.append("\n".join(lines))
    curves = [one.curve for one in answer.variants if one.curve]
    rising = sum(not curve.monotone for curve in curves)
    bent = sum(curve.monotone and not curve.convex for curve in curves)
    if curves:
        blocks.append(
            f"Of {several(len(curves), 'learning curve')}, with a larger error at more samples "
            f"somewhere: {rising}; falling all the way but by fits and starts (not convex): "
            f"{bent}. What such a curve does beyond the sizes tried is not foretold."
            if rising + bent
            else "Every learning curve falls from size to size, and ever more slowly."
        )
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
