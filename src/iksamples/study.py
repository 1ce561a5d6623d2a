"""The study file: one typed, validated description of everything a study does.

Every field has a description, a unit where it has one, a range and a default, and the defaults are
the paper's study. ``config/schema.json`` and the table in ``config/README.md`` are generated from
here (``iksamples handbook``).
"""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from iksamples.errors import IksamplesError


Vector3 = tuple[float, float, float]
Limits = tuple[float, float]


NETWORK = "network"
"""Name of the method that a study's own ``network`` and ``training`` sections describe."""


class Section(BaseModel):
    """A part of the study file; an unknown key is an error, and nothing changes once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Robot(Section):
    """Which arm, and which of its inverse kinematics is meant."""

    urdf: str = Field(
        "config/robots/rrr70.urdf", description="URDF of the arm, relative to the working folder."
    )
    base_link: str | None = Field(None, description="First link of the chain; null: the root link.")
    tip_link: str | None = Field(
        None, description="Link whose origin is the tool centre point; null: the only end link."
    )
    inverse: Literal["yaw-pitch-pitch"] = Field(
        "yaw-pitch-pitch", description="Closed-form inverse kinematics that labels the samples."
    )
    elbow: Literal["negative", "positive"] = Field(
        "negative", description="Branch of the inverse kinematics: sign of the elbow angle."
    )
    limits_rad: dict[str, Limits] = Field(
        {}, description="Joint limits [rad] that replace the URDF's, by joint name."
    )


class Workspace(Section):
    """The box in which the arm is to work."""

    lower_mm: Vector3 = Field((20.0, 20.0, 0.0), description="Lower corner of the box [mm].")
    upper_mm: Vector3 = Field((80.0, 80.0, 60.0), description="Upper corner of the box [mm].")
    min_singular_value_mm: float = Field(
        1.0,
        ge=0,
        description="A point counts as singular where the smallest singular value of the "
        "Jacobian [mm/rad] is below this.",
    )

    @model_validator(mode="after")
    def _upper_above_lower(self) -> "Workspace":
        if any(low >= high for low, high in zip(self.lower_mm, self.upper_mm, strict=True)):
            raise ValueError("upper_mm must be greater than lower_mm along every axis")
        return self


Design = Literal["grid", "chebyshev", "sobol", "latin", "uniform", "joints", "adaptive"]
DRAWN: tuple[Design, ...] = ("sobol", "latin", "uniform", "joints")
"""Designs whose points ``samples.seed`` draws."""


class Samples(Section):
    """Which points are recorded."""

    designs: list[Design] = Field(
        ["grid"],
        min_length=1,
        description="How the points are placed: an even grid, Chebyshev nodes, Sobol points, a "
        "Latin hypercube, uniformly in the workspace, uniformly in joint space, or step by step "
        "where networks trained so far disagree. The first design fills the table and the report.",
    )
    points_per_axis: list[Annotated[int, Field(ge=2, le=32)]] = Field(
        [2, 3, 4, 5, 6, 7, 8],
        min_length=1,
        description="Sizes to compare: m points per axis give m^3 samples, in every design.",
    )
    unreachable: Literal["error", "mask"] = Field(
        "error",
        description="A grid point the arm cannot reach inside its limits stops the study, or is "
        "left out and counted. Never moved.",
    )
    normalisation: Literal["unit", "symmetric", "none"] = Field(
        "unit",
        description="Min-max scaling of the inputs: to [0, 1], to [-1, 1], or none (mm as they "
        "are). Outputs stay in radians.",
    )

    seed: int = Field(
        0, ge=0, lt=2**31, description="Seed of the random designs and of the fresh points."
    )

    @property
    def design(self) -> Design:
        """The first design, which fills the table and the report."""
        return self.designs[0]

    @field_validator("points_per_axis")
    @classmethod
    def _sorted_unique(cls, value: list[int]) -> list[int]:
        if len(set(value)) != len(value):
            raise ValueError("should name each size once")
        return sorted(value)

    @field_validator("designs")
    @classmethod
    def _unique(cls, value: list[Design]) -> list[Design]:
        if len(set(value)) != len(value):
            raise ValueError("should name each design once")
        return value


class Network(Section):
    """The network's shape."""

    hidden: list[Annotated[int, Field(ge=1, le=1024)]] = Field(
        [16], max_length=8, description="Neurons of each hidden layer."
    )
    activation: Literal["relu", "tanh"] = Field(
        "relu", description="Activation of the hidden layers; the output layer is linear."
    )


