"""Logs a study to MLflow: the one process that writes to the tracking store.

The page that the run names opens a saved view: error against the number of samples, a line per
variant. A named view is an experiment's tag, ``mlflow.sharedViewState.<key>`` (MLflow 3.15 and
later); an address with ``viewStateShareKey=<key>`` opens it. The recommended network lies on the
run of the study's own network, as a model with its signature.
"""

import json
import os
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

import numpy as np
from filelock import FileLock

from iksamples.answer.answer import FILE as ANSWER
from iksamples.answer.collect import WORKSPACE, read_runs
from iksamples.errors import IksamplesError
from iksamples.export.forms import INPUT, OUTPUT
from iksamples.export.write import ONNX_FILE, choose, export
from iksamples.files import kept_file, writing
from iksamples.report.markdown import escaped
from iksamples.study import Study
from iksamples.study.sections import without_password
from iksamples.tracking.content import own_run, study_runs
from iksamples.tracking.store import (
    Outcome,
    StoreError,
    connect,
    experiment,
    failing_plainly,
    log_runs,
    owner,
)


if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.models import ModelSignature


DEFAULT_URI = "sqlite:///mlflow.db"
"""What a plain ``mlflow ui`` in the same folder shows."""

# What keeps MLflow's page from asking what kind of experiment this is.
MODEL_TRAINING = "custom_model_development"


def track(study: Study, results: Path, output: Path) -> Outcome:
    """Logs a study to the MLflow experiment of its name, but for what is there already.

    One run per variant, below it one per number of samples. It can be done again at any time, also
    after it was cut off, at the same time, and by several people on one server.

    Args:
        study: The study.
        results: Its results folder.
        output: Manifest to write (JSON): where the runs are, each run's id, and the page that
            compares the variants.

    Raises:
        StoreError: The tracking store cannot be used.
        IksamplesError: The study is not finished.
    """
    # All of it read first, so that a missing file stops this before anything is written.
    contents = list(study_runs(study, results, read_runs(study, results)))
    uri, whose = tracking_uri(study), owner()
    # One owner's runs are looked for and then made: two at once would make them twice.
    with writing(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(output.with_name(f".{output.name}.lock")).acquire()
    with lock, kept_file(output) as manifest:
        client = connect(uri)
        with failing_plainly(uri):
            where = experiment(client, study.name)
            outcome = log_runs(client, where, whose, contents, source_tags(study))
            if (results / ANSWER).exists() and not study.samples.recorded:
                log_network(client, outcome.run_ids[own_run(study)], results)
            client.set_experiment_tag(
                where.experiment_id, *view_tag(study, whose, int(where.creation_time or 0))
            )
            about = {
                "mlflow.experimentKind": MODEL_TRAINING,
                "mlflow.note.content": _note(study, page(where.experiment_id, whose)),
            }
            for name in about.keys() - where.tags.keys():  # what people wrote there stays
                client.set_experiment_tag(where.experiment_id, name, about[name])
        content = {
            "tracking_uri": without_password(uri),
            "experiment": where.name,
            "experiment_id": where.experiment_id,
            "page": page(where.experiment_id, whose),
            "study": study.digest(),
            "runs": outcome.run_ids,
        }
        manifest.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return outcome


def put_off(study: Study, reason: StoreError, command: str, output: Path) -> None:
    """Writes a manifest of nothing: why no run was logged, and what logs them.

    Args:
        study: The study.
        reason: Why not.
        command: What to type.
        output: The manifest.
    """
    content = {
        "tracking_uri": without_password(tracking_uri(study)),
        "reason": str(reason),
        "command": command,
    }
    with kept_file(output) as file:
        file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


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
        f"{escaped(study.title)}\n\n"
        "One run per variant (a method on samples placed by a design), below it one per number of "
        "samples. `seeds.csv` there has the errors of every network. Lengths in mm, losses in rad² "
        "(of prismatic joints by their output scale)."
    )


_TAG = "mlflow.sharedViewState."
_SECTION = "against-n"
_NAME = "Error against the number of samples"


