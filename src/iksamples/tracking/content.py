"""What is logged to MLflow: a run for the study, one per grid below it, one per seed below that.

Every other method, and the study's network on every other design, gets one run with its errors as
curves over the number of samples, beside the study's own.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from iksamples.answer.outcomes import certificates
from iksamples.evaluation.errors import CUBE
from iksamples.files import checked
from iksamples.paper.table import over_seeds
from iksamples.recording.colours import RED, Colour, blues
from iksamples.results import Cell, cells
from iksamples.study import NETWORK, Study


if TYPE_CHECKING:
    import pandas as pd

STUDY_KEY = "study"
CURVE_POINTS = 100

# Settings of a grid; every other number in its row of the table is a result.
_AXES_OF_INTEREST = (
    "samples_per_axis",
    "n_samples",
    "n_trained",
    "spacing_mm",
    "fill_distance_mm",
    "n_seeds",
)
_STATISTICS = ("error_mean_mm", "error_p95_mm", "error_max_mm")
_LOSSES = ("train_loss_rad2", "validation_loss_rad2")
_TABLES = ("history", "members", "errors", "bounds")


@dataclass(frozen=True)
class Samples:
    """A set of samples as MLflow's dataset.

    Attributes:
        name: Name of the set.
        digest: Hash of its content.
        path: Its file.
        columns: Its columns.
        rows: Number of samples.
    """

    name: str
    digest: str
    path: Path
    columns: tuple[str, ...]
    rows: int


@dataclass(frozen=True)
class RunContent:
    """Everything one run holds.

    Attributes:
        key: Names the run within its experiment, whatever MLflow calls it.
        kind: What the run stands for.
        name: Shown name.
        parent: Key of the run it hangs below.
        note: Description (Markdown).
        params: Settings by name.
        metrics: Name, value and step; steps of a curve are epochs or numbers of samples.
        dataset: What the networks learnt from.
        artifacts: Files that go with the run.
        colour: Colour of the run's curves (#rrggbb), else MLflow picks one.
    """

    key: str
    kind: Literal["study", "grid", "seed", "method"]
    name: str
    parent: str | None
    note: str
    params: dict[str, str]
    metrics: list[tuple[str, float, int]]
    dataset: Samples | None = None
    artifacts: list[Path] = field(default_factory=list)
    colour: str = ""

    def digest(self) -> str:
        """Twelve hexadecimal digits of everything the run holds."""
        dataset = self.dataset and (self.dataset.name, self.dataset.digest)
        parts = (self.name, self.parent, self.note, self.params, self.metrics, dataset, self.colour)
        content = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
        for path in self.artifacts:
            content.update(path.name.encode() + path.read_bytes())
        return content.hexdigest()[:12]


def study_runs(study: Study, cells: Iterable[Cell], table_path: Path) -> Iterator[RunContent]:
    """Every run of a study, parents before their children.

    Args:
        study: The study.
        cells: The results of each grid, smallest first.
        table_path: The study's ``table.csv``.
    """
    import pandas as pd

    table = pd.read_csv(checked(table_path))
    rows = {row["samples_per_axis"]: row for _, row in table.iterrows()}
    cells = list(cells)
    grids = [
        _grid_run(study, cell, rows[cell.samples.points_per_axis], _hex(colour))
        for cell, colour in zip(cells, blues(len(cells)), strict=True)
    ]
    yield _study_run(study, grids, table_path)
    for cell, grid in zip(cells, grids, strict=True):
        yield grid
        yield from _seed_runs(study, cell, grid)
    yield from _method_runs(study, table_path.parent)


def study_params(study: Study) -> dict[str, str]:
    """Settings that all runs of a study share; numbers as plain numbers."""
    network, training = study.network, study.training
    stopping = training.early_stopping
    return {
        "robot": Path(study.robot.urdf).stem,
        "normalisation": study.samples.normalisation,
        "hidden": "-".join(map(str, network.hidden)) or "none",
        "activation": network.activation,
        "optimizer": training.optimizer,
        "learning_rate": f"{training.learning_rate:g}",
        "batch_size": str(training.batch_size),
        **({"steps": str(training.steps)} if training.steps else {"epochs": str(training.epochs)}),
        "early_stopping_patience": str(stopping.patience) if stopping else "off",
        "held_out": training.held_out.source,
    }


def _study_run(study: Study, grids: list[RunContent], table_path: Path) -> RunContent:
    """The study's run: the grids' errors as curves over the number of samples."""
    metrics = [
        (name, value, n_samples)
        for grid in grids
        for name, value, n_samples in grid.metrics
        if name.endswith(("_mm", "_over_spacing"))
    ]
    note = (
        f"{study.title or study.name}\n\nErrors over the number of samples, which is the step of "
        f"every chart here. {_about_errors(study)} Below this run is one per grid, and below each "
        "grid one per seed."
    )
    settings = table_path.with_name("study.json")
    return RunContent(
        STUDY_KEY,
        "study",
        f"{study.name}: all sample sizes",
        None,
        note,
        {**study_params(study), "n_seeds": str(study.training.seeds)},
        metrics,
        artifacts=[table_path, *([settings] if settings.exists() else [])],
        colour=_hex(RED),
    )


def _grid_run(study: Study, cell: Cell, row: "pd.Series", colour: str) -> RunContent:
    """A grid's run: its row of the table, the other paths, and the mean loss over its seeds."""
    samples = cell.samples
    n = samples.n_samples
    members = cell.table("members")
    sound = members.loc[~members["diverged"], "seed"]
    params = study_params(study) | {"method": cell.method, "design": samples.design}
    params |= {
        name: f"{row[name]:.10g}"
        for name in _AXES_OF_INTEREST
        if name in row and np.isfinite(row[name])
    }
    metrics = [
        (str(name), float(value), n) for name, value in row.items() if name not in _AXES_OF_INTEREST
    ]
    means = cell.sound_errors.groupby("region")[list(_STATISTICS)].mean()
    for path in list(study.evaluation.paths)[1:]:
        metrics += [(f"{path}_{name}", float(means[name][path]), n) for name in _STATISTICS]
    history = cell.table("history")
    metrics += _curves(history[history["seed"].isin(sound)].groupby("epoch", as_index=False).mean())
    columns = samples.space.columns() + samples.joint_space.columns("q_")
    note = (
        f"{len(members)} networks trained on {n} samples ({samples.design}, "
        f"{samples.points_per_axis} points per axis); means over these seeds. "
        f"{_about_errors(study)} The step of an error is the number of samples, of a loss the "
        "epoch. Each seed is a run below this one; `weights.safetensors` has the weights of all."
    )
    return RunContent(
        f"{cell.method}/{cell.label}",
        "grid",
        f"{cell.label}: {n} samples",
        STUDY_KEY,
        note,
        params,
        _finite(metrics),
        Samples(cell.label, samples.digest(), cell.samples_path, tuple(columns), n),
        [
            cell.samples_path,
            cell.folder / "weights.safetensors",
            *(cell.folder / f"{name}.parquet" for name in _TABLES),
        ],
        colour,
    )


