"""Where a study's files lie: the one place that knows the results folder."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from iksamples.columns import stored_table
from iksamples.methods.registry import KINDS
from iksamples.network import StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import sample_label
from iksamples.study import NETWORK, Design, Study


if TYPE_CHECKING:
    import pandas as pd


_KEYS: dict[str, Sequence[str]] = {
    "bounds": ["seed"],
    "errors": ["region", "seed"],
    "history": ["seed", "epoch"],
    "members": ["seed"],
    "training_bound": ["seed", "epoch"],
    "waypoints": ["path", "waypoint", "seed"],
}
"""The columns that tell the rows of a table apart."""


@dataclass(frozen=True)
class Cell:
    """One method on one set of samples; its files are read when first asked for.

    Attributes:
        results: The study's results folder, such as ``results/paper``.
        method: Name of the method.
        label: Name of the set of samples, such as ``grid5``.
    """

    results: Path
    method: str
    label: str

    @property
    def folder(self) -> Path:
        """Folder of the method's files on these samples."""
        return self.results / self.method / self.label

    @property
    def samples_path(self) -> Path:
        """File of the samples."""
        return self.results / "samples" / f"{self.label}.parquet"

    @cached_property
    def samples(self) -> SampleSet:
        """The samples."""
        return SampleSet.load(self.samples_path)

    @cached_property
    def network(self) -> StackedMLP:
        """The trained networks of all seeds."""
        return StackedMLP.load(self.folder / "weights.safetensors")

    def table(self, name: str, needed: Sequence[str] = ()) -> "pd.DataFrame":
        """One of the cell's tables: history, members, waypoints, errors, cube or bounds."""
        return stored_table(self.folder / f"{name}.parquet", needed, _KEYS.get(name, ()))

    @cached_property
    def sound_errors(self) -> "pd.DataFrame":
        """The errors, without those of networks that diverged."""
        errors = self.table("errors", ("error_mean_mm",))
        if not (self.folder / "members.parquet").exists():
            return errors  # not trained
        members = self.table("members", ("diverged",))
        diverged = members.loc[members["diverged"].astype(bool), "seed"]
        return errors[~errors["seed"].isin(diverged)]


def sample_sets(
    study: Study, design: Design | None = None, method: str | None = None
) -> dict[str, tuple[Design, int]]:
    """Every set of samples of a study, smallest first: its name -> design and samples wanted.

    Args:
        study: The study.
        design: Only the sets of this design; None: of all.
        method: Only the sets of this method; None: of all.
    """
    return {
        sample_label(study, kind, n): (kind, n)
        for kind in ([design] if design else study.designs(method))
        for n in study.sizes_of(kind)
    }


def networks(study: Study) -> list[str]:
    """Names of the study's methods that are trained."""
    return [name for name, method in study.all_methods.items() if not KINDS[method.kind].fit]


def certified(study: Study) -> list[str]:
    """Names of the study's methods whose worst case can be proved.

    There is none where arms give way: a proof is about a rigid chain.
    """
    if study.arm and not study.arm.is_chain:
        return []
    return [name for name, method in study.all_methods.items() if KINDS[method.kind].certifiable]


def cells(
    study: Study, results: str | Path, method: str = NETWORK, design: Design | None = None
) -> Iterator[Cell]:
    """A method on every set of samples of a design; by default of its first."""
    for label in sample_sets(study, design or study.designs(method)[0]):
        yield Cell(Path(results), method, label)