def view_tag(study: Study, owner: str, created_ms: int) -> tuple[str, str]:
    """Name and value of the tag that holds an owner's view.

    Args:
        study: The study, whose regions get a chart each.
        owner: Whose runs are shown.
        created_ms: When the experiment was made [ms since 1970].
    """
    regions = [*study.evaluation.paths, WORKSPACE]
    metrics = [f"{region}/error_mean_mm" for region in regions]
    metrics += [f"{WORKSPACE}/error_max_mm", f"{WORKSPACE}/sup_median_mm"]
    state = {
        "searchFilter": " and ".join(
            f"tags.`iksamples.{name}` = '{value}'"
            for name, value in (("owner", owner), ("current", "true"), ("kind", "variant"))
        ),
        "runsHiddenMode": "SHOW_ALL",
        "compareRunCharts": [_chart(metric) for metric in metrics],
        "compareRunSections": [{"uuid": _SECTION, "name": _NAME, "display": True, "columns": 2}],
        "isAccordionReordered": True,  # else MLflow puts its own sections by name
        "hideEmptyCharts": True,
    }
    value = {"name": _NAME, "createdAt": created_ms, "state": json.dumps(state)}
    return _TAG + _key(owner), json.dumps(value)


def page(experiment_id: str, owner: str) -> str:
    """The part of the address, after the server's, that opens the view."""
    query = {
        "workflowType": "machine_learning",  # else MLflow may open on its page of traces
        "compareRunsMode": "CHART",
        "viewStateShareKey": _key(owner),
    }
    return f"#/experiments/{experiment_id}/runs?{urlencode(query, quote_via=quote)}"


def _key(owner: str) -> str:
    return f"iksamples-{owner}"


def _chart(metric: str) -> dict[str, Any]:
    return {
        "type": "LINE",
        "uuid": metric,
        "metricSectionId": _SECTION,
        "metricKey": metric,
        "deleted": False,
        "isGenerated": False,
        "xAxisKey": "step",
        "useGlobalXaxisKey": False,
        "xAxisScaleType": "log",
        "scaleType": "log",
        "range": {},
        "displayPoints": True,
        "lineSmoothness": 0,
        "useGlobalLineSmoothing": False,
    }


FOLDER = "network"
"""Folder among the run's artifacts; ``mlflow.onnx.load_model("runs:/<run>/network/model")``."""
_NETWORK_TAG = "iksamples.network"


def log_network(client: "MlflowClient", run_id: str, results: Path) -> None:
    """Puts the recommended network on a run, unless it is there already.

    Where there is none (every training diverged, nothing is proved), the run's tag says why.

    Args:
        client: The store.
        run_id: The study's run.
        results: The study's results folder.
    """
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    with TemporaryDirectory() as aside:
        folder = Path(aside) / FOLDER
        try:
            certificate = export(choose(results), folder)
        except IksamplesError as error:
            client.set_tag(run_id, _NETWORK_TAG, f"none: {error}")
            return
        digest = certificate["file_sha256"]
        if client.get_run(run_id).data.tags.get(_NETWORK_TAG) == digest:
            return
        inputs, outputs = (
            Schema([TensorSpec(np.dtype(np.float32), (-1, len(certificate[key])), name)])
            for key, name in (("inputs", INPUT), ("outputs", OUTPUT))
        )
        _save_model(ModelSignature(inputs, outputs), folder)
        client.log_artifacts(run_id, str(folder), FOLDER)
        client.set_tag(run_id, _NETWORK_TAG, digest)


def _save_model(signature: "ModelSignature", folder: Path) -> None:
    """Writes MLflow's description of the ONNX file that is in a folder, as ``folder/model``.

    As ``mlflow.onnx.save_model`` does, which wants onnxruntime installed though it is only needed
    to run the model.
    """
    import onnx
    from mlflow import pyfunc
    from mlflow.models import Model

    model, kept = Model(signature=signature), folder / "model"
    kept.mkdir()
    shutil.copy(folder / ONNX_FILE, kept / ONNX_FILE)
    (kept / "requirements.txt").write_text("mlflow\nonnx\nonnxruntime\n", encoding="utf-8")
    model.add_flavor(
        "onnx",
        onnx_version=onnx.__version__,
        data=ONNX_FILE,
        providers=["CPUExecutionProvider"],
        onnx_session_options=None,
        code=None,
    )
    pyfunc.add_to_model(model, loader_module="mlflow.onnx", data=ONNX_FILE)
    model.save(str(kept / "MLmodel"))