class EarlyStopping(Section):
    """Per seed, on the validation loss."""

    patience: int = Field(10, ge=1, le=100_000, description="Epochs without improvement.")
    min_delta_rad2: float = Field(
        1e-5, ge=0, description="Smallest drop of the validation loss that counts [rad^2]."
    )
    restore_best: bool = Field(
        False, description="Keep the weights of the best epoch instead of the last."
    )


class HeldOut(Section):
    """Where validation and test points come from.

    Five per cent of 8 samples is 0.4 of a sample. By default every grid node trains and the
    validation and test points are fresh points of the workspace; ``grid`` takes them from the
    grid's nodes, per seed, as Keras' ``validation_split`` would, and the nodes left are counted.
    """

    source: Literal["fresh", "grid"] = Field(
        "fresh", description="Fresh points of the workspace, or nodes taken from the grid."
    )
    validation_share: float = Field(
        0.05, ge=0, le=0.5, description="Validation points as a share of the samples."
    )
    test_share: float = Field(
        0.05, ge=0, le=0.4, description="Test points as a share of the samples."
    )
    at_least: int = Field(
        16,
        ge=0,
        le=10_000,
        description="Fewest fresh points of either kind (not used when the source is the grid).",
    )

    def counts(self, n: int) -> tuple[int, int]:
        """How many of n samples a seed loses to validation and to test.

        None where fresh points are used. Each share is rounded to the nearest whole number (halves
        up), so 5 % of 8 samples are none and 5 % of 27 are one. At least one sample is left to
        train on.
        """
        if self.source == "fresh":
            return 0, 0
        n_validation = min(int(self.validation_share * n + 0.5), n - 1)
        return n_validation, min(int(self.test_share * n + 0.5), n - 1 - n_validation)


