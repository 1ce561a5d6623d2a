"""How the arm itself differs from its drawing, and what methods expect of that."""

from pydantic import Field, model_validator

from iksamples.study.sections import Section


class Expected(Section):
    """What the methods that know the drawing expect of the arm, before they see a sample."""

    deviation_mm: float | None = Field(
        None,
        ge=0,
        le=1000,
        description="Expected displacement of each link, standard deviation along each axis [mm]; "
        "null: as it is.",
    )
    deviation_rad: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Expected turn of each link, standard deviation about each axis [rad]; null: "
        "as it is.",
    )
    noise_mm: float | None = Field(
        None, ge=0, le=1000, description="Expected measurement noise [mm]; null: as it is."
    )
    noise_rad: float | None = Field(
        None, ge=0, le=1, description="Expected measurement noise [rad]; null: as it is."
    )


class Arm(Section):
    """A simulated arm that is not its drawing: every seed draws another one.

    Methods know the drawing and the samples recorded on the arm; their errors are measured on the
    arm itself.
    """

    deviation_mm: float = Field(
        0,
        ge=0,
        le=1000,
        description="Displacement of each link and of the tool from the drawing, standard "
        "deviation along each axis [mm].",
    )
    deviation_rad: float = Field(
        0,
        ge=0,
        le=1,
        description="Turn of each link and of the tool, zeros of the joints included, standard "
        "deviation about each axis [rad].",
    )
    noise_mm: float = Field(
        0,
        ge=0,
        le=1000,
        description="Noise of a recorded position, standard deviation along each axis [mm].",
    )
    noise_rad: float = Field(
        0,
        ge=0,
        le=1,
        description="Noise of a recorded orientation, where one is asked for, standard deviation "
        "about each axis [rad].",
    )
    payload_kg: float = Field(
        0, ge=0, le=10_000, description="Mass at the tool centre point, which bends the joints."
    )
    stiffness_nm_per_rad: float | None = Field(
        None,
        gt=0,
        description="Torsional stiffness of each revolute joint [N m/rad]; null: rigid.",
    )
    backlash_rad: float = Field(
        0,
        ge=0,
        le=1,
        description="Play of each revolute joint [rad]: it rests half of it to either side of what "
        "its encoder reads.",
    )
    encoder_step_rad: float = Field(
        0, ge=0, le=1, description="Smallest change of angle that encoders tell apart [rad]."
    )
    expected: Expected = Expected()

    @model_validator(mode="after")
    def _a_payload_bends_something(self) -> "Arm":
        if bool(self.payload_kg) != (self.stiffness_nm_per_rad is not None):
            raise ValueError(
                "'arm.payload_kg' and 'arm.stiffness_nm_per_rad' bend the arm together; give both "
                "or neither"
            )
        return self

    @property
    def expectation(self) -> Expected:
        """``expected``, with nothing left open."""
        said = self.expected.model_dump(exclude_none=True)
        return Expected(**{name: getattr(self, name) for name in Expected.model_fields} | said)

    @property
    def repeats(self) -> bool:
        """Whether the tool is always at the same place for the same joint values."""
        return not (self.backlash_rad or self.encoder_step_rad)

    @property
    def is_chain(self) -> bool:
        """Whether the arm is a rigid chain, as proofs need it."""
        return self.repeats and not self.payload_kg
