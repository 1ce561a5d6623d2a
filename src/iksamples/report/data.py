"""Everything the report reads, in one object that its sections share."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pyarrow import parquet

from iksamples.answer import answer as answers
from iksamples.answer.calibration import Calibration, read_calibrations
from iksamples.answer.outcomes import all_cells, certificates
from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.workspace import study_chain
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import CUBE
from iksamples.results import Cell, cells, sample_sets
from iksamples.samples.dataset import AXES, SampleSet
from iksamples.study import NETWORK, Study


_MLFLOW_DEFAULT = "sqlite:///mlflow.db"


@dataclass(frozen=True, eq=False)
class Track:
    """One network on one path.

    Attributes:
        seed: The network's seed.
        target_mm: Waypoints [mm], shape (waypoints, 3).
        reached_mm: Where the tool went [mm], shape (waypoints, 3).
        joints: What the network answered [rad], shape (waypoints, joints).
        error_mm: Distance between the two [mm], shape (waypoints,).
    """

    seed: int
    target_mm: Floats
    reached_mm: Floats
    joints: Floats
    error_mm: Floats

    @property
    def breaks(self) -> list[int]:
        """Waypoints at which the pen is lifted: a step much longer than its neighbours."""
        steps = np.linalg.norm(np.diff(self.target_mm, axis=0), axis=1)
        return [int(i) + 1 for i in np.flatnonzero(steps > 5 * np.median(steps))]


@dataclass(frozen=True, eq=False)
class Grid:
    """The study's network on one grid; diverged seeds are left out of its tables.

    Attributes:
        samples: What it was trained on.
        members: One row per seed.
        history: Losses, one row per seed and epoch.
        waypoints: One row per path, waypoint and seed.
        errors: One row per seed and region.
        bounds: One row per seed.
        n_workspace: Points spread over the workspace at which the error was measured.
    """

    samples: SampleSet
    members: pd.DataFrame
    history: pd.DataFrame
    waypoints: pd.DataFrame
    errors: pd.DataFrame
    bounds: pd.DataFrame
    n_workspace: int

    @property
    def m(self) -> int:
        """Grid points along each axis."""
        return self.samples.points_per_axis

    @property
    def n(self) -> int:
        """Samples."""
        return self.samples.n_samples

    def seed_errors(self, region: str, column: str = "error_mean_mm") -> "pd.Series[float]":
        """A statistic of each seed's error in a region [mm], indexed by seed."""
        rows = self.errors[self.errors["region"] == region]
        return rows.set_index("seed")[column]

    def ranked_seeds(self, path: str) -> list[int]:
        """Seeds by their mean error on a path, best first."""
        return [int(seed) for seed in self.seed_errors(path).sort_values(kind="stable").index]

    def median_seed(self, path: str) -> int:
        """The seed in the middle; of an even number, the better of the middle two."""
        ranked = self.ranked_seeds(path)
        return ranked[(len(ranked) - 1) // 2]

    @cached_property
    def _tracks(self) -> dict[tuple[str, int], pd.DataFrame]:
        groups = self.waypoints.groupby(["path", "seed"], sort=False)
        return {(path, seed): rows for (path, seed), rows in groups}  # type: ignore[misc]

    def track(self, path: str, seed: int) -> Track:
        """One network on one path."""
        rows = self._tracks[path, seed].sort_values("waypoint")
        return Track(
            seed,
            rows[[f"target_{axis}_mm" for axis in AXES]].to_numpy(float),
            rows[[f"reached_{axis}_mm" for axis in AXES]].to_numpy(float),
            rows[[f"q_{name}_rad" for name in self.samples.joint_names]].to_numpy(float),
            rows["error_mm"].to_numpy(float),
        )


@dataclass(frozen=True, eq=False)
class ReportData:
    """What the sections of a report draw from.

    Attributes:
        study: The study.
        chain: Its arm.
        results: Its results folder.
        output: Folder of the report.
        table: ``table.csv``, one row per grid.
        grids: The grids that have a network that did not diverge, smallest first.
        benchmarks: One row per job: step, s, cpu_s, max_rss_mb; may be empty.
        command: What runs the study.
        tracking_uri: Where the runs were logged; None: where MLflow looks by itself.
    """

    study: Study
    chain: SerialChain
    results: Path
    output: Path
    table: pd.DataFrame
    grids: list[Grid]
    benchmarks: pd.DataFrame
    command: str
    tracking_uri: str | None

    @property
    def first_path(self) -> str:
        """The path that fills the table."""
        return next(iter(self.study.evaluation.paths))

    @property
    def paths(self) -> list[str]:
        """Names of the paths."""
        return list(self.study.evaluation.paths)

    @property
    def regions(self) -> list[str]:
        """Where the headline errors are measured: the first path, and the whole workspace."""
        return [self.first_path, CUBE]

    @property
    def measured(self) -> pd.DataFrame:
        """The rows of the table whose networks did not all diverge."""
        return self.table[self.table["error_mean_mm"].notna()]

    @property
    def on_paper(self) -> pd.DataFrame:
        """The measured rows for which the paper has numbers."""
        return self.measured[self.measured["paper_error_mm"].notna()]

    @property
    def recordings(self) -> list[Path]:
        """The recordings, one per path."""
        return [self.results / "recordings" / f"{path}.rrd" for path in self.paths]

    @cached_property
    def answer(self) -> answers.Answer | None:
        """How many samples the study's tolerance takes; None where that was not worked out."""
        found = (self.results / answers.FILE).exists()
        return answers.read_answer(self.results) if found else None

    @cached_property
    def calibrations(self) -> list[Calibration]:
        """How the answers fared with fresh trainings; empty where the study asks for none."""
        return read_calibrations(self.results) if self.study.calibration.seeds else []

    @cached_property
    def samples_needed(self) -> pd.DataFrame | None:
        """Samples needed against tolerance; None where that was not worked out."""
        file = self.results / "samples-needed.csv"
        return pd.read_csv(file) if file.exists() else None

    @cached_property
    def proofs(self) -> pd.DataFrame | None:
        """The certificates, one row per network; None where there are none."""
        table = certificates(self.results)
        return None if table is None or table.empty else table

    @cached_property
    def every_error(self) -> pd.DataFrame:
        """Errors of every method on every set of samples; diverged seeds are left out.

        Columns method, design, label, points_per_axis, n_samples, seed, path_mm (mean along the
        first path), mean_mm and worst_mm (over the workspace; the worst is the certified bound
        where there is one) and certified.
        """
        sets: dict[str, SampleSet] = {}
        frames = []
        for cell in all_cells(self.study, self.results):
            if (cell.folder / "errors.parquet").exists():
                samples = sets.setdefault(cell.label, cell.samples)
                frames.append(_errors_of(cell, samples, self.first_path))
        table = pd.concat(frames, ignore_index=True)
        table["certified"] = False
        if self.proofs is None or "label" not in self.proofs:
            return table
        bound = self.proofs.set_index(["method", "label", "seed"])["sup_upper_mm"]
        upper = bound.reindex(pd.MultiIndex.from_frame(table[list(bound.index.names)])).to_numpy()
        table["certified"] = np.isfinite(upper)
        table["worst_mm"] = np.where(np.isfinite(upper), upper, table["worst_mm"])
        return table

    @cached_property
    def diverged(self) -> int:
        """Networks, of all methods on all samples, that ``every_error`` leaves out."""
        trained = sum(
            method.training.seeds * len(sample_sets(self.study))
            for method in self.study.all_methods.values()
            if method.kind == "network"
        )
        kinds = {name: method.kind for name, method in self.study.all_methods.items()}
        kept = (self.every_error["method"].map(kinds) == "network").sum()
        return trained - int(kept)

    def source(self, table: str) -> str:
        """Name of the cells' files of one kind, for a caption."""
        return (
            self.results / NETWORK / f"{self.study.samples.design}*" / f"{table}.parquet"
        ).as_posix()


def read_report_data(study: Study, results: Path, output: Path, command: str) -> ReportData:
    """Reads a finished study.

    Raises:
        IksamplesError: A result is missing or unreadable, or every network diverged.
    """
    try:
        table = pd.read_csv(results / "table.csv")
        read = [_read_grid(cell) for cell in cells(study, results)]
    except (OSError, ValueError) as error:
        raise IksamplesError(
            f"{results}: the study is not finished ({error}). Run the workflow first."
        ) from None
    grids = [grid for grid in read if not grid.members.empty]
    if not grids:
        raise IksamplesError(
            f"{results}: every network diverged, so there is nothing to report. "
            "Lower training.learning_rate."
        )
    return ReportData(
        study,
        study_chain(study),
        results,
        output,
        table,
        grids,
        read_benchmarks(results / "benchmarks"),
        command,
        _tracking_uri(study, results),
    )


def read_benchmarks(folder: Path) -> pd.DataFrame:
    """Reads Snakemake's benchmark files.

    Args:
        folder: Holds ``<step>.jsonl``, or ``<step>/<job>.jsonl`` for a step of several jobs.

    Returns:
        One row per job: step, s, cpu_s, max_rss_mb (NaN where a job was over before Snakemake
        looked).
    """
    rows = []
    for file in sorted(folder.rglob("*.jsonl")):
        step = file.relative_to(folder).parts[0].removesuffix(".jsonl").replace("_", " ")
        for line in file.read_text(encoding="utf-8").splitlines():
            if not line.strip():
                continue
            record = json.loads(line)
            rows.append(
                {
                    "step": step,
                    "s": _number(record, "s"),
                    "cpu_s": _number(record, "cpu_time"),
                    "max_rss_mb": _number(record, "max_rss"),
                }
            )
    return pd.DataFrame(rows, columns=["step", "s", "cpu_s", "max_rss_mb"])


def _tracking_uri(study: Study, results: Path) -> str | None:
    manifest = results / "tracking.json"
    uri = study.tracking.uri
    if manifest.exists():
        uri = json.loads(manifest.read_text(encoding="utf-8"))["tracking_uri"]
    return None if uri == _MLFLOW_DEFAULT else uri


def _number(record: Mapping[str, Any], key: str) -> float:
    try:
        return float(record[key])
    except (KeyError, TypeError, ValueError):
        return float("nan")


def _errors_of(cell: Cell, samples: SampleSet, path: str) -> pd.DataFrame:
    """One method on one set of samples, a row per seed that did not diverge."""
    errors = cell.sound_errors.fillna({"seed": 0}).set_index("seed")
    cube = errors[errors["region"] == CUBE]
    on_path = errors.loc[errors["region"] == path, "error_mean_mm"]
    table = pd.DataFrame(
        {
            "method": cell.method,
            "design": samples.design,
            "label": cell.label,
            "points_per_axis": samples.points_per_axis,
            "n_samples": samples.n_samples,
            "seed": cube.index.astype(int),
            "path_mm": on_path.reindex(cube.index).to_numpy(float),
            "mean_mm": cube["error_mean_mm"].to_numpy(float),
            "worst_mm": cube["error_max_mm"].to_numpy(float),
        }
    )
    return table[np.isfinite(table["worst_mm"])]


def _read_grid(cell: Cell) -> Grid:
    members = cell.table("members")
    sound = members.loc[~members["diverged"].astype(bool), "seed"]

    def of_sound_seeds(name: str) -> pd.DataFrame:
        table = cell.table(name)
        return table[table["seed"].isin(sound)]

    return Grid(
        samples=cell.samples,
        members=members[members["seed"].isin(sound)],
        history=of_sound_seeds("history"),
        waypoints=of_sound_seeds("waypoints"),
        errors=of_sound_seeds("errors"),
        bounds=of_sound_seeds("bounds"),
        # A million rows for a number that the file's footer knows.
        n_workspace=parquet.read_metadata(cell.folder / "cube.parquet").num_rows // len(members),
    )
