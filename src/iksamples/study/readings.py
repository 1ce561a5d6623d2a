"""The section that asks which reading of the paper gives its Table 1."""

from pydantic import Field

from iksamples.study.section import Section


class Readings(Section):
    """A search over readings of the paper, and the best of them again with fresh seeds."""

    count: int = Field(600, ge=1, le=20_000, description="Readings drawn at random.")
    seeds: int = Field(
        16,
        ge=2,
        le=1000,
        description="Networks of each reading and grid in the search; 16 train as fast as one.",
    )
    best: int = Field(12, ge=1, le=1000, description="Best readings that are trained again.")
    fresh_seeds: int = Field(
        100, ge=2, le=10_000, description="Networks of each when it is trained again."
    )
    jobs: int = Field(8, ge=1, le=256, description="Jobs into which each of the two is cut.")
    seed: int = Field(0, ge=0, lt=2**31, description="Seed of the draw.")
