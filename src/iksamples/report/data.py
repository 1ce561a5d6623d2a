"""What a finished study left, as the report's sections read it."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from iksamples.answer.answer import FILE as ANSWER
from iksamples.answer.answer import Answer, read_answer
from iksamples.answer.collect import WORKSPACE, read_runs
from iksamples.answer.replication import Replication, read_replications
from iksamples.arm.chain import Floats
from iksamples.columns import stored_table
from iksamples.errors import IksamplesError, in_a_line
from iksamples.evaluation.errors import median_seed
from iksamples.files import stored_object
from iksamples.methods.registry import KINDS
from iksamples.results import PROOFS, Cell, cells, proofs, require_own
from iksamples.samples.dataset import SampleSet
from iksamples.study import NETWORK, Study
from iksamples.text import domain, trial


@dataclass(frozen=True, eq=False)
class ReportData:
    """A finished study.

    Attributes:
        study: The study.
        results: Its results folder.
        command: What a user types to run it.
        runs: ``runs.parquet`` without what failed, and with ``worst_mm`` and ``worst_deg``: the
            proved bound of the worst error where there is one, else the largest measured.
        n_failed: Results that are missing.
    """

    study: Study
    results: Path
    command: str
    runs: pd.DataFrame
    n_failed: int

    @property
    def first_path(self) -> str:
        """The path that the mean error is quoted on."""
        return next(iter(self.study.evaluation.paths))

    @property
    def place(self) -> str:
        """What errors and proofs are over, in words."""
        return domain(self.runs["region_share"].min())

    @property
    def trial(self) -> str:
        """What a seed is, in a word."""
        return trial(self.study)

    @property
    def several_designs(self) -> bool:
        """Whether samples are placed in more than one way."""
        return len(self.study.samples.designs) > 1

    @cached_property
    def workspace(self) -> pd.DataFrame:
        """A row per training, of its errors over the workspace."""
        return self.runs[self.runs["region"] == WORKSPACE]

    @cached_property
    def compared(self) -> pd.DataFrame:
        """The rows of ``workspace`` that learn from samples: all but the drawing's inverse's."""
        return self.workspace[self.workspace["method"].map(self.learns).astype(bool)]

    @cached_property
    def learns(self) -> dict[str, bool]:
        """Whether each method learns from samples."""
        methods = self.study.all_methods
        return {name: KINDS[method.kind].needs_samples for name, method in methods.items()}

    @cached_property
    def own(self) -> pd.DataFrame:
        """The rows of ``workspace`` of the study's network on its first design."""
        rows = self.workspace
        first = rows["design"] == self.study.samples.design
        return rows[(rows["method"] == NETWORK) & first].sort_values("n_samples", kind="stable")

    @cached_property
    def sets(self) -> list[SampleSet]:
        """Every set of samples of the first design, fewest first."""
        return [cell.samples for cell in cells(self.study, self.results)]

    @cached_property
    def cells(self) -> dict[str, Cell]:
        """The study's network on each set of ``sets`` on which one came to a result."""
        found = {cell.label: cell for cell in cells(self.study, self.results)}
        return {label: found[label] for label in self.own["label"].unique()}

    @cached_property
    def shown(self) -> dict[str, int]:
        """The network that pictures show of each set: the median mean error on the first path."""
        rows = self.runs[self.runs["region"] == self.first_path]
        rows = rows[(rows["method"] == NETWORK)].rename(columns={"error_mean_mm": "error_mm"})
        return {label: median_seed(rows[rows["label"] == label]) for label in self.cells}

    @property
    def loss_unit(self) -> str:
        """Unit of the losses, for an axis; none where prismatic joints count by their scale."""
        return "" if self.sets[0].joint_space.lengths.any() else " [rad²]"

    def samples_mm(self, label: str) -> Floats:
        """Where the samples of a set are [mm], shape (n, coordinates of the position)."""
        samples = self.cells[label].samples
        return samples.x[:, samples.space.lengths]

    def table(self, name: str) -> pd.DataFrame:
        """One of the tables of ``cells``, one below the other, with n_samples; diverged left out.

        Empty where no set of samples has it.
        """
        frames = []
        for label, cell in self.cells.items():
            if (cell.folder / f"{name}.parquet").exists():
                rows = self.own[self.own["label"] == label]
                table = cell.table(name)
                table = table[table["seed"].isin(rows["seed"])]
                frames.append(table.assign(label=label, n_samples=int(rows["n_samples"].iloc[0])))
        return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()

    def shown_rows(self, name: str) -> pd.DataFrame:
        """Those rows of ``table`` that are of the networks shown."""
        table = self.table(name)
        return table if table.empty else table[table["seed"] == table["label"].map(self.shown)]

    @cached_property
    def answer(self) -> Answer | None:
        """How many samples the tolerance takes; None where that was not worked out."""
        return read_answer(self.results, self.study) if (self.results / ANSWER).exists() else None

    @cached_property
    def fresh(self) -> list[Replication]:
        """How the answers fared with fresh trainings; empty where none were asked for."""
        return read_replications(self.results)

    @cached_property
    def samples_needed(self) -> pd.DataFrame:
        """Samples needed against tolerance; empty where that was not worked out."""
        file = self.results / "samples-needed.csv"
        if not file.exists():
            return pd.DataFrame()
        table = stored_table(file, ["method"])
        require_own(self.study, file, "method", table["method"], self.study.all_methods, some=True)
        return table.dropna(subset="n_samples")

    @cached_property
    def certificates(self) -> pd.DataFrame:
        """What is proved of the networks of ``own``; empty where nothing is."""
        file = self.results / PROOFS
        if not file.exists():
            return pd.DataFrame()
        table = proofs(self.study, file)
        if table.empty:  # arms that give way have none
            return pd.DataFrame()
        place = self.sets[0].space.columns("argmax_")
        require_own(self.study, file, "column", table.filter(regex="^argmax_").columns, place)
        table = table.drop(columns=["n_samples"])
        own = self.own[["label", "seed", "n_samples", "error_max_mm"]]
        return own.merge(table[table["method"] == NETWORK], on=["label", "seed"])

    @cached_property
    def benchmarks(self) -> pd.DataFrame:
        """Snakemake's measurements, one row per job: step, s, cpu_s, max_rss_mb; may be empty."""
        return read_benchmarks(self.results / "benchmarks")

    @cached_property
    def tracking(self) -> dict[str, Any]:
        """Where the runs were logged; empty where they were not."""
        file = self.results / "tracking.json"
        return stored_object(file, {"tracking_uri": str}) if file.exists() else {}


