"""The study file: one typed, validated description of everything a study does.

Every field has a description, a unit where it has one, a range and a default, and the defaults are
the paper's study. ``config/schema.json`` and the table in ``config/README.md`` are generated from
here (``iksamples handbook``).
"""

from iksamples.study.arm import Arm, Expected
from iksamples.study.evaluation import (
    Bounds,
    Evaluation,
    Replication,
    Tolerance,
)
from iksamples.study.paths import (
    AnyPath,
    Circle,
    CsvPath,
    DoubleRectangle,
    Heart,
    Helix,
    Lemniscate,
)
from iksamples.study.reading import parse_study, read_study
from iksamples.study.readings import Readings
from iksamples.study.recorded import Recorded
from iksamples.study.robot import POSITIONS, Asked, Coordinate, Robot, Workspace
from iksamples.study.samples import DRAWN, RECORDED, TENSOR, Design, Samples
from iksamples.study.section import Limits, Section, Vector3
from iksamples.study.study import NETWORK, Study, Tracking
from iksamples.study.training import EarlyStopping, HeldOut, Method, MethodKind, Network, Training


__all__ = [
    "DRAWN",
    "NETWORK",
    "POSITIONS",
    "RECORDED",
    "TENSOR",
    "AnyPath",
    "Arm",
    "Asked",
    "Bounds",
    "Circle",
    "Coordinate",
    "CsvPath",
    "Design",
    "DoubleRectangle",
    "EarlyStopping",
    "Evaluation",
    "Expected",
    "Heart",
    "HeldOut",
    "Helix",
    "Lemniscate",
    "Limits",
    "Method",
    "MethodKind",
    "Network",
    "Readings",
    "Recorded",
    "Replication",
    "Robot",
    "Samples",
    "Section",
    "Study",
    "Tolerance",
    "Tracking",
    "Training",
    "Vector3",
    "Workspace",
    "parse_study",
    "read_study",
]
