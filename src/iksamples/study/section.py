"""What every section of the study file shares."""

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict


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
