"""Nothing is told to anybody: not by a run (test_workflow.py), nor by what README.md says to start.

``mlflow server`` is watched in test_tracking.py.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from watched_network import Watch, watch


pytestmark = pytest.mark.slow

PATIENCE_S = 60.0


@pytest.fixture
def watched(tmp_path: Path) -> Watch:
    return watch(tmp_path)


def test_what_leaves_this_machine_is_seen_and_what_stays_is_let_through(watched: Watch) -> None:
    script = """if True:
        import socket
        listener = socket.create_server(("127.0.0.1", 0))
        socket.create_connection(("localhost", listener.getsockname()[1])).close()
        for name in ("192.0.2.1", "2001:db8::1", "a.invalid"):
            try:
                socket.create_connection((name, 9))
            except OSError:
                pass
        socket.socket(type=socket.SOCK_DGRAM).connect_ex(("192.0.2.2", 9))
        try:
            socket.socket(type=socket.SOCK_DGRAM).sendto(b"hello", ("192.0.2.3", 9))
        except OSError:
            pass
        """
    subprocess.run([sys.executable, "-c", script], env=watched.environment, check=True)
    expected = {"192.0.2.1", "2001:db8::1", "a.invalid", "192.0.2.2", "192.0.2.3"}
    assert watched.reached() == expected


def view(watched: Watch, folder: Path, until_reached: bool) -> None:
    """Starts Rerun's viewer, without a window, and stops it once it has had time to send."""
    ports = []
    for _ in range(2):
        with socket.create_server(("127.0.0.1", 0)) as free:
            ports.append(str(free.getsockname()[1]))
    call = ["rerun", "--serve-web", "--bind", "127.0.0.1"]
    call += ["--port", ports[0], "--web-viewer-port", ports[1]]
    with (folder / "viewer.txt").open("w") as output:
        process = subprocess.Popen(
            call, cwd=folder, env=watched.environment, stdout=output, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        try:
            end = time.monotonic() + PATIENCE_S
            while "Listening" not in (folder / "viewer.txt").read_text() or (
                until_reached and not watched.reached()
            ):
                assert time.monotonic() < end, (folder / "viewer.txt").read_text()
                time.sleep(0.05)
            time.sleep(1)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_the_viewer_tells_nobody_once_told_not_to(watched: Watch, tmp_path: Path) -> None:
    view(watched, tmp_path, until_reached=False)  # which it never tells the first time
    view(watched, tmp_path, until_reached=True)
    told = watched.reached()
    subprocess.run(["rerun", "analytics", "disable"], env=watched.environment, check=True)
    Path(watched.environment["NETWORK_LOG"]).unlink()
    for _ in range(2):
        view(watched, tmp_path, until_reached=False)
    assert (bool(told), watched.reached()) == (True, set())
