"""What is measured, proved and good enough, and the paths that the tool is asked to draw.

Sizes and places of a path that a study leaves out follow from its workspace, so that the same path
fits any arm; in a plane nothing leans, and angles among the inputs stay in the middle of their
range.
"""

from typing import Annotated, Literal, get_args

from pydantic import Field

from iksamples.study.sections import Corner, Name, Pair, Section


MOST_INPUTS_OF_A_MEAN = 4
"""A mean is enclosed cell by cell, and in six inputs a million cells leave it a factor of 2.5."""
MAX_EPOCHS = 60
"""Of a training, that pictures and recordings show."""


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
        description="CSV file with a column for each input, units in its header or in a row below "
        "it (x_mm, x_m, yaw_rad, yaw_deg), and optionally pen_up: 1 where the pen is lifted on the "
        "way there."
    )


_Path = DoubleRectangle | Heart | Circle | Lemniscate | Helix | CsvPath
AnyPath = Annotated[_Path, Field(discriminator="shape")]

SHAPES: dict[str, type[Section]] = {
    get_args(one.model_fields["shape"].annotation)[0]: one for one in get_args(_Path)
}
"""Name of a shape in the study file -> its section."""


class Evaluation(Section):
    """Where the error is measured, always through the forward kinematics."""

    paths: dict[Name, AnyPath] = Field(
        {
            "rectangles": DoubleRectangle(shape="double_rectangle"),
            "heart": Heart(shape="heart"),
        },
        min_length=1,
        description="Paths to track, by name; the first one fills Table 1. Naming any replaces "
        "these two. What a path does not say of its place and size follows from the workspace.",
    )
    cube_points: int = Field(
        8192,
        ge=64,
        le=1_000_000,
        description="Points spread over the whole workspace, the same for every grid.",
    )

    @property
    def files(self) -> list[str]:
        """Files of waypoints."""
        return [path.file for path in self.paths.values() if isinstance(path, CsvPath)]


class Bounds(Section):
    """How the paper's estimate (Eq. 25) is formed, and how tight the certificates are."""

    average_weight: Literal["mean", "mean_abs", "rms", "max_abs"] = Field(
        "mean", description="Which average of the trained weights stands for w-bar in Eq. 22."
    )
    scale_mm: float | None = Field(
        None,
        gt=0,
        description="Length that turns the estimate into millimetres [mm]; null: the longest side "
        "of the workspace, which is what the paper's column implies.",
    )
    sup_rtol: float = Field(
        1e-3,
        ge=1e-6,
        le=1,
        description="Certified worst case: largest gap between its bounds, as a share.",
    )
    sup_atol_deg: float = Field(
        0.01,
        ge=0,
        le=180,
        description="Certified worst case of the tool's angle: bounds closer than this are not "
        "asked for [deg]. Where a network keeps an orientation, no share of 0 comes near.",
    )
    mean_rtol: float = Field(
        0.025,
        ge=5e-3,
        le=1,
        description="Certified mean: its bounds lie within this share of their middle, or within "
        "`mean_atol_mm`. Half the share costs some two to four times as much.",
    )
    mean_atol_mm: float = Field(
        0.02,
        ge=0,
        le=1000,
        description="Certified mean: bounds closer to its middle than this are not asked for [mm].",
    )


class Tolerance(Section):
    """What is good enough: the question that the study answers."""

    error_mm: float = Field(2.0, gt=0, description="Largest position error allowed [mm].")
    angle_deg: float | None = Field(
        None,
        gt=0,
        le=180,
        description="Largest angle allowed [deg], where the tool's orientation is asked for; null: "
        "not judged. Both must be met: a degree counts as `error_mm / angle_deg` millimetres.",
    )
    of: Literal["worst", "p99", "p95", "mean"] = Field(
        "worst",
        description="Which error: the certified worst case over the workspace, a percentile, or "
        "the mean.",
    )
    where: str = Field(
        "workspace", description="`workspace`, or the name of a path (there errors are measured)."
    )
    success_share: float = Field(
        0.8, gt=0, lt=1, description="Share of trainings that must meet the tolerance."
    )
    confidence: float = Field(
        0.95, gt=0.5, lt=1, description="Confidence in that share, given the seeds trained."
    )
    best_of: int = Field(
        1, ge=1, le=1000, description="Trainings of which the best is used; 1: any one must do."
    )

    @property
    def certifiable(self) -> bool:
        """Whether it is about the worst case over the workspace, which can be proved."""
        return self.of == "worst" and self.where == "workspace"


class Replication(Section):
    """Whether the answer holds for trainings that had no part in it."""

    seeds: int = Field(
        0,
        ge=0,
        le=100_000,
        description="Trainings of each network with fresh seeds, at its answer and at one size "
        "below; 0: none.",
    )
