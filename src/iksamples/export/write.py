"""Which network of a finished study is taken away; writes it, and a certificate beside it."""

import hashlib
import json
import math
import platform
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from iksamples import __version__
from iksamples.answer.answer import Answer, VariantAnswer, read_answer
from iksamples.answer.collect import WORKSPACE, read_runs
from iksamples.certify.proof import point
from iksamples.certify.readers.layers import fed_as, read_as
from iksamples.certify.readers.network import Proved, Reading, float32_in_words, load_network, prove
from iksamples.errors import IksamplesError
from iksamples.export.forms import c_source, onnx_model, plain_network
from iksamples.files import whole_file
from iksamples.network import StackedMLP
from iksamples.results import Cell
from iksamples.study import Study, read_study
from iksamples.task import Task, study_task


@dataclass(frozen=True, eq=False)
class Choice:
    """One network of a study.

    Attributes:
        study: The study.
        cell: Its method on its samples.
        network: The network alone.
        why: Why this one, in a sentence.
    """

    study: Study
    cell: Cell
    network: StackedMLP
    why: str

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.network.seeds[0]


def choose(
    results: Path,
    method: str | None = None,
    samples: str | None = None,
    seed: int | None = None,
) -> Choice:
    """The network that a finished study recommends, or one that is asked for.

    Without being asked, it is of the method that needs the fewest samples among those that are
    trained, at the number of samples that is the answer; if none is the answer, the best network of
    the largest set. Of its seeds it is the one with the least proved worst case; measured, where
    nothing is proved.

    Args:
        results: The study's results folder.
        method: Name of the method.
        samples: Name of the set of samples, such as ``grid5``.
        seed: Seed of the training.

    Raises:
        IksamplesError: The study is not finished, or there is no such network.
    """
    answer, study = read_answer(results), read_study(results / "study.json")
    if study.arm:
        raise IksamplesError(
            f"{study.name}: its networks learnt simulated arms, no two alike, so there is none to "
            "take away. Export from a study without an arm section."
        )
    if study.samples.recorded:
        raise IksamplesError(
            f"{study.name}: its networks judge records and are not kept, so there is none to take "
            "away. Export from a study whose samples are computed."
        )
    one, label, why = _variant(answer, method, samples)
    runs = read_runs(study, results)
    runs = runs[(runs["method"] == one.method) & (runs["label"] == label)]
    runs = runs[(runs["region"] == WORKSPACE) & runs["failed"].eq("")]
    if seed is None:
        if runs.empty:
            raise IksamplesError(f"{one.method} on {label}: every training failed.")
        proved = runs["verified"].any()
        column = "sup_upper_mm" if proved else "error_max_mm"
        seed = int(runs["seed"].to_numpy()[np.nanargmin(runs[column].to_numpy())])
        kind = "the smallest proved worst case" if proved else "the smallest measured error"
        why = f"{why}; of {len(runs)} seeds the one with {kind}"
    elif seed not in set(runs["seed"]):
        known = ", ".join(map(str, sorted(runs["seed"])))
        raise IksamplesError(f"{one.method} on {label}: no sound seed {seed}; there are {known}.")
    cell = Cell(study, results, one.method, label)
    return Choice(study, cell, cell.network.select([cell.network.seeds.index(seed)]), why)


def _variant(
    answer: Answer, method: str | None, samples: str | None
) -> tuple[VariantAnswer, str, str]:
    """The method and its samples, and why."""
    trained = [one for one in answer.variants if one.kind == "network"]
    known = ", ".join(dict.fromkeys(one.method for one in trained))
    fitting = [one for one in trained if method in (None, one.method)]
    if not fitting:
        asked = f" '{method}'" if method else ""
        raise IksamplesError(
            f"{answer.study}: no trained method{asked}; there are: {known or 'none'}."
        )
    if samples is not None:
        for one in fitting:
            if samples in [size.label for size in one.sizes]:
                return one, samples, "as asked for"
        labels = ", ".join(size.label for one in fitting for size in one.sizes)
        raise IksamplesError(f"{answer.study}: no samples '{samples}'; there are {labels}.")
    answered = [one for one in fitting if one.found]
    if answered:
        best = min(answered, key=lambda one: one.shown.n_samples)
        fewest = f"{best.shown.n_samples}, which {best.method} needs"
        return best, best.shown.label, f"the fewest samples of a trained method are {fewest}"
    # Where every training failed, no error is known: NaN, which is neither less nor more.
    best = min(
        fitting, key=lambda one: (math.isnan(one.shown.error_best_mm), one.shown.error_best_mm)
    )
    return (
        best,
        best.shown.label,
        f"no trained method is shown to meet the study's tolerance; {best.method} with "
        f"{best.shown.n_samples} samples has the best network of the largest set",
    )


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
    read = read_as(task.q.units, output_units, None, None)
    network = plain_network(choice.network, task.x, task.q, input_unit, output_units)
    model = onnx_model(network, _source(choice)).SerializeToString(deterministic=True)
    with TemporaryDirectory() as aside:  # nothing is left in the folder if nothing is proved
        path = Path(aside) / ONNX_FILE
        path.write_bytes(model)
        reading = load_network(
            path,
            (len(task.x), len(task.q)),
            fed=fed_as(task.x.units, (input_unit,), None, None),
            read=read,
        )
    asked = choice.study.bounds
    found = prove(
        reading,
        task.drawing,
        task.region,
        task.target,
        rtol=asked.sup_rtol,
        atol_deg=asked.sup_atol_deg,
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
    contents = {
        ONNX_FILE: model,
        C_FILE: c_source(network, _comment(certificate, proved.values())).encode(),
        CERTIFICATE: f"{json.dumps(certificate, indent=2)}\n".encode(),
    }
    with ExitStack() as stack:  # all of them or none
        for name, content in contents.items():
            stack.enter_context(whole_file(folder / name)).write_bytes(content)
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
