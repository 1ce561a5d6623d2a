"""The section on samples that were recorded, and are not computed."""

from typing import Literal

from pydantic import Field

from iksamples.study.arm import Expected
from iksamples.study.section import Section


class Assumed(Section):
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
    tool_mm: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="Displacement of the tool, where its place on the flange is less certain [mm]; "
        "null: as the links.",
    )
    noise_mm: float = Field(
        0.1, ge=0, le=1000, description="Noise of a measured position along each axis [mm]."
    )
    noise_rad: float = Field(
        0.001, ge=0, le=1, description="Noise of a measured orientation about each axis [rad]."
    )

    @property
    def expectation(self) -> Expected:
        """The same as methods take it."""
        return Expected(**self.model_dump(exclude={"tool_mm"}))


class Recorded(Section):
    """Samples from files: which, and how the learning curve is drawn from them."""

    path: str = Field(
        description="The recording, relative to the working folder: a CSV or Parquet file, or a "
        "folder (docs/recorded.md)."
    )
    kind: Literal["table", "sockets"] = Field(
        "table",
        description="Positions (or poses) with the joint values there; or a folder for each place "
        "of a tool with two sockets, whose `hole_0.csv` and `hole_1.csv` hold joint values with "
        "the ball at rest in that socket.",
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