def _seed_runs(study: Study, cell: Cell, grid: RunContent) -> Iterator[RunContent]:
    """The runs of a grid's seeds, with metrics named as the grid's."""
    n = cell.samples.n_samples
    histories = dict(iter(cell.table("history").groupby("seed")))
    errors = dict(iter(cell.table("errors").groupby("seed")))
    bounds = cell.table("bounds").set_index("seed")
    first_path, *other_paths = study.evaluation.paths
    prefixes = {first_path: "", CUBE: "cube_"} | {path: f"{path}_" for path in other_paths}
    average = study.bounds.average_weight
    columns = {
        "estimate_mm": f"estimate_{average}_mm",
        "wbar": f"wbar_{average}",
        "above_estimate": f"above_{average}",
    }
    for member in cell.table("members").to_dict("records"):
        seed = member["seed"]
        metrics = [
            (f"{prefixes[region['region']]}{name}", float(region[name]), n)
            for region in errors[seed].to_dict("records")
            for name in _STATISTICS
        ]
        bound = bounds.loc[seed].to_dict()
        metrics += [(name, float(bound[column]), n) for name, column in columns.items()]
        metrics.append(("test_loss_rad2", float(member["test_loss_rad2"]), member["epochs_run"]))
        metrics += _curves(histories[seed])
        own = {
            "seed": str(seed),
            "epochs_run": str(member["epochs_run"]),
            "diverged": str(member["diverged"]).lower(),
        }
        yield RunContent(
            f"{grid.key}/seed{seed}",
            "seed",
            f"{cell.label}, seed {seed}",
            grid.key,
            "",
            grid.params | own,
            _finite(metrics),
            colour=grid.colour,
        )


