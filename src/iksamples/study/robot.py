"""The arm, and where it is to work."""

from typing import Literal

from pydantic import Field, model_validator

from iksamples.study.section import Limits, Section, Vector3


class Robot(Section):
    """Which arm, and which of its inverse kinematics is meant."""

    urdf: str = Field(
        "config/robots/rrr70.urdf", description="URDF of the arm, relative to the working folder."
    )
    base_link: str | None = Field(None, description="First link of the chain; null: the root link.")
    tip_link: str | None = Field(
        None, description="Link whose origin is the tool centre point; null: the only end link."
    )
    inverse: Literal["yaw-pitch-pitch"] = Field(
        "yaw-pitch-pitch", description="Closed-form inverse kinematics that labels the samples."
    )
    elbow: Literal["negative", "positive"] = Field(
        "negative", description="Branch of the inverse kinematics: sign of the elbow angle."
    )
    limits_rad: dict[str, Limits] = Field(
        {}, description="Joint limits [rad] that replace the URDF's, by joint name."
    )


class Workspace(Section):
    """The box in which the arm is to work."""

    lower_mm: Vector3 = Field((20.0, 20.0, 0.0), description="Lower corner of the box [mm].")
    upper_mm: Vector3 = Field((80.0, 80.0, 60.0), description="Upper corner of the box [mm].")
    min_singular_value_mm: float = Field(
        1.0,
        ge=0,
        description="A point counts as singular where the smallest singular value of the "
        "Jacobian [mm/rad] is below this.",
    )

    @model_validator(mode="after")
    def _upper_above_lower(self) -> "Workspace":
        if any(low >= high for low, high in zip(self.lower_mm, self.upper_mm, strict=True)):
            raise ValueError("upper_mm must be greater than lower_mm along every axis")
        return self
