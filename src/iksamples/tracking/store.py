"""Puts runs into MLflow so that doing it twice changes nothing, and nothing is ever deleted.

A run's key is a tag that it has from its first moment. What is asked of a store a second time,
since it failed or since its answer was lost on the way, therefore finds what the first time left.
"""

import getpass
import hashlib
import json
import logging
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from filelock import FileLock

from iksamples.errors import IksamplesError
from iksamples.study.sections import without_password
from iksamples.tracking.content import RunContent


if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment, Run

_Thing = TypeVar("_Thing")

KEY = "iksamples.key"
OWNER = "iksamples.owner"
CURRENT = "iksamples.current"
_PARENT = "mlflow.parentRunId"
_WHOLE = ("FINISHED", "FAILED")
"""Status of a run that holds all that it is to hold; FAILED: of a method that has no result."""
# What the tracking service takes in one call.
_METRICS_AT_ONCE = 1000
_RUNS_AT_ONCE = 1000
_RETRIES = "MLFLOW_HTTP_REQUEST_MAX_RETRIES"
_TIMEOUT = "MLFLOW_HTTP_REQUEST_TIMEOUT"
_PATIENCE = {
    _RETRIES: "2",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    _TIMEOUT: "10",
}
"""A server that is gone is said to be after seconds, not MLflow's minutes; unless set otherwise."""
_WAITS_S = (0.5, 1.0, 2.0)
"""Before what may not simply be sent again is looked for, and done again if it is not there."""


class StoreError(IksamplesError):
    """The tracking store cannot be used, as far as can be told not for good."""


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


def prepare() -> None:
    """Sets MLflow up, before its first import: quiet, without telemetry, and not too patient."""
    for name, value in {**_PATIENCE, "MLFLOW_DISABLE_TELEMETRY": "true"}.items():
        os.environ.setdefault(name, value)
    # Its lines would name the store, password included, once per run.
    os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"
    for noisy in ("alembic", "mlflow.store.db.utils", "urllib3.connectionpool"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


def connect(uri: str) -> "MlflowClient":
    """Opens a tracking store, and makes it where it is a new SQLite file.

    Raises:
        IksamplesError: It cannot be reached or is not a tracking store.
    """
    prepare()
    with failing_plainly(uri, Exception):  # each driver has errors of its own
        _make_sqlite_file(uri)
        _require_answer(uri)
        return _ask(uri)


def experiment(client: "MlflowClient", name: str) -> "Experiment":
    """The experiment of a name, made, or fetched back from the trash, if need be."""
    found = client.get_experiment_by_name(name) or _made_once(
        lambda: client.get_experiment(client.create_experiment(name)),
        lambda: client.get_experiment_by_name(name),
    )
    if found.lifecycle_stage != "active":
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
    # Whole runs first, else the oldest: should there be two with one key, one of them counts.
    found = sorted(
        _runs_of(client, where, OWNER, whose),
        key=lambda run: (run.info.status not in _WHOLE, run.info.start_time, run.info.run_id),
    )
    known = {run.data.tags[KEY]: run for run in reversed(found)}
    now_ms = time.time_ns() // 1_000_000
    outcome = Outcome({})
    for i, content in enumerate(contents):
        key = f"{whose}/{content.name}/{content.digest()}"
        marks = {KEY: key, OWNER: whose, CURRENT: "true"}
        if content.parent:
            marks[_PARENT] = outcome.run_ids[content.parent]
        run = known.get(key)
        if run and run.info.status in _WHOLE:
            outcome.kept += 1
        else:  # not there, or cut off
            outcome.logged += 1
            run = _log(client, where, content, {**tags, **marks}, now_ms - i, run)
        _mark(client, run, marks)
        outcome.run_ids[content.name] = run.info.run_id
    current = set(outcome.run_ids.values())
    for run in found:
        if run.info.run_id not in current:
            outcome.outdated += run.data.tags[CURRENT] == "true"
            _give_up(client, run)
    return outcome


@contextmanager
def failing_plainly(uri: str, *more: type[Exception]) -> Iterator[None]:
    """Turns what MLflow and its stores raise, and more if asked, into one line for people."""
    from mlflow.exceptions import MlflowException
    from requests import RequestException
    from sqlalchemy.exc import SQLAlchemyError

    raised: tuple[type[Exception], ...]
    raised = (MlflowException, RequestException, SQLAlchemyError, OSError, *more)
    try:
        yield
    except IksamplesError:
        raise
    except raised as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        if "Max retries exceeded" in reason:
            reason = "no answer"
        reason = without_password(reason.replace(uri, without_password(uri)))
        raise StoreError(
            f"tracking.uri: cannot use {without_password(uri)} ({reason[:200]}). Start that server "
            "or name another store; the next run goes on with what is not logged yet."
        ) from None


def _log(
    client: "MlflowClient",
    where: "Experiment",
    content: RunContent,
    tags: dict[str, str],
    start_ms: int,
    run: "Run | None",
) -> "Run":
    """Writes a run, or all of one that was cut off: a store keeps what is the same once."""
    from mlflow.entities import DatasetInput, InputTag, Metric, Param

    tags = {"iksamples.kind": content.kind, "mlflow.note.content": content.note, **tags}
    if content.failed:
        tags["iksamples.failed"] = content.failed
    if content.colour:
        tags["mlflow.runColor"] = content.colour
    run = run or _made_once(
        lambda: client.create_run(where.experiment_id, start_ms, tags, content.name),
        lambda: next(_runs_of(client, where, KEY, tags[KEY]), None),
    )
    run_id, start_ms = run.info.run_id, run.info.start_time
    metrics = [Metric(name, value, start_ms, step) for name, value, step in content.metrics]
    params = [Param(name, value) for name, value in content.params.items()]
    for first in range(0, max(len(metrics), 1), _METRICS_AT_ONCE):
        some = metrics[first : first + _METRICS_AT_ONCE]
        client.log_batch(run_id, some, params if first == 0 else [])
    if content.samples:
        context = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(_dataset(content), context)])
    # As a folder: a kill leaves a file that goes alone under another name, for good.
    with TemporaryDirectory() as folder:
        for name, text in content.texts.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        for path in content.files:
            shutil.copy(path, folder)
        client.log_artifacts(run_id, folder)
    client.set_terminated(run_id, "FAILED" if content.failed else "FINISHED", start_ms)
    return run


