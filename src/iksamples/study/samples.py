"""Which points are recorded."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from iksamples.study.section import Section


Design = Literal["grid", "chebyshev", "sobol", "latin", "uniform", "joints", "adaptive"]
DRAWN: tuple[Design, ...] = ("sobol", "latin", "uniform", "joints")
"""Designs whose points ``samples.seed`` draws."""


class Samples(Section):
    """Which points are recorded."""

    designs: list[Design] = Field(
        ["grid"],
        min_length=1,
        description="How the points are placed: an even grid, Chebyshev nodes, Sobol points, a "
        "Latin hypercube, uniformly in the workspace, uniformly in joint space, or step by step "
        "where networks trained so far disagree. The first design fills the table and the report.",
    )
    points_per_axis: list[Annotated[int, Field(ge=2, le=32)]] = Field(
        [2, 3, 4, 5, 6, 7, 8],
        min_length=1,
        description="Sizes to compare: m points per axis give m^3 samples, in every design.",
    )
    unreachable: Literal["error", "mask"] = Field(
        "error",
        description="A grid point the arm cannot reach inside its limits stops the study, or is "
        "left out and counted. Never moved.",
    )
    normalisation: Literal["unit", "symmetric", "none"] = Field(
        "unit",
        description="Min-max scaling of the inputs: to [0, 1], to [-1, 1], or none (mm as they "
        "are). Outputs stay in radians.",
    )

    seed: int = Field(
        0, ge=0, lt=2**31, description="Seed of the random designs and of the fresh points."
    )

    @property
    def design(self) -> Design:
        """The first design, which fills the table and the report."""
        return self.designs[0]

    @field_validator("points_per_axis")
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
