"""Which reading of the paper gives its Table 1: a random search, and its best with fresh seeds.

A reading takes one option for each question of ``options.QUESTIONS``. A search's own winners are
too good, since the luck of their seeds was part of the choice; so they are trained again with seeds
that had no part in it, and only those numbers are ranked.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iksamples.columns import stored_table
from iksamples.errors import IksamplesError
from iksamples.paper.equations import paper_table
from iksamples.paper.options import QUESTIONS, Option
from iksamples.study import Readings, Study, parse_study


ROWS = ("n_samples", "n_seeds", "n_diverged", "error_mean_mm", "error_sd_mm")
"""Columns of a reading's table, a row per grid."""

DENIABLE = [
    question
    for question, options in QUESTIONS.items()
    if any(option.standing == "contradicts" for option in options)
]
"""Questions that some option answers against the paper's words."""

FRESH_SEED = 10_000
"""First seed of the readings that are trained again; the search counts from 0."""
_MOST_CONTRADICTIONS = 3
_ENOUGH_DRAWS = 1000
_PATH = "read"


@dataclass(frozen=True)
class Reading:
    """One option for each question.

    Attributes:
        options: The chosen options, in the order of ``QUESTIONS``.
    """

    options: tuple[Option, ...]

    @classmethod
    def named(cls, **names: str) -> "Reading":
        """A reading by its options' names; a question that is not named takes its first option."""
        return cls(
            tuple(
                next(option for option in options if option.name == names[question])
                if question in names
                else options[0]
                for question, options in QUESTIONS.items()
            )
        )

    @property
    def names(self) -> dict[str, str]:
        """The name of each question's option."""
        return {q: option.name for q, option in zip(QUESTIONS, self.options, strict=True)}

    @property
    def contradicted(self) -> list[str]:
        """The questions it answers against the paper's words."""
        pairs = zip(QUESTIONS, self.options, strict=True)
        return [question for question, option in pairs if option.standing == "contradicts"]

    @property
    def possible(self) -> bool:
        """Whether its options go together: nothing is held out of 8 samples to stop early by."""
        options = {q: option.value for q, option in zip(QUESTIONS, self.options, strict=True)}
        return not (options["stopping"] and options["held out"] == "grid")

    def settings(self) -> dict[str, Any]:
        """What a study file would say."""
        value = {q: option.value for q, option in zip(QUESTIONS, self.options, strict=True)}
        lower, upper = value["workspace"]
        return {
            "workspace": {"lower_mm": lower, "upper_mm": upper},
            "samples": {"normalisation": value["inputs"]},
            "network": {"hidden": value["neurons"], "activation": value["activation"]},
            "training": {
                "epochs": value["epochs"],
                "batch_size": value["batch"],
                "learning_rate": value["rate"],
                "held_out": {"source": value["held out"]},
                "snapshots": 2,
                **value["stopping"],
            },
            "evaluation": {"paths": {_PATH: _path(value["path"], lower, upper)}},
        }

    def study(self, n_seeds: int, first_seed: int = 0) -> Study:
        """The study of this reading."""
        settings = self.settings()
        settings["training"] |= {"seeds": n_seeds, "first_seed": first_seed}
        return parse_study({"name": "reading", **settings}, "reading")


def draw_readings(wanted: Readings) -> list[Reading]:
    """The reading to the letter, and different ones at random.

    As many contradict none of the paper's words as contradict one, two or three.

    Raises:
        IksamplesError: There are not so many.
    """
    generator = np.random.default_rng(wanted.seed)
    found = {Reading.named(): None}
    known = 0  # draws in a row that brought nothing new
    while len(found) < wanted.count and known < _ENOUGH_DRAWS:
        n_denied = generator.integers(_MOST_CONTRADICTIONS + 1)
        denied = generator.choice(DENIABLE, n_denied, replace=False)
        pools = [
            [option for option in options if (option.standing == "contradicts") == (q in denied)]
            for q, options in QUESTIONS.items()
        ]
        reading = Reading(tuple(pool[generator.integers(len(pool))] for pool in pools))
        known += 1
        if reading.possible and reading not in found:
            found[reading] = None
            known = 0
    if len(found) < wanted.count:
        raise IksamplesError(
            f"readings.count: the options make hardly more than {len(found)} readings; ask for "
            "fewer."
        )
    return list(found)


