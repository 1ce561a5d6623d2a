"""One tracking store for many: at once, on a server that fails, and nothing lost or doubled."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from tracking_server import Server, mlflow_server

from iksamples.errors import IksamplesError
from iksamples.tracking.content import RunContent
from iksamples.tracking.store import (
    KEY,
    Outcome,
    connect,
    experiment,
    failing_plainly,
    log_runs,
)


pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:starlette.middleware.wsgi"),
]

os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"

CONTENTS = [
    RunContent("network", "variant", None, "a note", {"kind": "network"}, [("error_mm", 2.5, 8)]),
    RunContent("network, grid2", "size", "network", "", {"n": "8"}, [("error_mm", 2.5, 8)]),
    RunContent(
        "network, grid3",
        "size",
        "network",
        "",
        {"n": "27"},
        [("error_mm", 1.5, 27), *(("loss", 1 / epoch, epoch) for epoch in range(1, 1200))],
        {"seeds.csv": "seed\n1\n"},
    ),
]


def log(uri: str, whose: str = "me", name: str = "small") -> Outcome:
    client = connect(uri)
    return log_runs(client, experiment(client, name), whose, CONTENTS, {"extra": "1"})


def require_all_once(uri: str, owners: list[str], name: str = "small") -> None:
    """Every run of every owner is there, whole, once."""
    client = connect(uri)
    [found] = [one for one in client.search_experiments() if one.name == name]
    runs = list(client.search_runs([found.experiment_id], max_results=1000))
    keys = Counter(run.data.tags[KEY] for run in runs)
    assert set(keys.values()) == {1}
    assert Counter(run.info.run_name for run in runs) == dict.fromkeys(
        [content.name for content in CONTENTS], len(owners)
    )
    for run in runs:
        assert (run.info.status, run.data.tags["iksamples.current"]) == ("FINISHED", "true")
        owner = run.data.tags["iksamples.owner"]
        assert owner in owners
        content = next(one for one in CONTENTS if one.name == run.info.run_name)
        assert run.data.params == content.params
        assert run.data.tags["mlflow.note.content"] == content.note
        for metric in {name for name, _, _ in content.metrics}:
            kept = client.get_metric_history(run.info.run_id, metric)
            expected = [(value, step) for name, value, step in content.metrics if name == metric]
            assert [(one.value, one.step) for one in kept] == expected
        if content.parent:
            parent = client.get_run(run.data.tags["mlflow.parentRunId"])
            assert parent.info.run_name == content.parent
            assert parent.data.tags["iksamples.owner"] == owner
        assert {file.path for file in client.list_artifacts(run.info.run_id)} == set(content.texts)
        with tempfile.TemporaryDirectory() as fetched:
            for name, text in content.texts.items():
                file = client.download_artifacts(run.info.run_id, name, fetched)
                assert Path(file).read_text() == text


@pytest.fixture(scope="module")
def new_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "mlflow.db"
    connect(f"sqlite:///{path}")
    return path


@pytest.fixture
def server(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(new_store, tmp_path / "served.db")
    with mlflow_server(tmp_path, f"sqlite:///{tmp_path}/served.db") as running:
        yield running


def test_a_server_that_fails_now_and_then_gets_everything_once(server: Server) -> None:
    server.fault = lambda n, path: "refuse" if n % 7 == 3 else None
    log(server.uri)
    server.fault = lambda n, path: "lose the answer" if n % 7 == 3 else None
    log(server.uri, "you")
    server.fault = lambda n, path: None
    require_all_once(server.uri, ["me", "you"])


@pytest.mark.parametrize("call", ["runs/create", "experiments/create", "runs/log-batch"])
def test_what_was_done_though_the_answer_was_lost_is_not_done_again(
    server: Server, call: str
) -> None:
    lost: Counter[str] = Counter()

    def fault(n: int, path: str) -> str | None:
        lost[path] += path.endswith(call)
        return "lose the answer" if path.endswith(call) and lost[path] == 1 else None

    server.fault = fault
    log(server.uri)
    assert sum(lost.values()) > 0
    require_all_once(server.uri, ["me"])


def test_a_server_gone_midway_is_said_soon_and_the_next_logging_goes_on(server: Server) -> None:
    log(server.uri, "first")
    owners, share = ["first", "a", "b", "c"], server.asked // 4
    for i, whose in enumerate(owners[1:], start=1):
        last = i * share
        server.asked, server.fault = 0, lambda n, path, last=last: "refuse" if n > last else None
        began = time.monotonic()
        with pytest.raises(IksamplesError, match="goes on"), failing_plainly(server.uri):
            log(server.uri, whose)
        assert time.monotonic() - began < 20
    server.fault = lambda n, path: None
    for whose in owners[1:]:
        log(server.uri, whose)
    require_all_once(server.uri, owners)


WRITER = """
import sys
import tempfile
sys.path.insert(0, sys.argv[1])
import test_tracking_shared as shared

