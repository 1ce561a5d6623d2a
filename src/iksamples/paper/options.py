"""What the paper can be read to mean (arXiv 2605.23583): one list of options for each question.

An option quotes the words that it reads, or those that it contradicts. Every question has an option
that contradicts nothing, so that there is a reading to the letter.
"""

from dataclasses import dataclass
from typing import Any, Literal


Standing = Literal["says", "leaves open", "contradicts"]
"""Whether the paper says so, says nothing that decides it, or says something else."""

Corner = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Option:
    """One answer to a question that the paper's text has to answer.

    Attributes:
        name: Short name, which names the option in files too.
        standing: What the paper's words make of it.
        words: The words of the paper that it reads or contradicts.
        where: Section and paragraph of these words.
        value: What it sets: settings of the study, or numbers for ``readings.settings``.
    """

    name: str
    standing: Standing
    words: str
    where: str
    value: Any


def _options(
    words: str, where: str, says: dict[str, Any], contradicts: dict[str, Any]
) -> tuple[Option, ...]:
    """Options that one sentence decides."""
    decided: tuple[tuple[Standing, dict[str, Any]], ...]
    decided = ("says", says), ("contradicts", contradicts)
    return tuple(
        Option(name, standing, words, where, value)
        for standing, values in decided
        for name, value in values.items()
    )


_RANGE = "x₁ ∈ [20, 100] mm, x₂ ∈ [20, 100] mm, x₃ ∈ [−10, 60] mm"
_SPACING = "four samples per DOF (20 mm long sampling resolution)"
_HELD_OUT = "5% was used for both validation and test in training"
_STOPPING = "early stopping is selectively implemented with a patience of 10 epochs"
_RECTANGLES = "the double rectangles are drawn in high and low heights"


def _box(name: str, lower: Corner, standing: Standing) -> Option:
    """A cube of 60 mm, as the paper's spacings imply: most of the range it states is out of reach.

    No cube of this size lies within the joint ranges that the paper states either.
    """
    words = f"{_RANGE}”, “{_SPACING}" if standing == "leaves open" else _RANGE
    upper = tuple(low + 60.0 for low in lower)
    return Option(name, standing, words, "3, first paragraph", (lower, upper))


def _inset(mm: float) -> Option:
    return Option(
        f"rectangles {mm:g} mm inside", "leaves open", _RECTANGLES, "5, Figs. 4 and 5", mm
    )


def _stopping(min_delta_rad2: float) -> dict[str, Any]:
    return {"early_stopping": {"patience": 10, "min_delta_rad2": min_delta_rad2}}


QUESTIONS: dict[str, tuple[Option, ...]] = {
    "workspace": (
        _box("x, y 20 to 80, z 0 to 60", (20.0, 20.0, 0.0), "leaves open"),
        _box("x, y 20 to 80, z −10 to 50", (20.0, 20.0, -10.0), "leaves open"),
        _box("x, y 20 to 80, z −5 to 55", (20.0, 20.0, -5.0), "leaves open"),
        _box("x, y 10 to 70, z 0 to 60", (10.0, 10.0, 0.0), "contradicts"),
        _box("x −30 to 30, y 30 to 90, z 0 to 60", (-30.0, 30.0, 0.0), "contradicts"),
    ),
    "path": (
        *(_inset(mm) for mm in (10.0, 0.0, 5.0, 15.0, 20.0)),
        Option("heart", "leaves open", "heart or rectangular shapes in 3D space", "4", "heart"),
    ),
    "neurons": _options(
        "only 10 hidden neurons are fixed”, “a set of 16 hidden neurons",
        "4, first and third paragraph",
        {"16": [16], "10": [10]},
        {"32": [32], "64": [64], "10-10": [10, 10], "16-16": [16, 16]},
    ),
    "activation": _options(
        "the activation of the hidden and output layer is the ReLU and linear functions",
        "2, Lemma 2",
        {"ReLU": "relu"},
        {"tanh": "tanh"},
    ),
    "epochs": _options("a maximum number of epochs, set to 500", "4", {"500": 500}, {"1000": 1000}),
    "batch": _options(
        "trained in mini-batches of 8 samples", "4", {"8": 8}, {"1": 1, "4": 4, "16": 16, "32": 32}
    ),
    "rate": _options(
        "The learning rate was set to be 0.001",
        "4",
        {"0.001": 0.001},
        {"0.003": 0.003, "0.01": 0.01},
    ),
    "inputs": _options(
        "normalized to the range [0, 1] using a MinMaxScaler",
        "4",
        {"0 to 1": "unit"},
        {"−1 to 1": "symmetric"},
    ),
    "held out": (
        Option("fresh points", "leaves open", _HELD_OUT, "4, first paragraph", "fresh"),
        Option("points of the grid", "leaves open", _HELD_OUT, "4, first paragraph", "grid"),
    ),
    "stopping": (
        Option("never", "leaves open", _STOPPING, "4", {}),
        Option("by 1e−5 rad²", "leaves open", _STOPPING, "4", _stopping(1e-5)),
        Option("by 1e−4 rad²", "leaves open", _STOPPING, "4", _stopping(1e-4)),
    ),
}
"""Every question with its options; the first option of each is how the paper's study here reads
it."""
