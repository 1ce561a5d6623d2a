"""The sections on samples: which points, computed or recorded."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from iksamples.study.arm import Expected
from iksamples.study.sections import Section


class Assumed(Expected):
    """What is taken for granted of the arm and of the measurement."""

    deviation_mm: float = Field(
        1.0,
        gt=0,
        le=1000,
        description="Displacement of each link from the drawing, standard deviation along each "
        "axis [mm].",
    )
    deviation_rad: float = Field(
        0.01745,
        gt=0,
        le=1,
        description="Turn of each link, zeros of the joints included, standard deviation about "
        "each axis [rad].",
    )
    noise_mm: float = Field(
        0.1, ge=0, le=1000, description="Noise of a measured position along each axis [mm]."
    )
    noise_rad: float = Field(
        0.001, ge=0, le=1, description="Noise of a measured orientation about each axis [rad]."
    )

    tool_mm: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="Displacement of the tool, where its place on the flange is less certain [mm]; "
        "null: as the links.",
    )


class Recorded(Section):
    """Samples from files: which, and how the learning curve is drawn from them."""

    path: str = Field(
        description="The recording, relative to the working folder: a CSV or Parquet file, or a "
        "folder (docs/recorded.md)."
    )
    source: str = Field(
        "", description="Where the recording can be had; said where it is not there."
    )
    kind: Literal["table", "sockets", "lerobot"] = Field(
        "table",
        description="Positions (or poses) with the joint values there; or a folder for each place "
        "of a tool with two sockets, whose `hole_0.csv` and `hole_1.csv` hold joint values with "
        "the ball at rest in that socket; or a LeRobot data set.",
    )
    joint_unit: Literal["deg", "rad", "range"] | None = Field(
        None,
        description="Unit of a LeRobot data set's joint values, which none of its files says "
        "(range: -100 to 100 over the motor's range, taken for the drawing's limits); null: not "
        "known, which is an error for such a data set.",
    )
    tool_from_drawing: bool = Field(
        False,
        description="Compute a LeRobot data set's tool poses from the drawing, since it has none: "
        "what is learned then is the drawing, not the arm.",
    )
    columns: dict[str, str] = Field(
        {},
        description="What columns of the file are, where their names do not say it: `x_mm: tcp x`, "
        "`q_elbow_deg: j3`.",
    )
    held_out_share: float = Field(
        0.25, gt=0, lt=1, description="Share of the records that judges and is never learned from."
    )
    subsets: int = Field(
        20,
        ge=2,
        le=1000,
        description="Random orders of the records; the sizes are beginnings of each, and each has "
        "its own held-out records. They take the place of seeds.",
    )
    socket_distance_mm: float = Field(
        50.0, gt=0, description="Distance between the two sockets of the tool [mm]."
    )
    postures_per_place: int = Field(
        10,
        ge=4,
        description="Postures with the tool in one place, in both sockets alike, before those of "
        "the next place are taken.",
    )
    assumed: Assumed = Assumed()

    def missing(self) -> str:
        """What is said where the recording is not there."""
        place = f" It can be had from {self.source}. Its place is samples.recorded.path."
        return f"{self.path}: there is no such recording.{place if self.source else ''}"


Design = Literal[
    "grid",
    "chebyshev",
    "sobol",
    "latin",
    "uniform",
    "joints",
    "adaptive",
    "recorded",
    "optimal",
]
# A design's random stream is its place in this list (samples/record.py): add another at the end.

RECORDED: Design = "recorded"
"""The design of samples that are not placed but come from a file."""
TENSOR: tuple[Design, ...] = ("grid", "chebyshev")
"""Designs that are a grid of m1 x .. x md points, evenly spaced or not."""


class Samples(Section):
    """Which points are recorded."""

    designs: list[Design] = Field(
        ["grid"],
        min_length=1,
        description="How the points are placed: an even grid, Chebyshev nodes, Sobol points, a "
        "Latin hypercube, uniformly in the workspace, uniformly in joint space, step by step where "
        "networks trained so far disagree, where they tell most about the drawing's deviations "
        "(D-optimal), or as they were recorded (`samples.recorded`). The first design fills the "
        "table and the report.",
    )
    points_per_axis: list[Annotated[int, Field(ge=2, le=32)]] = Field(
        [2, 3, 4, 5, 6, 7, 8],
        description="Sizes to compare: m points per axis give m^d samples of d inputs, in every "
        "design.",
    )
    sizes: list[Annotated[int, Field(ge=4, le=100_000)]] = Field(
        [],
        description="Sizes to compare, in samples; replaces `points_per_axis`. A grid takes the "
        "nearest number of the form m1 x .. x md whose m differ by at most one.",
    )
    unreachable: Literal["error", "mask"] = Field(
        "error",
        description="A grid point the arm cannot reach inside its limits stops the study, or is "
        "left out and counted. Never moved.",
    )
    normalisation: Literal["unit", "symmetric", "none"] = Field(
        "unit",
        description="Min-max scaling of the inputs: to [0, 1], to [-1, 1], or none (mm as they "
        "are). Outputs stay in radians; a prismatic joint's are divided by a power of two.",
    )

    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="Seed of random designs, of fresh points, and of the orders of records.",
    )
    recorded: Recorded | None = Field(
        None, description="Samples that were recorded, in place of computed ones; null: none."
    )

    @model_validator(mode="before")
    @classmethod
    def _recorded_is_a_design(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("recorded"):
            return {"designs": [RECORDED], **data}
        return data

    @model_validator(mode="after")
    def _recorded_alone(self) -> "Samples":
        if (self.designs == [RECORDED]) != bool(self.recorded) or (
            RECORDED in self.designs and len(self.designs) > 1
        ):
            raise ValueError(
                "designs: 'recorded' stands alone, and where 'samples.recorded' names a file"
            )
        return self

    @model_validator(mode="after")
    def _some_size(self) -> "Samples":
        if not (self.sizes or self.points_per_axis):
            raise ValueError("sizes should name at least one size")
        return self

    def n_samples(self, n_inputs: int) -> list[int]:
        """The sizes in samples of so many inputs, ascending."""
        return self.sizes or [m**n_inputs for m in self.points_per_axis]

    @property
    def design(self) -> Design:
        """The first design, which fills the table and the report."""
        return self.designs[0]

    @field_validator("points_per_axis", "sizes")
    @classmethod
    def _sorted_unique(cls, value: list[int]) -> list[int]:
        if len(set(value)) != len(value):
            raise ValueError("should name each size once")
        return sorted(value)

    @field_validator("designs")
    @classmethod
    def _unique(cls, value: list[Design]) -> list[Design]:
        if len(set(value)) != len(value):
            raise ValueError("should name each design once")
        return value


def grid_shape(n: int, sides: Sequence[float]) -> tuple[int, ...]:
    """The grid whose points are nearest to n in number.

    The numbers of points along the axes differ by at most one, and the longest sides have the more.

    Args:
        n: Points wanted, at least 2^d.
        sides: How long each side is, shape (d,).
    """
    d = len(sides)
    m = max(2, round(n ** (1 / d)))
    m -= m > 2 and m**d > n
    longest = sorted(range(d), key=lambda i: -sides[i])
    best = min(range(d + 1), key=lambda k: abs((m + 1) ** k * m ** (d - k) - n))
    return tuple(m + (longest.index(i) < best) for i in range(d))
