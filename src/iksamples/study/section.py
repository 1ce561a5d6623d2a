"""What every section of the study file shares."""

from pydantic import BaseModel, ConfigDict


Vector3 = tuple[float, float, float]
Limits = tuple[float, float]


class Section(BaseModel):
    """A part of the study file; an unknown key is an error, and nothing changes once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