def read_report_data(study: Study, results: Path, command: str) -> ReportData:
    """Reads a finished study.

    Raises:
        IksamplesError: A result is missing or unreadable.
    """
    runs = read_runs(study, results)
    failed = runs["failed"].ne("")
    sound = runs[~failed].assign(
        worst_mm=runs["sup_upper_mm"].fillna(runs["error_max_mm"]),
        worst_deg=runs["angle_upper_deg"].fillna(runs["angle_max_deg"]),
    )
    n_failed = int((failed & (runs["region"] == WORKSPACE)).sum())
    return ReportData(study, results, command, sound, n_failed)


def read_benchmarks(folder: Path) -> pd.DataFrame:
    """Reads Snakemake's benchmark files.

    Args:
        folder: Holds ``<step>.jsonl``, or ``<step>/<job>.jsonl`` for a step of several jobs.

    Returns:
        One row per job: step, s, cpu_s, max_rss_mb (NaN where a job was over before Snakemake
        looked).

    Raises:
        IksamplesError: A file holds something else.
    """
    rows = []
    for file in sorted(folder.rglob("*.jsonl")):
        step = file.relative_to(folder).parts[0].removesuffix(".jsonl").replace("_", " ")
        try:
            for line in filter(str.strip, file.read_text(encoding="utf-8").splitlines()):
                said = json.loads(line, parse_int=float)
                values = [said.get(name) for name in ("s", "cpu_time", "max_rss")]
                rows.append([step, *(one if isinstance(one, float) else None for one in values)])
        except (ValueError, AttributeError, RecursionError) as error:
            raise IksamplesError(
                f"{file}: not what Snakemake measured ({in_a_line(error)}). Delete it."
            ) from None
    table = pd.DataFrame(rows, columns=["step", "s", "cpu_s", "max_rss_mb"])
    return table.astype(dict.fromkeys(["s", "cpu_s", "max_rss_mb"], float))