for line in sys.stdin:
    uri, whose, name = line.split()
    try:
        shared.log(uri, whose, name)
        print("done", flush=True)
    except Exception as error:
        print(repr(error).replace("\\n", " "), flush=True)
"""


class Writer:
    """Another process that logs when told to."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(Path(__file__).parent)],
            cwd=folder, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def start(self, *what: str) -> None:
        assert self.process.stdin
        self.process.stdin.write(" ".join(what) + "\n")
        self.process.stdin.flush()

    def answer(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline().strip()


@pytest.fixture(scope="module")
def writers(tmp_path_factory: pytest.TempPathFactory):
    """Three: the second in the first one's folder, the third in another."""
    here, there = (tmp_path_factory.mktemp(folder) for folder in ("here", "there"))
    made = [Writer(folder) for folder in (here, here, there)]
    yield made
    for one in made:
        one.process.kill()
        one.process.wait()
        one.process.stdin.close()
        one.process.stdout.close()


@pytest.fixture(params=["one folder", "two folders"])
def pair(writers: list[Writer], request: pytest.FixtureRequest) -> list[Writer]:
    return writers[:2] if request.param == "one folder" else writers[1:]


def both(writers: list[Writer], *tasks: tuple[str, str, str]) -> None:
    for writer, task in zip(writers, tasks, strict=True):
        writer.start(*task)
    assert [writer.answer() for writer in writers] == ["done", "done"]


@pytest.mark.parametrize("trial", range(10 if os.environ.get("IKSAMPLES_NIGHTLY") else 2))
def test_two_at_once_on_a_store_that_is_not_there_yet(pair, tmp_path: Path, trial: int) -> None:
    """In turn with one study of two owners, and two of one."""
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    if trial % 2:
        both(pair, (uri, "me", "small"), (uri, "me", "other"))
        for name in ("small", "other"):
            require_all_once(uri, ["me"], name)
    else:
        both(pair, (uri, "me", "small"), (uri, "you", "small"))
        require_all_once(uri, ["me", "you"])
    assert {path.name for path in tmp_path.iterdir()} == {"mlflow.db"}


@pytest.fixture
def postgres() -> Iterator[str]:
    """A PostgreSQL of the test's own, of Debian's package where there is one."""
    found = [*Path("/usr/lib/postgresql").glob("*/bin/initdb"), shutil.which("initdb")]
    if not found[0]:
        pytest.skip("no PostgreSQL here (apt install postgresql)")
    pytest.importorskip("psycopg2", reason="no driver here (pip install psycopg2-binary)")
    # It does not run as root; its folder is its user's.
    user = "postgres" if os.getuid() == 0 else None
    folder = Path(tempfile.mkdtemp(prefix="postgres-"))
    if user:
        shutil.chown(folder, user)

    def run(program: str, *arguments: str) -> None:
        call = [str(Path(found[0]).with_name(program)), "-D", str(folder / "data"), *arguments]
        done = subprocess.run(call, user=user, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    try:
        run("initdb", "--auth=trust", "--username=postgres", "--no-sync")
        options = f"-c listen_addresses='' -c fsync=off -k {folder}"
        run("pg_ctl", "--wait", f"--log={folder}/log", "-o", options, "start")
        yield f"postgresql://postgres@/postgres?host={folder}"
        run("pg_ctl", "--wait", "--mode=immediate", "stop")
    finally:
        shutil.rmtree(folder)


def test_a_server_on_postgresql_keeps_what_two_log_at_once(
    postgres: str, pair: list[Writer], tmp_path: Path
) -> None:
    """With runs of one name, and each with a further writer of its own later on."""
    with mlflow_server(tmp_path, postgres) as server:
        both(pair, (server.uri, "me", "small"), (server.uri, "you", "small"))
        require_all_once(server.uri, ["me", "you"])
        both(pair, (server.uri, "you", "small"), (server.uri, "me", "small"))
        require_all_once(server.uri, ["me", "you"])