def most_chosen(wanted: Readings) -> int:
    """How many readings ``choose`` may choose, at most: one for each of its reasons."""
    kept = len(DENIABLE) * (len(DENIABLE) + 1) // 2
    return min(wanted.count, wanted.best + _MOST_CONTRADICTIONS + 1 + kept + 1)


def search_part(wanted: Readings, part: int) -> pd.DataFrame:
    """Trains one of ``wanted.jobs`` parts of the search; see ``train_readings``."""
    return train_readings(draw_readings(wanted)[part :: wanted.jobs], wanted.seeds)


def confirm_part(wanted: Readings, searched: pd.DataFrame, part: int) -> pd.DataFrame:
    """Trains one of ``wanted.jobs`` parts of the chosen readings again, with fresh seeds.

    Args:
        wanted: The study's section.
        searched: All parts of the search.
        part: Which part.
    """
    chosen = choose(searched, wanted.best)[part :: wanted.jobs]
    return train_readings(chosen, wanted.fresh_seeds, FRESH_SEED)


def choose(searched: pd.DataFrame, best: int) -> list[Reading]:
    """Readings that are worth fresh seeds.

    They are the best ones; the best one for each number of contradictions; the best one that keeps
    the paper's words on each question, and on each two of them; and the letter.

    Args:
        searched: What ``train_readings`` returned.
        best: How many of the best.
    """
    ranked = rank(searched)
    contradicted = ranked["contradicts"].str.split(", ")
    wanted = [
        ranked.head(best),
        ranked.drop_duplicates("n_contradicted"),
        *(
            ranked[[not kept.intersection(c) for c in contradicted]].head(1)
            for kept in map(set, combinations_with_replacement(DENIABLE, 2))
        ),
    ]
    letter = Reading.named()
    readings = [_reading_of(row) for rows in wanted for row in _records(rows)]
    return list(dict.fromkeys([*readings, letter]))


def rank(rows: pd.DataFrame) -> pd.DataFrame:
    """Readings by how far their rows are from Table 1, nearest first.

    Args:
        rows: What ``train_readings`` returned.

    Returns:
        One row per reading: the option of each question, ``contradicts`` (the questions answered
        against the paper's words, with commas), ``n_contradicted``, what ``compare`` found, and
        ``error_<n>_mm`` and ``sd_<n>_mm`` for each number of samples.
    """
    ranked = []
    for names, of_reading in rows.groupby(list(QUESTIONS), sort=False):
        reading = Reading.named(**dict(zip(QUESTIONS, map(str, names), strict=True)))
        numbers = {
            f"{what}_{row['n_samples']}_mm": row[f"error_{column}_mm"]
            for row in of_reading.to_dict("records")
            for what, column in (("error", "mean"), ("sd", "sd"))
        }
        denied = reading.contradicted
        ranked.append(
            {
                **reading.names,
                "contradicts": ", ".join(denied),
                "n_contradicted": len(denied),
                **compare(of_reading),
                **numbers,
            }
        )
    return pd.DataFrame(ranked).sort_values("off_sd", kind="stable", ignore_index=True)


