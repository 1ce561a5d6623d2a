"""Logs a study to MLflow: the one process that writes to the tracking store."""

import json
import logging
import os
from pathlib import Path

from iksamples.answer.answer import FILE as ANSWER
from iksamples.answer.collect import read_runs
from iksamples.errors import IksamplesError
from iksamples.export.logged import log_network
from iksamples.study import Study
from iksamples.study.section import without_password
from iksamples.tracking.content import own_run, study_runs
from iksamples.tracking.store import (
    Outcome,
    connect,
    experiment,
    failing_plainly,
    log_runs,
    owner,
)
from iksamples.tracking.view import page, view_tag


DEFAULT_URI = "sqlite:///mlflow.db"
"""What a plain ``mlflow ui`` in the same folder shows."""

# What keeps MLflow's page from asking what kind of experiment this is.
MODEL_TRAINING = "custom_model_development"


def track(study: Study, results: str | Path, output: str | Path) -> Outcome:
    """Logs a study to the MLflow experiment of its name, but for what is there already.

    One run per variant, below it one per number of samples. It can be done again at any time, also
    after it was cut off, and by several people on one server.

    Args:
        study: The study.
        results: Its results folder.
        output: Manifest to write (JSON): where the runs are, each run's id, and the page that
            compares the variants.

    Raises:
        IksamplesError: The tracking store cannot be used, or the study is not finished.
    """
    # Before the first import of MLflow, which reads it then.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    # Its lines would name the store, password included, once per run.
    os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"
    for noisy in ("alembic", "mlflow.store.db.utils", "urllib3.connectionpool"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    # All of it read first, so that a missing file stops this before anything is written.
    contents = list(study_runs(study, Path(results), read_runs(results)))
    uri, whose = tracking_uri(study), owner()
    client = connect(uri)
    with failing_plainly(uri):
        where = experiment(client, study.name)
        outcome = log_runs(client, where, whose, contents, source_tags(study))
        if (Path(results) / ANSWER).exists():
            log_network(client, outcome.run_ids[own_run(study)], Path(results))
        client.set_experiment_tag(
            where.experiment_id, *view_tag(study, whose, int(where.creation_time or 0))
        )
        about = {
            "mlflow.experimentKind": MODEL_TRAINING,
            "mlflow.note.content": _note(study, page(where.experiment_id, whose)),
        }
        for name in about.keys() - where.tags.keys():  # what people wrote there stays
            client.set_experiment_tag(where.experiment_id, name, about[name])
    manifest = {
        "tracking_uri": without_password(uri),
        "experiment": where.name,
        "experiment_id": where.experiment_id,
        "page": page(where.experiment_id, whose),
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


def _note(study: Study, charts: str) -> str:
    """What the experiment's page says; it shows the first line until asked for more."""
    return (
        "How the position error of a learned inverse kinematics falls with more samples: "
        f"[charts]({charts}).\n\n"
        f"{study.title}\n\n"
        "One run per variant (a method on samples placed by a design), below it one per number of "
        "samples. `seeds.csv` there has the errors of every network. Lengths in mm, losses in rad²."
    )
