"""Puts runs into MLflow so that doing it twice changes nothing."""

import json
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iksamples.errors import IksamplesError
from iksamples.study.section import without_password
from iksamples.tracking.content import RunContent, Samples


if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment, Run

KEY = "iksamples.key"
DIGEST = "iksamples.digest"
_PARENT = "mlflow.parentRunId"
# What the tracking service takes in one call.
_METRICS_AT_ONCE = 1000
_RUNS_AT_ONCE = 1000


@dataclass
class Outcome:
    """What became of the runs.

    Attributes:
        run_ids: MLflow's run id by key.
        logged: Runs written now.
        kept: Runs that were there with the same content.
        removed: Runs that were outdated, left half-written, or no longer part of the study.
    """

    run_ids: dict[str, str]
    logged: int = 0
    kept: int = 0
    removed: int = 0


def connect(uri: str) -> "MlflowClient":
    """Opens a tracking store, and makes it where it is a new SQLite file.

    Raises:
        IksamplesError: It cannot be reached or is not a tracking store.
    """
    from mlflow import MlflowClient

    with failing_plainly(uri), _few_retries():
        _make_sqlite_file(uri)
        client = MlflowClient(uri)
        client.search_experiments(max_results=1)
    return client


def experiment(client: "MlflowClient", name: str) -> "Experiment":
    """The experiment of a name, made, or fetched back from the trash, if need be."""
    found = client.get_experiment_by_name(name)
    if found is None:
        found = client.get_experiment(client.create_experiment(name))
    elif found.lifecycle_stage != "active":
        client.restore_experiment(found.experiment_id)
    return found


def upsert(
    client: "MlflowClient",
    where: "Experiment",
    contents: Iterable[RunContent],
    tags: dict[str, str],
) -> Outcome:
    """Brings an experiment's runs in line with their content.

    A run with the same content stays untouched, with what people noted on it; any other run that
    carries one of our keys is replaced or removed. Runs without a key are somebody else's.

    Args:
        client: The store.
        where: The experiment.
        contents: The runs it is to have, parents before their children.
        tags: Further tags of runs that are written now.
    """
    known: dict[str, list[Run]] = {}
    for run in _runs_with_key(client, where):
        known.setdefault(run.data.tags[KEY], []).append(run)
    now_ms = time.time_ns() // 1_000_000
    outcome = Outcome({})
    for i, content in enumerate(contents):
        digest = content.digest()
        parent = {_PARENT: outcome.run_ids[content.parent]} if content.parent else {}
        kept = None
        for run in known.pop(content.key, []):
            # A run that is not finished was cut off.
            whole = run.info.status == "FINISHED" and run.data.tags.get(DIGEST) == digest
            if whole and kept is None:
                kept = run
            else:
                client.delete_run(run.info.run_id)
                outcome.removed += 1
        if kept:
            outcome.kept += 1
            outcome.run_ids[content.key] = kept.info.run_id
            for name, value in parent.items():
                if kept.data.tags.get(name) != value:
                    client.set_tag(kept.info.run_id, name, value)
            continue
        # MLflow lists the newest first and charts the ten newest: grids before any seed.
        start_ms = (int(where.creation_time or 0) if content.kind == "seed" else now_ms) - i
        tagged = {KEY: content.key, DIGEST: digest, **tags, **parent}
        outcome.run_ids[content.key] = _log(client, where, content, tagged, start_ms)
        outcome.logged += 1
    for run in (run for runs in known.values() for run in runs):
        client.delete_run(run.info.run_id)
        outcome.removed += 1
    return outcome


@contextmanager
def failing_plainly(uri: str) -> Iterator[None]:
    """Turns what MLflow and its stores raise into one line for people."""
    from mlflow.exceptions import MlflowException
    from requests import RequestException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (MlflowException, RequestException, SQLAlchemyError, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        if "Max retries exceeded" in reason:
            reason = "no answer"
        reason = without_password(reason.replace(uri, without_password(uri)))
        raise IksamplesError(
            f"tracking.uri: cannot use {without_password(uri)} ({reason[:200]}). Start that server "
            "or name another store; the next run goes on with what is not logged yet."
        ) from None


def _log(
    client: "MlflowClient",
    where: "Experiment",
    content: RunContent,
    tags: dict[str, str],
    start_ms: int,
) -> str:
    """Writes one run and says its id."""
    from mlflow.entities import DatasetInput, InputTag, Metric, Param

    tags = {"iksamples.kind": content.kind, **tags}
    if content.note:
        tags["mlflow.note.content"] = content.note
    if content.colour:
        tags["mlflow.runColor"] = content.colour
    run_id = client.create_run(where.experiment_id, start_ms, tags, content.name).info.run_id
    metrics = [Metric(name, value, start_ms, step) for name, value, step in content.metrics]
    params = [Param(name, value) for name, value in content.params.items()]
    client.log_batch(run_id, metrics[:_METRICS_AT_ONCE], params)
    for first in range(_METRICS_AT_ONCE, len(metrics), _METRICS_AT_ONCE):
        client.log_batch(run_id, metrics[first : first + _METRICS_AT_ONCE])
    if content.dataset:
        context = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(_dataset(content.dataset), context)])
    for path in content.artifacts:
        client.log_artifact(run_id, str(path))
    client.set_terminated(run_id, end_time=start_ms)
    return run_id


def _dataset(samples: Samples) -> Any:
    """MLflow's entity of a set of samples."""
    from mlflow.entities import Dataset

    columns = [{"type": "double", "name": name, "required": True} for name in samples.columns]
    profile = {"num_rows": samples.rows, "num_elements": samples.rows * len(columns)}
    return Dataset(
        samples.name,
        samples.digest,
        "local",
        json.dumps({"uri": str(samples.path)}),
        json.dumps({"mlflow_colspec": columns}),
        json.dumps(profile),
    )


def _runs_with_key(client: "MlflowClient", where: "Experiment") -> "Iterator[Run]":
    token = None
    while True:
        page = client.search_runs(
            [where.experiment_id],
            f"tags.`{KEY}` LIKE '%'",
            max_results=_RUNS_AT_ONCE,
            page_token=token,
        )
        yield from page
        token = page.token
        if not token:
            return


def _make_sqlite_file(uri: str) -> None:
    """Makes a missing SQLite file beside its place and moves it there when it is whole.

    MLflow needs seconds to make one and cannot open one it was stopped at.
    """
    from mlflow import MlflowClient
    from sqlalchemy.engine import make_url

    if not uri.startswith("sqlite:"):
        return
    database = make_url(uri).database
    if database in (None, "", ":memory:") or Path(str(database)).exists():
        return
    path = Path(str(database))
    # A folder, since SQLite keeps a journal beside an unfinished file.
    unfinished = path.with_name(f".unfinished-{path.name}")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        MlflowClient(f"sqlite:///{unfinished / path.name}").search_experiments(max_results=1)
        os.link(unfinished / path.name, path)  # unlike a rename, never over what came meanwhile
    except FileExistsError:
        pass
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def _few_retries() -> Iterator[None]:
    """Lets a server that does not answer fail in seconds instead of minutes."""
    limits = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}
    before = {name: os.environ.get(name) for name in limits}
    os.environ.update({name: before[name] or value for name, value in limits.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