def _made_once(make: "Callable[[], _Thing]", find: "Callable[[], _Thing | None]") -> "_Thing":
    """Makes what was not there a moment ago.

    After a failure it is looked for before it is made again: it may be there, made by this call,
    whose answer was lost, or by somebody else.
    """
    from mlflow.exceptions import MlflowException

    for wait_s in _WAITS_S:
        patience = os.environ[_RETRIES]
        os.environ[_RETRIES] = "0"  # MLflow would send it again as it is
        try:
            return make()
        except MlflowException:
            time.sleep(wait_s)
        finally:
            os.environ[_RETRIES] = patience
        if (found := find()) is not None:
            return found
    return make()


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


def _runs_of(client: "MlflowClient", where: "Experiment", tag: str, value: str) -> "Iterator[Run]":
    token = None
    while True:
        page = client.search_runs(
            [where.experiment_id],
            f"tags.`{tag}` = '{value}'",
            max_results=_RUNS_AT_ONCE,
            page_token=token,
        )
        yield from page
        token = page.token
        if not token:
            return


def _ask(uri: str) -> "MlflowClient":
    """A client whose store has answered, and is whole if it is a SQLite file."""
    from mlflow import MlflowClient

    client = MlflowClient(uri)
    client.search_experiments(max_results=1)
    return client


def _require_answer(uri: str) -> None:
    """Asks a database on a server once; MLflow asks ten times, which takes two minutes."""
    from sqlalchemy.engine import create_engine, make_url

    if uri.startswith(("postgresql", "mysql")):
        url = make_url(uri)
        patience = {"connect_timeout": os.environ[_TIMEOUT], **url.query}
        create_engine(url.set(query=patience)).connect().close()


def _make_sqlite_file(uri: str) -> None:
    """Makes a missing SQLite file beside its place and moves it there when it is whole.

    MLflow needs seconds to make one, cannot open one it was stopped at, and two of it spoil it.

    Raises:
        IksamplesError: A database without a file.
    """
    from sqlalchemy.engine import make_url

    if not uri.startswith("sqlite"):
        return
    database = make_url(uri).database
    if database in (None, "", ":memory:"):
        raise IksamplesError(
            f"tracking.uri: {uri} would be gone at the end; name a file, as in sqlite:///mlflow.db."
        )
    path = Path(str(database))
    # A folder, since SQLite keeps a journal beside an unfinished file.
    unfinished = path.with_name(f".unfinished-{path.name}")
    lock = path.with_name(f".{path.name}.lock")
    # A kill right after the store got its name leaves the other two.
    if path.exists() and not (unfinished.exists() or lock.exists()):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(lock):
        shutil.rmtree(unfinished, ignore_errors=True)
        if not path.exists():
            unfinished.mkdir()
            try:
                _ask(f"sqlite:///{unfinished / path.name}")
                with suppress(FileExistsError):
                    os.link(unfinished / path.name, path)  # unlike a rename, never over a file
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)
        # Whoever still waits for this lock, or makes another, finds the store made.
        lock.unlink()