class Training(Section):
    """How the networks are trained."""

    optimizer: Literal["adam", "levenberg-marquardt"] = Field(
        "adam",
        description="Optimiser. Levenberg-Marquardt takes all samples at once, an epoch is one "
        "iteration, and learning rate, schedule and batch size do not matter.",
    )
    learning_rate: float = Field(1e-3, gt=0, le=1, description="Step size of the optimiser.")
    schedule: Literal["constant", "cosine", "plateau"] = Field(
        "constant",
        description="Learning rate over the epochs: constant; falling to zero along half a cosine; "
        "or halved for each seed whose validation loss has stalled.",
    )
    plateau_patience: int = Field(
        20,
        ge=1,
        le=100_000,
        description="Epochs without improvement that halve a seed's learning rate (schedule: "
        "plateau).",
    )
    batch_size: int = Field(8, ge=1, le=1_000_000, description="Samples per optimiser step.")
    epochs: int = Field(500, ge=1, le=1_000_000, description="Passes over the samples, at most.")
    steps: int | None = Field(
        None,
        ge=1,
        le=100_000_000,
        description="Optimiser steps, the same for every number of samples; null: count epochs. "
        "Replaces `epochs`, which gives 8 samples 500 steps and 512 samples 32 000. A method that "
        "says `epochs` does not inherit it.",
    )
    early_stopping: EarlyStopping | None = Field(
        None, description="Stop a seed when its validation loss stalls; null: never."
    )
    held_out: HeldOut = Field(HeldOut(), description="Validation and test points.")
    seeds: int = Field(
        20,
        ge=1,
        le=100_000,
        description="Networks trained per grid. To show that 80 % of trainings succeed with 95 % "
        "confidence takes 14 or more.",
    )
    first_seed: int = Field(0, ge=0, lt=2**31, description="Seed of the first network.")
    snapshots: int = Field(
        50, ge=2, le=1000, description="Epochs at which weights are kept to replay the training."
    )
    engine: Literal["auto", "fused", "reference"] = Field(
        "auto",
        description="Training loop: compiled over seeds and steps, stacked autograd in torch, or "
        "the first of the two that can do the study.",
    )
    accelerator: Literal["auto", "cpu", "gpu"] = Field(
        "cpu", description="Device of the reference engine."
    )

    def steps_per_epoch(self, n_trained: int) -> int:
        """Optimiser steps of an epoch; the last mini-batch may be smaller than the others."""
        if self.optimizer == "levenberg-marquardt":
            return 1  # all samples at once
        return -(-n_trained // self.batch_size)

    def n_trained(self, n: int) -> int:
        """How many of n samples a seed learns from."""
        return n - sum(self.held_out.counts(n))

    @model_validator(mode="after")
    def _validation_for_early_stopping(self) -> "Training":
        if self.early_stopping and not (
            self.held_out.validation_share
            or (self.held_out.source == "fresh" and self.held_out.at_least)
        ):
            raise ValueError("early_stopping needs held_out.validation_share above 0")
        return self


MethodKind = Literal[
    "network", "multilinear", "cubic", "polynomial", "rbf", "gaussian-process", "analytic"
]


class Method(Section):
    """A way from samples to joint angles, compared with the study's own network."""

    kind: MethodKind = Field(
        "network",
        description="A network, an interpolation of the same samples (multilinear, cubic and "
        "polynomial need a full grid), or the exact inverse.",
    )
    network: Network = Field(
        Network(), description="What differs from the study's `network` (kind: network)."
    )
    training: Training = Field(
        Training(), description="What differs from the study's `training` (kind: network)."
    )


class DoubleRectangle(Section):
    """Two axis-parallel rectangles at a low and a high height (paper, Figs. 4 and 5)."""

    shape: Literal["double_rectangle"] = Field(description="Kind of path.")
    lower_mm: tuple[float, float] = Field((30.0, 30.0), description="Lower x and y [mm].")
    upper_mm: tuple[float, float] = Field((70.0, 70.0), description="Upper x and y [mm].")
    heights_mm: tuple[float, float] = Field((10.0, 50.0), description="The two heights z [mm].")
    waypoints: int = Field(240, ge=8, le=100_000, description="Points along both rectangles.")


class Heart(Section):
    """A heart in a plane that leans about the x axis (paper, Fig. 2)."""

    shape: Literal["heart"] = Field(description="Kind of path.")
    centre_mm: Vector3 = Field((50.0, 50.0, 30.0), description="Centre of the heart [mm].")
    width_mm: float = Field(44.0, gt=0, description="Width along x [mm].")
    tilt_rad: float = Field(
        0.6, ge=-3.1416, le=3.1416, description="Lean of the plane about the x axis [rad]."
    )
    waypoints: int = Field(200, ge=8, le=100_000, description="Points along the heart.")


Path3D = Annotated[DoubleRectangle | Heart, Field(discriminator="shape")]


class Evaluation(Section):
    """Where the error is measured, always through the forward kinematics."""

    paths: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$")], Path3D] = Field(
        {
            "rectangles": DoubleRectangle(shape="double_rectangle"),
            "heart": Heart(shape="heart"),
        },
        min_length=1,
        description="Paths to track, by name; the first one fills Table 1. Naming any replaces "
        "these two.",
    )
    cube_points: int = Field(
        8192,
        ge=64,
        le=1_000_000,
        description="Points spread over the whole workspace, the same for every grid.",
    )


class Bounds(Section):
    """How the paper's estimate (Eq. 25) is formed, and how tight the certificates are."""

    average_weight: Literal["mean", "mean_abs", "rms", "max_abs"] = Field(
        "mean", description="Which average of the trained weights stands for w-bar in Eq. 22."
    )
    scale_mm: float | None = Field(
        None,
        gt=0,
        description="Length that turns the estimate into millimetres [mm]; null: the longest side "
        "of the workspace, which is what the paper's column implies.",
    )
    sup_rtol: float = Field(
        1e-3,
        ge=1e-6,
        le=1,
        description="Certified worst case: largest gap between its bounds, as a share.",
    )
    mean_rtol: float = Field(
        0.025,
        ge=5e-3,
        le=1,
        description="Certified mean: its bounds lie within this share of their middle, or within "
        "`mean_atol_mm`. Half the share costs some two to four times as much.",
    )
    mean_atol_mm: float = Field(
        0.02,
        ge=0,
        le=1000,
        description="Certified mean: bounds closer to its middle than this are not asked for [mm].",
    )


