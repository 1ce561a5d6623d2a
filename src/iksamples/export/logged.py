"""The recommended network in MLflow: a model with its signature, on the study's run."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.export.choose import choose
from iksamples.export.onnx_model import INPUT, OUTPUT
from iksamples.export.write import ONNX_FILE, export


if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.models import ModelSignature

FOLDER = "network"
"""Folder among the run's artifacts; ``mlflow.onnx.load_model("runs:/<run>/network/model")``."""
_TAG = "iksamples.network"


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
            client.set_tag(run_id, _TAG, f"none: {error}")
            return
        digest = certificate["file_sha256"]
        if client.get_run(run_id).data.tags.get(_TAG) == digest:
            return
        inputs, outputs = (
            Schema([TensorSpec(np.dtype(np.float32), (-1, len(certificate[key])), name)])
            for key, name in (("inputs", INPUT), ("outputs", OUTPUT))
        )
        _save(ModelSignature(inputs, outputs), folder)
        client.log_artifacts(run_id, str(folder), FOLDER)
        client.set_tag(run_id, _TAG, digest)


def _save(signature: "ModelSignature", folder: Path) -> None:
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
