"""Where a study's files lie, and whether they are its own: the one place that knows the folder."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from iksamples.columns import stored_table
from iksamples.errors import IksamplesError
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
_SOME = ("slices", "training_bound", "unsafe")
"""Tables of a few seeds, or of none."""
PROOFS = "certificates.csv"
"""Name of a method's certificates in its folder, and of all together."""
CUBE = "cube"
"""Name of the region of a cell's errors that is the whole region of the study."""


@dataclass(frozen=True)
class Cell:
    """One method on one set of samples; its files are read when first asked for.

    Attributes:
        study: The study, which says what the files have to be of.
        results: Its results folder, such as ``results/paper``.
        method: Name of the method.
        label: Name of the set of samples, such as ``grid5``.

    Raises:
        IksamplesError: A file is of another run than the study.
    """

    study: Study
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

    @property
    def trained(self) -> bool:
        """Whether the method is a network."""
        return self.method in networks(self.study)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of every training, or of every arm; 0 where nothing is left to chance."""
        chance = self.trained or self.study.arm is not None
        return self.study.all_methods[self.method].training.all_seeds if chance else (0,)

    @cached_property
    def samples(self) -> SampleSet:
        """The samples."""
        found = SampleSet.load(self.samples_path)
        of, wanted = (found.label, *found.space.names), (self.label, *self.study.task.inputs)
        require_own(self.study, self.samples_path, "samples", [of], [wanted])
        return found

    @cached_property
    def network(self) -> StackedMLP:
        """The trained networks of all seeds."""
        file = self.folder / "weights.safetensors"
        found, samples = StackedMLP.load(file), self.samples
        require_own(self.study, file, "seed", found.seeds, self.seeds)
        ends = [(len(found.offset), found.biases[-1].shape[-1])]
        wanted = [(len(samples.space), len(samples.joint_space))]
        require_own(self.study, file, "inputs and outputs", ends, wanted)
        return found

    def table(self, name: str, needed: Sequence[str] = ()) -> "pd.DataFrame":
        """One of the cell's tables: history, members, waypoints, errors, cube or bounds."""
        file = self.folder / f"{name}.parquet"
        table = stored_table(file, ("seed", *needed), _KEYS.get(name, ()))
        some = name in _SOME
        if table.empty and (some or not self.trained):
            return table  # the method cannot use these samples
        require_own(self.study, file, "seed", table["seed"].unique(), self.seeds, some)
        for column, more in (("path", ()), ("region", (CUBE,))):
            if column in table:
                paths = (*self.study.evaluation.paths, *more)
                require_own(self.study, file, column, table[column].unique(), paths)
        if name == "waypoints":
            spaces = {"target_": self.samples.space, "q_": self.samples.joint_space}
            wanted = [one for start, space in spaces.items() for one in space.columns(start)]
            columns = table.filter(regex="^(target|q)_").columns
            require_own(self.study, file, "column", columns, wanted)
        return table

    @cached_property
    def sound_errors(self) -> "pd.DataFrame":
        """The errors, without those of networks that diverged."""
        errors = self.table("errors", ("error_mean_mm",))
        if not (self.folder / "members.parquet").exists():
            return errors  # not trained
        members = self.table("members", ("diverged",))
        diverged = members.loc[members["diverged"].astype(bool), "seed"]
        return errors[~errors["seed"].isin(diverged)]


def require_own(
    study: Study,
    file: Path,
    what: str,
    found: Iterable[object],
    wanted: Iterable[object],
    some: bool = False,
) -> None:
    """Stops at a file that is of another run, such as one that was copied from there.

    Args:
        study: The study whose results are read.
        file: One of them.
        what: What is compared, for the message.
        found: What is in the file.
        wanted: What the study has.
        some: Whether the file may lack a part of it.

    Raises:
        IksamplesError: They differ.
    """
    here, there = set(found), set(wanted)
    for verb, odd in (("has", here - there), ("lacks", set() if some else there - here)):
        if odd:
            one = min(odd, key=str)
            named = ", ".join(map(str, one)) if isinstance(one, tuple) else one
            raise IksamplesError(
                f"{file} and study '{study.name}' are of different runs: the file {verb} {what} "
                f"{named}. Delete it and run the study again."
            )


def own_cells(study: Study, file: Path, found: Collection[tuple[str, str]]) -> list[Cell]:
    """As ``require_own``, of what a file has of many cells.

    Args:
        study: The study whose results are read; of a recorded one methods alone are compared.
        file: One of them, which lies in the results folder.
        found: Of each cell in the file the method and the name of the samples.

    Returns:
        The cells that are in the file.

    Raises:
        IksamplesError: There are others, or there is none of a network.
    """
    if study.samples.recorded:
        require_own(study, file, "method", {method for method, _ in found}, study.all_methods, True)
        return []
    known = {(cell.method, cell.label): cell for cell in all_cells(study, file.parent)}
    own = {key: cell for key, cell in known.items() if cell.trained or key in found}
    require_own(study, file, "a run of", found, own)
    return list(own.values())


def proofs(study: Study, file: Path, needed: Sequence[str] = ()) -> "pd.DataFrame":
    """A table of certificates, a row per network.

    Raises:
        IksamplesError: It is missing, damaged, or of another run.
    """
    key = ["method", "label", "seed"]
    table = stored_table(file, ["verified", "failed", *needed], key)
    known = all_cells(study, file.parent)
    seeds = [(cell.method, cell.label, seed) for cell in known for seed in cell.seeds]
    found = table[key].itertuples(index=False, name=None)
    require_own(study, file, "a run of", found, seeds, some=True)
    return table


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


def all_cells(study: Study, results: str | Path) -> Iterator[Cell]:
    """Every method on every set of samples; one that needs none on the first alone."""
    for name, method in study.all_methods.items():
        learns = KINDS[method.kind].needs_samples
        for design in study.designs(name)[: None if learns else 1]:
            of_design = cells(study, results, name, design)
            yield from of_design if learns else islice(of_design, 1)


def cells(
    study: Study, results: str | Path, method: str = NETWORK, design: Design | None = None
) -> Iterator[Cell]:
    """A method on every set of samples of a design; by default of its first."""
    for label in sample_sets(study, design or study.designs(method)[0]):
        yield Cell(study, Path(results), method, label)
