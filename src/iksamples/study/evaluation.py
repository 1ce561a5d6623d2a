"""What is measured and proved, and what is good enough."""

from typing import Literal

from pydantic import Field

from iksamples.study.paths import AnyPath, CsvPath, DoubleRectangle, Heart
from iksamples.study.section import Name, Section


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


class Replication(Section):
    """Whether the answer holds for trainings that had no part in it."""

    seeds: int = Field(
        0,
        ge=0,
        le=100_000,
        description="Trainings of each network with fresh seeds, at its answer and at one size "
        "below; 0: none.",
    )