class Tolerance(Section):
    """What is good enough: the question that the study answers."""

    error_mm: float = Field(2.0, gt=0, description="Largest position error allowed [mm].")
    of: Literal["worst", "p99", "p95", "mean"] = Field(
        "worst",
        description="Which error: the certified worst case over the workspace, a percentile, or "
        "the mean.",
    )
    where: str = Field(
        "workspace", description="`workspace`, or the name of a path (there errors are measured)."
    )
    success_share: float = Field(
        0.8, gt=0, lt=1, description="Share of trainings that must meet the tolerance."
    )
    confidence: float = Field(
        0.95, gt=0.5, lt=1, description="Confidence in that share, given the seeds trained."
    )
    best_of: int = Field(
        1, ge=1, le=1000, description="Trainings of which the best is used; 1: any one must do."
    )


class Calibration(Section):
    """Whether the answer holds for trainings that had no part in it."""

    seeds: int = Field(
        0,
        ge=0,
        le=100_000,
        description="Trainings of each network with fresh seeds, at its answer and at one rung "
        "below; 0: none.",
    )


class Tracking(Section):
    """Where MLflow keeps the runs."""

    uri: str | None = Field(
        None,
        description="Tracking URI; null: MLFLOW_TRACKING_URI, else sqlite:///mlflow.db here.",
    )


