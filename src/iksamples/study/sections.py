"""What sections of the study file share; the arm, what is asked of its tool, and where."""

import re
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    model_validator,
)


# A tuple is written as a list; its numbers stay strict.
Pair = Annotated[tuple[float, float], Strict(False)]
Vector3 = Annotated[tuple[float, float, float], Strict(False)]
Limits = Pair
Corner = Annotated[tuple[float, ...], Strict(False), Field(min_length=2, max_length=3)]
"""As many numbers as there are positions among the inputs."""

_STUDY, _INSIDE = r"^[a-z0-9][a-z0-9_-]*$", r"^[a-z][a-z0-9-]*$"
NAMES = {
    _STUDY: "lower-case letters, digits, - and _, the first a letter or digit",
    _INSIDE: "lower-case letters, digits and -, the first a letter",
}
"""Pattern of a name that becomes a folder or file -> in words."""


def _no_refrain(name: str) -> str:
    """Snakemake takes 20 repetitions at the end of a wildcard for a rule that calls itself."""
    if re.search(r"(.+)\1{19}$", name):
        raise ValueError("should not repeat the same letters 20 times")
    return name


StudyName = Annotated[str, Field(pattern=_STUDY, max_length=60), AfterValidator(_no_refrain)]
Name = Annotated[str, Field(pattern=_INSIDE, max_length=60), AfterValidator(_no_refrain)]


def without_password(uri: str) -> str:
    """A URI that can be shown or kept: what may be a password or a key in it is ``***``."""
    shown = re.sub(r"(://[^/?#@:]*):.*@", r"\1:***@", uri)
    return re.sub(r"(?i)([?&;][^=&;]*(?:pass|pwd|token|secret|key)[^=&;]*=)[^&;]*", r"\1***", shown)


class Section(BaseModel):
    """A part of the study file; an unknown key is an error, and nothing changes once read.

    Strict: a boolean or a text is no number, and 3.0 is no whole one.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Robot(Section):
    """Which arm, and which of its inverse kinematics is meant."""

    urdf: str = Field(
        "config/robots/rrr70.urdf",
        description="The arm, relative to the working folder: a URDF, or a table of its "
        "Denavit-Hartenberg parameters (.csv, .yaml; docs/arms.md).",
    )
    base_link: str | None = Field(None, description="First link of the chain; null: the root link.")
    tip_link: str | None = Field(
        None, description="Link whose origin is the tool centre point; null: the only end link."
    )
    tool_offset_mm: Vector3 = Field(
        (0.0, 0.0, 0.0), description="Tool centre point in the tip link's frame [mm]."
    )
    inverse: Literal["auto", "yaw-pitch-pitch", "newton"] = Field(
        "auto",
        description="Inverse kinematics that labels the samples: a closed form, Newton's method "
        "continued from the home posture, or the first of the two that fits the arm.",
    )
    elbow: Literal["negative", "positive"] | None = Field(
        None,
        description="Branch of the closed form: sign of the elbow angle; null: as in the home "
        "posture or else the middle of the limits, and up where that is stretched.",
    )
    home_rad: dict[str, float] = Field(
        {},
        description="Home posture by joint name [rad]; a joint that is not named stands in the "
        "middle of its limits. Newton's method stays on the branch of this posture, and a "
        "redundant arm takes the posture nearest to it.",
    )
    home_mm: dict[str, float] = Field({}, description="Likewise for prismatic joints [mm].")
    locked: list[str] = Field([], description="Joints that stay in the home posture.")
    limits_rad: dict[str, Limits] = Field(
        {}, description="Joint limits [rad] that replace the URDF's, by joint name."
    )
    limits_mm: dict[str, Limits] = Field({}, description="Likewise for prismatic joints [mm].")


Coordinate = Literal["x", "y", "z", "roll", "pitch", "yaw"]
POSITIONS: tuple[Coordinate, ...] = ("x", "y", "z")


class Asked(Section):
    """What is asked of the tool: the network's inputs, and what becomes of the orientation."""

    inputs: list[Coordinate] = Field(
        ["x", "y", "z"],
        min_length=2,
        max_length=6,
        description="Coordinates of the tool's pose that the network is given, in this order: "
        "the position, then angles about the fixed axes, as in a URDF.",
    )
    orientation: Literal["free", "axis", "fixed"] = Field(
        "free",
        description="Whether the tool may be turned as it comes (free), its z axis must point as "
        "asked (axis), or it must be turned as asked (fixed).",
    )
    reference_rpy_rad: Vector3 | None = Field(
        None,
        description="Roll, pitch and yaw of the tool where the angles among the inputs are zero "
        "[rad]; null: as in the home posture. A tool that points down: [3.14159265, 0, 0].",
    )

    @property
    def n_positions(self) -> int:
        """How many of the inputs are positions; they come first."""
        return sum(name in POSITIONS for name in self.inputs)


Angles = Annotated[tuple[float, ...], Strict(False), Field(max_length=3)]


class Workspace(Section):
    """The box of inputs in which the arm is to work."""

    lower_mm: Corner = Field(
        (20.0, 20.0, 0.0), description="Lower limits of the positions among the inputs [mm]."
    )
    upper_mm: Corner = Field((80.0, 80.0, 60.0), description="Upper limits of the positions [mm].")
    lower_rad: Angles = Field((), description="Lower limits of the angles among the inputs [rad].")
    upper_rad: Angles = Field((), description="Upper limits of the angles [rad].")
    min_singular_value_mm: float = Field(
        1.0,
        ge=0,
        description="A point counts as singular where the smallest singular value of the "
        "Jacobian [mm/rad] is below this.",
    )

    @model_validator(mode="after")
    def _upper_above_lower(self) -> "Workspace":
        for unit, lower, upper in (
            ("mm", self.lower_mm, self.upper_mm),
            ("rad", self.lower_rad, self.upper_rad),
        ):
            if len(lower) != len(upper):
                raise ValueError(f"lower_{unit} and upper_{unit} must have as many numbers")
            if any(low >= high for low, high in zip(lower, upper, strict=True)):
                raise ValueError(f"upper_{unit} must be greater than lower_{unit} along every axis")
        return self

    @property
    def lower(self) -> tuple[float, ...]:
        """Lower corner of the box, in the inputs' units."""
        return (*self.lower_mm, *self.lower_rad)

    @property
    def upper(self) -> tuple[float, ...]:
        """Upper corner of the box, in the inputs' units."""
        return (*self.upper_mm, *self.upper_rad)
