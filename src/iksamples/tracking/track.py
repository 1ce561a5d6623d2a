"""Logs a study to MLflow: the one process that writes to the tracking store."""

import json
import logging
import os
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote, urlencode

from iksamples.answer.answer import FILE as ANSWER
from iksamples.errors import IksamplesError
from iksamples.export.logged import log_network
from iksamples.results import Cell
from iksamples.study import Study
from iksamples.study.section import without_password
from iksamples.tracking.content import STUDY_KEY, study_runs
from iksamples.tracking.store import (
    Outcome,
    connect,
    experiment,
    failing_plainly,
    upsert,
)


DEFAULT_URI = "sqlite:///mlflow.db"
"""What a plain ``mlflow ui`` in the same folder shows."""

# What keeps MLflow's page from asking what kind of experiment this is.
MODEL_TRAINING = "custom_model_development"


def track(
    study: Study, cells: Iterable[Cell], table_path: str | Path, output: str | Path
) -> Outcome:
    """Brings a study's MLflow experiment in line with its results.

    The experiment has the study's name: one run for the study, below it one per grid, below that
    one per seed, and one for every other method. What is there already with the same content is
    kept, so that it can be done again at any time, also after it was cut off.

    Args:
        study: The study.
        cells: The results of each grid, smallest first.
        table_path: The study's ``table.csv``.
        output: Manifest to write (JSON): where the runs are, each run's id, and the page that
            compares the grids.

    Raises:
        IksamplesError: The tracking store cannot be used.
    """
    # Before the first import of MLflow, which reads it then.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    # Its lines would name the store, password included, once per run.
    os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"
    for noisy in ("alembic", "mlflow.store.db.utils", "urllib3.connectionpool"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    # All of it read first, so that a missing file stops this before anything is written.
    contents = list(study_runs(study, cells, Path(table_path)))
    uri = tracking_uri(study)
    client = connect(uri)
    with failing_plainly(uri):
        where = experiment(client, study.name)
        about = {
            "mlflow.experimentKind": MODEL_TRAINING,
            "mlflow.note.content": _note(study, where.experiment_id),
        }
        for name in about.keys() - where.tags.keys():  # what people wrote there stays
            client.set_experiment_tag(where.experiment_id, name, about[name])
        outcome = upsert(client, where, contents, source_tags(study))
        results = Path(table_path).parent
        if (results / ANSWER).exists():
            log_network(client, outcome.run_ids[STUDY_KEY], results)
    manifest = {
        "tracking_uri": without_password(uri),
        "experiment": where.name,
        "experiment_id": where.experiment_id,
        "page": page(where.experiment_id),
        "study": study.digest(),
        "runs": outcome.run_ids,
    }
    Path(output).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    return outcome


def tracking_uri(study: Study) -> str:
    """The study's tracking URI, or the environment's, or a SQLite file in the working folder.

    A study that a run has kept names the store without its password; the environment's address is
    used where it is the same but for that.

    Raises:
        IksamplesError: The password is nowhere.
    """
    asked, given = study.tracking.uri, os.environ.get("MLFLOW_TRACKING_URI")
    if given and (not asked or without_password(asked) == without_password(given)):
        return given
    if asked and "***" in asked:
        raise IksamplesError(
            f"tracking.uri: {asked} lacks its password, which no result keeps. Set "
            "MLFLOW_TRACKING_URI to the whole address."
        )
    return asked or DEFAULT_URI


def source_tags(study: Study) -> dict[str, str]:
    """Where runs come from: the study's settings and the working folder's git commit."""
    from mlflow.utils.git_utils import get_git_commit

    tags = {
        "iksamples.study": study.digest(),
        "mlflow.source.name": "iksamples",
        "mlflow.source.type": "LOCAL",
    }
    commit = get_git_commit(".")
    return tags | ({"mlflow.source.git.commit": commit} if commit else {})


def page(experiment_id: str) -> str:
    """The part of the address, after the server's, where MLflow's page charts the grids."""
    # Sorted by a metric, since MLflow folds runs below their parent when sorted by time.
    query = {
        "workflowType": "machine_learning",
        "compareRunsMode": "CHART",
        "searchFilter": "tags.`iksamples.kind` != 'seed'",
        "orderByKey": "metrics.`error_mean_mm`",
        "orderByAsc": "false",
    }
    return f"#/experiments/{experiment_id}/runs?{urlencode(query, quote_via=quote)}"


def _note(study: Study, experiment_id: str) -> str:
    """What the experiment's page says; it shows the first line until asked for more."""
    return (
        "How the position error of a learned inverse kinematics falls with more samples: "
        f"[charts]({page(experiment_id)}).\n\n"
        f"{study.title}\n\n"
        "One run for the study, below it one per grid, below each grid one per seed, and one for "
        "every other method. The step of "
        "an error is the number of samples, the step of a loss is the epoch. Lengths in mm, losses "
        "in rad²."
    )
