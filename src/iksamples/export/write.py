"""Writes a network of a finished study, and a certificate of the written file beside it."""

import hashlib
import json
import math
import platform
from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from iksamples import __version__
from iksamples.certify.printing import point
from iksamples.certify.readers.network import Reading, load_network
from iksamples.certify.readers.proved import Proved, float32_in_words, prove
from iksamples.certify.readers.units import fed_as, read_as
from iksamples.errors import IksamplesError
from iksamples.export.c_source import c_source
from iksamples.export.choose import Choice
from iksamples.export.onnx_model import onnx_model
from iksamples.export.plain import plain_network
from iksamples.task import Task, study_task


VERSION = 1
"""Version of the certificate's layout."""

ONNX_FILE, C_FILE, CERTIFICATE = "ik.onnx", "ik.c", "certificate.json"


def export(
    choice: Choice, folder: Path, input_unit: str = "mm", output_units: Sequence[str] = ()
) -> dict[str, Any]:
    """Writes ``ik.onnx``, ``ik.c`` and ``certificate.json`` into a folder.

    What is certified is the function of the ONNX file, read back from the disk. The C function has
    the same numbers and is computed in float32.

    Args:
        choice: The network.
        folder: Where the files go.
        input_unit: ``mm`` or ``m``.
        output_units: At most one of ``rad``, ``deg`` and one of ``mm``, ``m``.

    Returns:
        What the certificate says.

    Raises:
        IksamplesError: A unit is wrong, or the checker cannot prove a bound.
    """
    task = study_task(choice.study, choice.cell.samples.region)
    network = plain_network(choice.network, task.x, task.q, input_unit, output_units)
    kinds = ["prismatic" if unit == "mm" else "revolute" for unit in task.q.units]
    read = read_as(kinds, output_units, None, None)
    model = onnx_model(network, _source(choice)).SerializeToString(deterministic=True)
    with TemporaryDirectory() as aside:  # nothing is left in the folder if nothing is proved
        path = Path(aside) / ONNX_FILE
        path.write_bytes(model)
        reading = load_network(
            path,
            (len(task.x), len(task.q)),
            fed=fed_as(task.x.units, input_unit, None, None),
            read=read,
        )
    found = prove(
        reading, task.drawing, task.region, task.target, rtol=choice.study.bounds.sup_rtol
    )
    proved = {f"{measure}_error": one for measure, [one] in found.items()}
    if any(one.upper == math.inf for one in proved.values()):
        raise IksamplesError(
            f"{choice.cell.method} on {choice.cell.label}, seed {choice.seed}: the checker proves "
            "no bound of this network, so it is not written; name another --seed."
        )
    certificate = _certificate(choice, task, model, reading, proved)
    certificate |= {
        "inputs": [f"{name} [{unit}]" for name, unit in network.inputs],
        "outputs": [f"{name} [{unit}]" for name, unit in network.outputs],
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / ONNX_FILE).write_bytes(model)
    (folder / C_FILE).write_text(
        c_source(network, _comment(certificate, proved.values())), encoding="utf-8"
    )
    text = json.dumps(certificate, indent=2)
    (folder / CERTIFICATE).write_text(text + "\n", encoding="utf-8")
    return certificate


def _source(choice: Choice) -> dict[str, str]:
    """Where a network comes from."""
    return {
        "study": choice.study.name,
        "study_digest": choice.study.digest(),
        "method": choice.cell.method,
        "samples": choice.cell.label,
        "seed": str(choice.seed),
        "iksamples": __version__,
    }


def _certificate(
    choice: Choice, task: Task, model: bytes, reading: Reading, proved: dict[str, Proved]
) -> dict[str, Any]:
    """Everything that the claim is about, and who proved it."""
    urdf = Path(choice.study.robot.urdf)
    return {
        "version": VERSION,
        "file": ONNX_FILE,
        "file_sha256": hashlib.sha256(model).hexdigest(),
        "network": _source(choice) | {"layers": reading.order, "chosen": choice.why},
        "robot": {
            "file": urdf.name,
            "sha256": hashlib.sha256(urdf.read_bytes()).hexdigest(),
            "base_link": choice.study.robot.base_link,
            "tip_link": choice.study.robot.tip_link,
            "tool_offset_mm": list(choice.study.robot.tool_offset_mm),
            "joints": list(task.q.names),
        },
        "region": {
            "coordinates": task.x.columns(),
            "lower": task.region.lower.tolist(),
            "upper": task.region.upper.tolist(),
        },
        "task": {
            "inputs": list(task.target.coordinates),
            "orientation": task.target.orientation,
            "reference_rotation": task.target.reference_rotation.tolist() if task.turns else None,
        },
        **{name: _error(one, reading) for name, one in proved.items()},
        "versions": {
            "iksamples": __version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def _error(proved: Proved, reading: Reading) -> dict[str, Any]:
    """What is claimed of one error."""
    unit = proved.unit
    return {
        f"upper_{unit}": proved.upper,
        f"lower_{unit}": proved.lower,
        "argmax": proved.argmax.tolist(),
        "checked": True,
        "met": proved.complete,
        "says": f"Over the region {proved.in_words()}. In real arithmetic, by the nominal arm.",
        f"float32_{unit}": proved.float32 if proved.float32 < math.inf else None,
        "float32_says": float32_in_words([proved])
        + ("; the changes of unit round besides." if reading.folded else "."),
    }


def _comment(certificate: dict[str, Any], proved: Collection[Proved]) -> list[str]:
    """The comment of the C file."""
    network, region = certificate["network"], certificate["region"]
    lines = [
        f"Inverse kinematics of {certificate['robot']['file']}, learned: iksamples {__version__},",
        f"study {network['study']}, method {network['method']}, samples {network['samples']}, "
        f"seed {network['seed']}.",
        "",
        "Proved over the region below, in real arithmetic, by the nominal arm:",
        *(f"{one.in_words()};" for one in proved),
        f"{float32_in_words(proved)}.",
        "Outside the region nothing is known. Computed in float, whatever the units.",
        "",
        f"Region ({', '.join(region['coordinates'])}):",
    ]
    boxes = list(zip(region["lower"], region["upper"], strict=True))
    lines += [f"  {point(low)} to {point(high)}" for low, high in boxes[:8]]
    if len(boxes) > 8:
        lines.append(f"  and {len(boxes) - 8} more boxes, listed in {CERTIFICATE}")
    return [*lines, ""]
