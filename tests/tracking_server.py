"""MLflow's own server inside a test, with faults between it and the client."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import pytest
from werkzeug.serving import WSGIRequestHandler, make_server


Fault = Literal["refuse", "lose the answer"] | None
"""A request may be answered by 500 without being done, or be done and answered by 500."""


class _Quiet(WSGIRequestHandler):
    def log_request(self, *_: object, **__: object) -> None:
        pass


class Server:
    """A server whose n-th request can go wrong.

    Attributes:
        uri: Its address.
        asked: How many requests came.
        fault: Called with the number of a request, from 0, and its path.
    """

    def __init__(self, uri: str) -> None:
        self.uri, self.asked = uri, 0
        self.fault: Callable[[int, str], Fault] = lambda n, path: None
        self._lock = threading.Lock()

    def wrap(self, app: Callable) -> Callable:
        def faulty(environ: dict, start_response: Callable) -> object:
            with self._lock:
                n, self.asked = self.asked, self.asked + 1
            fault = self.fault(n, environ["PATH_INFO"])
            if fault == "lose the answer":
                b"".join(app(environ, lambda *_: lambda _: None))
            if fault:
                start_response("500 INTERNAL SERVER ERROR", [("Content-Type", "text/plain")])
                return [b"out of order"]
            return app(environ, start_response)

        return faulty


@contextmanager
def mlflow_server(folder: Path, database: str, port: int = 0) -> Iterator[Server]:
    """Serves a store from this process.

    Args:
        folder: Gets the artifacts.
        database: The store behind the server.
        port: Where it listens; 0: on a free one.
    """
    import mlflow
    from mlflow.server import app, handlers

    settings = {
        "_MLFLOW_SERVER_FILE_STORE": database,
        "_MLFLOW_SERVER_ARTIFACT_ROOT": "mlflow-artifacts:/",
        "_MLFLOW_SERVER_ARTIFACT_DESTINATION": str(folder / "artifacts"),
        "_MLFLOW_SERVER_SERVE_ARTIFACTS": "true",
    }
    before = {name: os.environ.get(name) for name in settings}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        for name in ("_tracking_store", "_artifact_repo"):
            patch.setattr(handlers, name, None)
        http = make_server("127.0.0.1", port, app, threaded=True, request_handler=_Quiet)
        server = Server(f"http://127.0.0.1:{http.server_port}")
        http.app = server.wrap(http.app)
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            http.shutdown()
            thread.join()
            http.server_close()
            mlflow.set_tracking_uri(None)
    assert before == {name: os.environ.get(name) for name in settings}