def _method_runs(study: Study, results: Path) -> Iterator[RunContent]:
    """A run for each method and design but the study's own, with metrics named as the study's."""
    proofs = certificates(results)
    for name, method in study.all_methods.items():
        for design in study.samples.designs:
            if (name, design) == (NETWORK, study.samples.design):
                continue
            metrics = [
                metric
                for cell in cells(study, results, name, design)
                for metric in _method_metrics(study, cell, proofs)
            ]
            if not metrics:
                continue
            params = {"method": name, "kind": method.kind, "design": design}
            if method.kind == "network":
                own = {"network": method.network, "training": method.training}
                params |= study_params(study.model_copy(update=own))
                params["n_seeds"] = str(method.training.seeds)
            where = f" on {design}" if len(study.samples.designs) > 1 else ""
            yield RunContent(
                f"methods/{name}/{design}",
                "method",
                f"{name}{where}: all sample sizes",
                STUDY_KEY,
                f"Errors over the number of samples, which is the step. {_about_errors(study)}",
                params,
                _finite(metrics),
            )


def _method_metrics(
    study: Study, cell: Cell, proofs: "pd.DataFrame | None"
) -> Iterator[tuple[str, float, int]]:
    """A method's errors on one set of samples: mean over its sound seeds, and certified."""
    errors = cell.sound_errors
    n = cell.samples.n_samples
    for region, prefix in ((next(iter(study.evaluation.paths)), ""), (CUBE, "cube_")):
        own = errors[errors["region"] == region]
        if own.empty:
            return  # the method cannot use these samples
        statistics = over_seeds(own, prefix, cell.samples.spacing_mm)
        yield from ((name, value, n) for name, value in statistics.items())
    if proofs is not None:
        own = proofs[(proofs["method"] == cell.method) & (proofs["label"] == cell.label)]
        yield "sup_median_mm", float(own["sup_upper_mm"].median()), n
        yield "sup_worst_mm", float(own["sup_upper_mm"].max()), n


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _about_errors(study: Study) -> str:
    first_path, *other_paths = study.evaluation.paths
    others = "".join(f", `{path}_` on the path {path}" for path in other_paths)
    return (
        f"`error_` is measured on the path {first_path}{others}, `cube_` over the whole workspace; "
        "`estimate_mm` is the paper's Eq. 25 and `paper_` its Table 1."
    )


def _curves(history: "pd.DataFrame") -> list[tuple[str, float, int]]:
    """The losses over the epochs, thinned to some hundred points."""
    at = np.unique(np.linspace(0, len(history) - 1, CURVE_POINTS).round().astype(int))
    thinned = history.iloc[at]
    return [
        (name, float(value), int(epoch))
        for name in _LOSSES
        for epoch, value in zip(thinned["epoch"], thinned[name], strict=True)
    ]


def _finite(metrics: list[tuple[str, float, int]]) -> list[tuple[str, float, int]]:
    return [metric for metric in metrics if np.isfinite(metric[1])]