def best_reading(rows: pd.DataFrame) -> str:
    """The nearest reading as JSON, which ``kept_reading`` reads where the package ships it.

    Args:
        rows: What ``train_readings`` returned for the readings with fresh seeds.
    """
    reading = _reading_of(_records(rank(rows))[0])
    own = rows
    for question, name in reading.names.items():
        own = own[own[question] == name]
    content = {
        "made_by": "snakemake --cores 2 --configfile config/studies/readings.yaml",
        "first_seed": FRESH_SEED,
        "options": reading.names,
        "contradicts": reading.contradicted,
        "rows": own[list(ROWS)].to_dict("records"),
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def read_parts(files: Sequence[Path]) -> pd.DataFrame:
    """The parts of a search or of its confirmation as one table."""
    kinds: dict[str, type] = dict.fromkeys(QUESTIONS, str)  # "16" is the name of an option
    kinds |= dict.fromkeys(ROWS, int) | dict.fromkeys(ROWS[-2:], float)
    tables = []
    for file in files:
        table = stored_table(file, tuple(kinds), dtype=kinds)
        for question, options in QUESTIONS.items():
            if not table[question].isin([option.name for option in options]).all():
                raise IksamplesError(f"{file}: '{question}' has an option that is not known here.")
        if not table["n_samples"].isin(paper_table()["n_samples"]).all():
            raise IksamplesError(f"{file}: a number of samples that Table 1 does not have.")
        if (table["error_mean_mm"] <= 0).any():
            raise IksamplesError(f"{file}: an error that is not above zero.")
        tables.append(table)
    whole = pd.concat(tables, ignore_index=True)
    if whole.empty:
        raise IksamplesError(f"{files[0]}: no readings. Name all parts of the search.")
    return whole


def train_readings(readings: Sequence[Reading], n_seeds: int, first_seed: int = 0) -> pd.DataFrame:
    """The tables of some readings below each other, with the option of each question in front."""
    frames = [
        train_reading(reading, n_seeds, first_seed).assign(**reading.names) for reading in readings
    ]
    if not frames:
        return pd.DataFrame(columns=[*QUESTIONS, *ROWS])
    return pd.concat(frames, ignore_index=True)[[*QUESTIONS, *ROWS]]


def train_reading(reading: Reading, n_seeds: int, first_seed: int = 0) -> pd.DataFrame:
    """Table 1 as a reading gives it.

    Returns:
        One row per grid: n_samples, n_seeds, n_diverged, error_mean_mm and error_sd_mm (mean and
        standard deviation over seeds of a seed's mean error along the path).
    """
    study = reading.study(n_seeds, first_seed)
    rows = []
    for m in study.samples.points_per_axis:
        error_mm = path_errors(study, m)
        sound = error_mm[np.isfinite(error_mm)]
        rows.append(
            {
                "n_samples": m**3,
                "n_seeds": n_seeds,
                "n_diverged": n_seeds - len(sound),
                "error_mean_mm": sound.mean() if len(sound) else math.inf,
                "error_sd_mm": sound.std(ddof=1) if len(sound) > 1 else math.nan,
            }
        )
    return pd.DataFrame(rows)


def path_errors(study: Study, points_per_axis: int) -> np.ndarray:
    """Mean error of each seed of a study on one grid along its first path [mm], shape (seeds,)."""
    from iksamples.evaluation.errors import send
    from iksamples.evaluation.paths import waypoints
    from iksamples.samples.record import grid_samples
    from iksamples.task import study_task
    from iksamples.training.module import fit, make_engine
    from iksamples.training.problem import pose_problem
    from iksamples.training.record import final_network
    from iksamples.training.run import choose_engine

    task = study_task(study)
    samples = grid_samples(study, task, points_per_axis)
    problem = pose_problem(study, samples, study.seeds)
    record = fit(problem, make_engine(choose_engine(study, len(task.q)), problem))
    network = final_network(problem, samples, record)
    path = next(iter(study.evaluation.paths.values()))
    return np.asarray(send(network, task, waypoints(path, task).x).error_mm.mean(axis=1))


def compare(rows: pd.DataFrame) -> dict[str, float]:
    """How far seven rows are from the paper's.

    Args:
        rows: What ``train_reading`` returned.

    Returns:
        ``off_sd``: root mean square of the differences in units of the paper's ±; ``log_ratio``:
        root mean square of the logarithms of the ratios; ``within`` and ``within_twice``: rows that
        are inside the ± and inside twice the ±.
    """
    paper = paper_table().set_index("n_samples").loc[rows["n_samples"]]
    error = rows["error_mean_mm"].to_numpy(float)
    theirs = paper["paper_error_mm"].to_numpy(float)
    off = np.abs(error - theirs) / paper["paper_error_sd_mm"].to_numpy(float)
    return {
        "off_sd": float(np.sqrt(np.mean(np.square(off)))),
        "log_ratio": float(np.sqrt(np.mean(np.square(np.log(error / theirs))))),
        "within": int(np.sum(off <= 1)),
        "within_twice": int(np.sum(off <= 2)),
    }


def _path(value: Any, lower: Sequence[float], upper: Sequence[float]) -> dict[str, Any]:
    """The path's section of the study file."""
    if value == "heart":
        centre = [(low + high) / 2 for low, high in zip(lower, upper, strict=True)]
        return {"shape": "heart", "centre_mm": centre, "width_mm": 44.0}
    return {
        "shape": "double_rectangle",
        "lower_mm": [low + value for low in lower[:2]],
        "upper_mm": [high - value for high in upper[:2]],
        "heights_mm": [lower[2] + value, upper[2] - value],
    }


def _records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]


def _reading_of(row: Mapping[str, Any]) -> Reading:
    return Reading.named(**{question: row[question] for question in QUESTIONS})
