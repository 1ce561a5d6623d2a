"""What is logged to MLflow: a run per variant (method and design), and below it one per size.

A variant's run holds its errors as curves over the number of samples, so that MLflow draws a line
for each. A size's run holds the settings, the losses over the epochs, the samples, the weights, and
the errors of every seed, as a table and as curves over the seeds.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from iksamples.answer.collect import WORKSPACE, Variant, variants
from iksamples.answer.sentences import unproved
from iksamples.files import checked
from iksamples.paper.equations import paper_table
from iksamples.results import Cell
from iksamples.samples.dataset import SampleSet
from iksamples.study import NETWORK, Study


CURVE_POINTS = 100
_STATISTICS = ("error_mean_mm", "error_p95_mm", "error_max_mm")
_LOSSES = ("train_loss", "validation_loss")

Metric = tuple[str, float, int]
"""Name, value and step; a step is a number of samples, an epoch or a seed."""


@dataclass(frozen=True)
class RunContent:
    """Everything one run holds.

    Attributes:
        name: Shown name, which no other run of the study has.
        kind: What the run stands for.
        parent: Name of the run it hangs below.
        note: Description (Markdown).
        params: Settings by name.
        metrics: Its numbers. What stands before a slash is the section of MLflow's page.
        texts: Content of further files by their name.
        files: Files that go with the run.
        samples: What the networks learnt from.
        colour: Colour of the run's curves (#rrggbb), else MLflow picks one.
        failed: Why there is no result at all; empty: there is one.
    """

    name: str
    kind: Literal["variant", "size"]
    parent: str | None
    note: str
    params: dict[str, str]
    metrics: list[Metric]
    texts: dict[str, str] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    samples: SampleSet | None = None
    colour: str = ""
    failed: str = ""

    def digest(self) -> str:
        """Twelve hexadecimal digits of everything the run holds."""
        parts = (self.kind, self.note, self.params, self.metrics, self.texts, self.colour)
        content = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
        for path in self.files:
            content.update(path.name.encode() + path.read_bytes())
        return content.hexdigest()[:12]


def study_runs(study: Study, results: Path, runs: pd.DataFrame) -> Iterator[RunContent]:
    """Every run of a study, parents before their children.

    Args:
        study: The study.
        results: Its results folder.
        runs: Its tidy table (``answer.collect.read_runs``).
    """
    if study.paper:
        yield _paper_run(study)
    for variant, rows in variants(runs).items():
        sizes = [
            _size_run(study, results, variant, own) for _, own in rows.groupby("label", sort=False)
        ]
        yield _variant_run(study, variant, sizes)
        yield from sizes


def own_run(study: Study) -> str:
    """Name of the run of the study's own network on its first design."""
    return _variant_name(study, Variant(NETWORK, study.samples.design))


def _variant_run(study: Study, variant: Variant, sizes: list[RunContent]) -> RunContent:
    """A variant's run: the errors of its sizes as curves over the number of samples."""
    return RunContent(
        _variant_name(study, variant),
        "variant",
        None,
        "Errors [mm] over the number of samples, which is the step; means over the seeds.",
        _settings(study, variant),
        [metric for size in sizes for metric in size.metrics if _is_error(metric)],
        # Without the address of the store, which may hold a password.
        {"study.json": study.model_dump_json(indent=2, exclude={"tracking"})},
    )