class Study(Section):
    """A study: one arm, one workspace, several sample sizes, many seeds."""

    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9_-]*$",
        max_length=60,
        description="Name of the study's folders under results/ and reports/.",
    )
    title: str = Field("", description="One line for the head of the report.")
    robot: Robot = Robot()
    workspace: Workspace = Workspace()
    samples: Samples = Samples()
    network: Network = Network()
    training: Training = Training()
    methods: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$")], Method] = Field(
        {}, description="Further methods to compare on the same samples, by name."
    )
    evaluation: Evaluation = Evaluation()
    bounds: Bounds = Bounds()
    tolerance: Tolerance = Tolerance()
    calibration: Calibration = Calibration()
    tracking: Tracking = Tracking()

    @model_validator(mode="before")
    @classmethod
    def _methods_inherit(cls, data: Any) -> Any:
        """A method says only what differs from the study's own network and training."""
        methods = data.get("methods") if isinstance(data, dict) else None
        if not isinstance(methods, dict):
            return data
        own = {key: data[key] for key in ("network", "training") if key in data}
        full = {name: _own_budget(_overlay(own, one), one) for name, one in methods.items()}
        return {**data, "methods": full}

    @model_validator(mode="after")
    def _names_exist(self) -> "Study":
        if NETWORK in self.methods:
            raise ValueError(
                f"methods: '{NETWORK}' is the study's own network; choose another name"
            )
        for name in ("workspace", "cube"):
            if name in self.evaluation.paths:
                raise ValueError(
                    f"evaluation.paths: '{name}' means the whole workspace; choose another name"
                )
        places = ("workspace", *self.evaluation.paths)
        if self.tolerance.where not in places:
            raise ValueError(f"'tolerance.where' should be one of {', '.join(places)}")
        return self

    @model_validator(mode="after")
    def _held_out_points_exist(self) -> "Study":
        fewest = min(self.samples.points_per_axis) ** 3
        for name, method in self.all_methods.items():
            if method.kind != "network":
                continue
            where = "training" if name == NETWORK else f"methods.{name}.training"
            held_out = method.training.held_out
            if held_out.source == "fresh" and held_out != self.training.held_out:
                raise ValueError(
                    f"'{where}.held_out': fresh points are recorded once for all methods; set them "
                    "under 'training.held_out', or say 'source: grid' here"
                )
            lost = held_out.counts(fewest)[0]
            if method.training.early_stopping and held_out.source == "grid" and not lost:
                raise ValueError(
                    f"'{where}.early_stopping' has nothing to watch: validation_share "
                    f"{held_out.validation_share:g} of {fewest} samples is no sample; raise it, "
                    "leave out that size, or say 'held_out.source: fresh'"
                )
        return self

    @property
    def all_methods(self) -> dict[str, Method]:
        """Every method by name; the first, ``network``, is the study's own."""
        own = Method(kind="network", network=self.network, training=self.training)
        return {NETWORK: own, **self.methods}

    def for_method(self, name: str, n_samples: int) -> "Study":
        """The study as if a method's network and training were its own.

        Args:
            name: The method.
            n_samples: Samples that train; a budget in steps is turned into epochs by it.
        """
        method = self.all_methods[name]
        training = method.training
        if training.steps:
            epochs = -(-training.steps // training.steps_per_epoch(n_samples))
            training = training.model_copy(update={"steps": None, "epochs": epochs})
        return self.model_copy(update={"network": method.network, "training": training})

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of every network."""
        return tuple(
            range(self.training.first_seed, self.training.first_seed + self.training.seeds)
        )

    def digest(self) -> str:
        """Twelve hexadecimal digits that name the settings that numbers depend on."""
        apart = {"title", "tracking", "calibration"}
        text = json.dumps(self.model_dump(mode="json", exclude=apart), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def parse_study(settings: dict[str, Any], origin: str = "study") -> Study:
    """Validates settings as read from a study file.

    Args:
        settings: The file's content.
        origin: What the messages call the file.

    Raises:
        IksamplesError: One line for each thing that is wrong: the key, the value and what is
            allowed there.
    """
    try:
        return Study.model_validate(settings)
    except ValidationError as error:
        lines = [f"{origin}: {_describe(item)}" for item in error.errors()]
        raise IksamplesError("\n".join(lines)) from None


def read_study(path: str | Path) -> Study:
    """Reads a study file (YAML or JSON).

    Raises:
        IksamplesError: The file cannot be read or does not describe a study.
    """
    try:
        settings = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise IksamplesError(f"{path}: cannot read the study file ({error.strerror}).") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise IksamplesError(f"{path}: not a YAML file ({reason}).") from None
    if not isinstance(settings, dict):
        raise IksamplesError(f"{path}: expected a mapping of settings, found nothing of the kind.")
    return parse_study(settings, str(path))


def _overlay(base: Any, change: Any) -> Any:
    """Settings with some of them replaced, section by section."""
    if not isinstance(base, dict) or not isinstance(change, dict):
        return change
    return {**base, **{key: _overlay(base.get(key), value) for key, value in change.items()}}


def _own_budget(method: Any, change: Any) -> Any:
    """A method that says how many epochs does not inherit a number of steps."""
    said = change.get("training") if isinstance(change, dict) else None
    if isinstance(said, dict) and "epochs" in said and "steps" not in said:
        return {**method, "training": {**method["training"], "steps": None}}
    return method


_SHAPES: dict[str, type[Section]] = {"double_rectangle": DoubleRectangle, "heart": Heart}


def _describe(item: Any) -> str:
    """One validation error as a line for people."""
    # A path's shape stands in the location of an error, though the user never wrote it as a key.
    key = ".".join(str(part) for part in item["loc"] if part not in _SHAPES) or "study"
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}'; known keys here: {', '.join(_keys_at(item['loc'][:-1]))}."
    if item["type"] == "missing":
        return f"'{key}' is missing."
    message = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if not item["loc"]:  # a rule between sections, which names its keys itself
        return f"{message}."
    shown = json.dumps(item["input"], default=str)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return f"'{key}' {message} (found {shown})."


def _keys_at(location: tuple[Any, ...]) -> list[str]:
    """The keys that the section at a location of the study file may have."""
    section: Any = Study
    for part in location:
        if part in _SHAPES:
            section = _SHAPES[part]
        elif part in section.model_fields:
            annotation = section.model_fields[part].annotation
            candidates = (annotation, *getattr(annotation, "__args__", ()))
            section = next((c for c in candidates if hasattr(c, "model_fields")), section)
    return list(section.model_fields)
