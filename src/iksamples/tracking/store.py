"""Puts runs into MLflow so that doing it twice changes nothing, and nothing is ever deleted."""

import getpass
import hashlib
import json
import os
import platform
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iksamples.errors import IksamplesError
from iksamples.study.section import without_password
from iksamples.tracking.content import RunContent


if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment, Run

KEY = "iksamples.key"
OWNER = "iksamples.owner"
CURRENT = "iksamples.current"
_PARENT = "mlflow.parentRunId"
# What the tracking service takes in one call.
_METRICS_AT_ONCE = 1000
_RUNS_AT_ONCE = 1000


@dataclass
class Outcome:
    """What became of the runs.

    Attributes:
        run_ids: MLflow's run id by name.
        logged: Runs written now.
        kept: Runs that were there with the same content.
        outdated: Runs of this owner that are no longer part of the study, and now say so.
    """

    run_ids: dict[str, str]
    logged: int = 0
    kept: int = 0
    outdated: int = 0


def owner() -> str:
    """Whose runs these are: the user, and digits for this machine and folder.

    On a shared server two people may have a study of the same name; neither touches what belongs
    to the other.
    """
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in some containers
        user = str(os.getuid())
    place = hashlib.sha256(f"{platform.node()}:{Path.cwd().resolve()}".encode())
    return f"{re.sub('[^A-Za-z0-9_-]', '-', user)[:32]}-{place.hexdigest()[:8]}"


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


def log_runs(
    client: "MlflowClient",
    where: "Experiment",
    whose: str,
    contents: Iterable[RunContent],
    tags: dict[str, str],
) -> Outcome:
    """Logs the runs that an owner does not have yet, and marks which of theirs are current.

    A run's key is its owner, name and content. A run with that key stays as it is, with what people
    noted on it; another content is another run, and the older one stays, no longer marked current.

    Args:
        client: The store.
        where: The experiment.
        whose: The owner; nobody else's run is looked at.
        contents: The runs of the study, parents before their children.
        tags: Further tags of runs that are written now.
    """
    known = {run.data.tags[KEY]: run for run in _runs_of(client, where, whose)}
    now_ms = time.time_ns() // 1_000_000
    outcome = Outcome({})
    for i, content in enumerate(contents):
        key = f"{whose}/{content.name}/{content.digest()}"
        marks = {KEY: key, OWNER: whose, CURRENT: "true"}
        if content.parent:
            marks[_PARENT] = outcome.run_ids[content.parent]
        run = known.pop(key, None)
        if run and run.info.status == "FINISHED":
            outcome.kept += 1
            run_id = run.info.run_id
            _mark(client, run, marks)
        else:  # not there, or cut off
            outcome.logged += 1
            run_id = _log(client, where, content, {**tags, **marks}, now_ms - i)
            if run:
                _give_up(client, run)
        outcome.run_ids[content.name] = run_id
    for run in known.values():
        outcome.outdated += run.data.tags[CURRENT] == "true"
        _give_up(client, run)
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

    tags = {"iksamples.kind": content.kind, "mlflow.note.content": content.note, **tags}
    if content.colour:
        tags["mlflow.runColor"] = content.colour
    run_id = str(client.create_run(where.experiment_id, start_ms, tags, content.name).info.run_id)
    metrics = [Metric(name, value, start_ms, step) for name, value, step in content.metrics]
    params = [Param(name, value) for name, value in content.params.items()]
    for first in range(0, max(len(metrics), 1), _METRICS_AT_ONCE):
        some = metrics[first : first + _METRICS_AT_ONCE]
        client.log_batch(run_id, some, params if first == 0 else [])
    if content.samples:
        context = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(_dataset(content), context)])
    for name, text in content.texts.items():
        client.log_text(run_id, text, name)
    for path in content.files:
        client.log_artifact(run_id, str(path))
    client.set_terminated(run_id, end_time=start_ms)
    return run_id


def _mark(client: "MlflowClient", run: "Run", marks: dict[str, str]) -> None:
    for name, value in marks.items():
        if run.data.tags.get(name) != value:
            client.set_tag(run.info.run_id, name, value)


def _give_up(client: "MlflowClient", run: "Run") -> None:
    """Marks an owner's own run as no longer part of the study, and ends it if it was cut off."""
    _mark(client, run, {CURRENT: "false"})
    if run.info.status == "RUNNING":
        client.set_terminated(run.info.run_id, "KILLED")


def _dataset(content: RunContent) -> Any:
    """MLflow's entity of a run's samples."""
    from mlflow.entities import Dataset

    samples, file = content.samples, content.files[0]
    assert samples is not None
    return Dataset(
        samples.label,
        samples.digest(),
        "local",
        json.dumps({"uri": str(file)}),
        profile=json.dumps({"num_rows": samples.n_samples}),
    )


def _runs_of(client: "MlflowClient", where: "Experiment", whose: str) -> "Iterator[Run]":
    token = None
    while True:
        page = client.search_runs(
            [where.experiment_id],
            f"tags.`{OWNER}` = '{whose}'",
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