def _size_run(study: Study, results: Path, variant: Variant, rows: pd.DataFrame) -> RunContent:
    """The run of a variant on one set of samples."""
    cell = Cell(study, results, variant.method, str(rows["label"].iloc[0]))
    first = rows.iloc[0]
    n = int(first["n_samples"])
    sound = rows[rows["failed"].eq("")]
    of_seeds = rows.drop_duplicates("seed")
    metrics = [*_errors(sound, n), ("n_failed", float(of_seeds["failed"].ne("").sum()), n)]
    metrics.append(("n_unproved", float(sound["unproved"].ne("").sum()), n))
    recorded = study.samples.recorded is not None
    trained = cell.trained and not recorded
    if trained:
        history = cell.table("history")
        metrics += _losses(history[history["seed"].isin(sound["seed"])])
        metrics += _by_seed(sound)
    settings = _settings(study, variant) | {
        "label": cell.label,
        "n_samples": str(n),
        "n_trained": str(first["n_trained"]),
        "n_seeds": str(len(of_seeds)),
        "fill_distance_mm": f"{first['fill_distance_mm']:.6g}",
    }
    own = [checked(cell.folder / name) for name in ("weights.safetensors", "history.parquet")]
    return RunContent(
        f"{_variant_name(study, variant)}, {cell.label}",
        "size",
        _variant_name(study, variant),
        "Means over the seeds; `seeds.csv` has the errors [mm] of each, and under `seeds` they are "
        "curves whose step is the seed. The step of a loss is the epoch, of an error the number of "
        f"samples. {' '.join(unproved(sound))}".strip(),
        settings,
        [metric for metric in metrics if np.isfinite(metric[1])],
        {"seeds.csv": rows.to_csv(index=False)},
        () if recorded else (cell.samples_path, *(own if trained else [])),
        None if recorded else cell.samples,
        failed=str(first["failed"]) if sound.empty else "",
    )


def _paper_run(study: Study) -> RunContent:
    """The paper's Table 1 as one more line."""
    table = paper_table()
    path = next(iter(study.evaluation.paths))
    return RunContent(
        "paper, Table 1",
        "variant",
        None,
        "What the paper prints (arXiv 2605.23583), for its own path and networks.",
        {"method": "paper"},
        [
            (f"{path}/error_mean_mm", row["paper_error_mm"], int(row["n_samples"]))
            for row in table.to_dict("records")
        ],
        colour="#969696",
    )


def _variant_name(study: Study, variant: Variant) -> str:
    one_design = len(study.samples.designs) == 1
    return variant.method if one_design else f"{variant.method} on {variant.design}"


def _settings(study: Study, variant: Variant) -> dict[str, str]:
    """Settings of a variant; numbers as plain numbers."""
    method = study.all_methods[variant.method]
    settings = {
        "method": variant.method,
        "kind": method.kind,
        "design": variant.design,
        "robot": Path(study.robot.urdf).stem,
        "normalisation": study.samples.normalisation,
    }
    if method.kind != "network":
        return settings
    network, training = method.network, method.training
    stopping = training.early_stopping
    return settings | {
        "hidden": "-".join(map(str, network.hidden)) or "none",
        "activation": network.activation,
        "optimizer": training.optimizer,
        "learning_rate": f"{training.learning_rate:g}",
        "batch_size": str(training.batch_size),
        **({"steps": str(training.steps)} if training.steps else {"epochs": str(training.epochs)}),
        "early_stopping_patience": str(stopping.patience) if stopping else "off",
        "held_out": training.held_out.source,
    }


def _errors(sound: pd.DataFrame, n: int) -> Iterator[Metric]:
    """Errors of one size: for each region means over the sound seeds, and what is proved."""
    for region in sound["region"].unique():
        rows = sound[sound["region"] == region]
        for name in _STATISTICS:
            yield f"{region}/{name}", float(rows[name].mean()), n
        if region == WORKSPACE:
            yield f"{region}/sup_median_mm", float(rows["sup_upper_mm"].median()), n
            yield f"{region}/sup_worst_mm", float(rows["sup_upper_mm"].max(skipna=False)), n


def _is_error(metric: Metric) -> bool:
    return not metric[0].startswith(("loss/", "seeds/"))


def _by_seed(sound: pd.DataFrame) -> Iterator[Metric]:
    """The errors of each seed, with the seed as step: seeds can be compared between runs."""
    for row in sound.to_dict("records"):
        for name in ("error_mean_mm", "error_max_mm"):
            yield f"seeds/{row['region']}_{name}", float(row[name]), int(row["seed"])


def _losses(history: pd.DataFrame) -> Iterator[Metric]:
    """The losses over the epochs, means over the seeds, thinned to some hundred points."""
    means = history.groupby("epoch", as_index=False)[list(_LOSSES)].mean()
    if means.empty:
        return
    at = np.unique(np.linspace(0, len(means) - 1, CURVE_POINTS).round().astype(int))
    for name in _LOSSES:
        for epoch, value in zip(means["epoch"].iloc[at], means[name].iloc[at], strict=True):
            yield f"loss/{name}", float(value), int(epoch)
