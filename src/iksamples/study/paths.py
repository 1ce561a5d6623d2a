"""Paths that the tool is asked to draw.

Sizes and places that a study leaves out follow from its workspace, so that the same path fits any
arm; in a plane nothing leans, and angles among the inputs stay in the middle of their range.
"""

from typing import Annotated, Literal

from pydantic import Field

from iksamples.study.section import Corner, Pair, Section


class _Drawn(Section):
    """A path that is drawn by a formula."""

    shape: str = Field(description="Kind of path.")
    waypoints: int = Field(200, ge=8, le=100_000, description="Points along the path.")


class DoubleRectangle(_Drawn):
    """Two axis-parallel rectangles at a low and a high height (paper, Figs. 4 and 5).

    In a plane one lies inside the other.
    """

    shape: Literal["double_rectangle"] = Field(description="Kind of path.")
    lower_mm: Pair | None = Field(
        None, description="Lower x and y [mm]; null: a sixth of the workspace from its side."
    )
    upper_mm: Pair | None = Field(None, description="Upper x and y [mm]; null: likewise.")
    heights_mm: Pair | None = Field(None, description="The two heights z [mm]; null: likewise.")
    waypoints: int = Field(240, ge=8, le=100_000, description="Points along both rectangles.")


class _Flat(_Drawn):
    """A path in a plane that may lean about the x axis."""

    centre_mm: Corner | None = Field(
        None, description="Centre of the path [mm]; null: that of the workspace."
    )
    width_mm: float | None = Field(
        None, gt=0, description="Width along x [mm]; null: 11/15 of the workspace's shortest side."
    )
    tilt_rad: float = Field(
        0.0, ge=-3.1416, le=3.1416, description="Lean of the plane about the x axis [rad]."
    )


class Heart(_Flat):
    """A heart (paper, Fig. 2)."""

    shape: Literal["heart"] = Field(description="Kind of path.")
    tilt_rad: float = Field(
        0.6, ge=-3.1416, le=3.1416, description="Lean of the plane about the x axis [rad]."
    )


class Circle(_Flat):
    """A circle."""

    shape: Literal["circle"] = Field(description="Kind of path.")


class Lemniscate(_Flat):
    """Gerono's lemniscate, an eight on its side."""

    shape: Literal["lemniscate"] = Field(description="Kind of path.")


class Helix(_Flat):
    """A helix along z, before it leans; it takes a workspace with a height."""

    shape: Literal["helix"] = Field(description="Kind of path.")
    height_mm: float | None = Field(
        None, gt=0, description="Height [mm]; null: 2/3 of the workspace's."
    )
    turns: float = Field(3.0, gt=0, le=1000, description="Turns.")


class CsvPath(Section):
    """Waypoints from a CSV file."""

    shape: Literal["csv"] = Field(description="Kind of path.")
    file: str = Field(
        description="CSV file with a column for each input, units in its header (x_mm, x_m, "
        "yaw_rad, yaw_deg), and optionally pen_up: 1 where the pen is lifted on the way there."
    )


AnyPath = Annotated[
    DoubleRectangle | Heart | Circle | Lemniscate | Helix | CsvPath,
    Field(discriminator="shape"),
]

SHAPES: dict[str, type[Section]] = {
    "double_rectangle": DoubleRectangle,
    "heart": Heart,
    "circle": Circle,
    "lemniscate": Lemniscate,
    "helix": Helix,
    "csv": CsvPath,
}
"""Name of a shape in the study file -> its section."""
