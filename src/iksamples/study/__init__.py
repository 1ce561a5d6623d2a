"""The study file: one typed, validated description of everything a study does.

Every field has a description, a unit where it has one, a range and a default, and the defaults are
the paper's study. ``config/schema.json`` and the table in ``config/README.md`` are generated from
here (``iksamples handbook``).
"""

from iksamples.study.arm import Arm, Expected
from iksamples.study.evaluation import (
    MAX_EPOCHS,
    MOST_INPUTS_OF_A_MEAN,
    AnyPath,
    Circle,
    CsvPath,
    DoubleRectangle,
    Evaluation,
    Heart,
    Helix,
    Lemniscate,
    Tolerance,
)
from iksamples.study.reading import parse_study, read_study
from iksamples.study.recorded import RECORDED, TENSOR, Assumed, Design, Recorded
from iksamples.study.sections import Asked, Robot, Section, Workspace
from iksamples.study.study import NETWORK, PROVED_TOGETHER, Readings, Study, Tracking
from iksamples.study.training import HeldOut, Method, MethodKind, Network, Training
