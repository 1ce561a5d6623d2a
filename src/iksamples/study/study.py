"""The whole study, and the rules between its sections."""

import hashlib
import json
from itertools import chain
from typing import Any

from pydantic import Field, field_serializer, model_validator

from iksamples.errors import IksamplesError
from iksamples.study.arm import Arm
from iksamples.study.evaluation import Bounds, Evaluation, Replication, Tolerance
from iksamples.study.recorded import TENSOR, Design, Recorded, Samples, grid_shape
from iksamples.study.sections import (
    Asked,
    Name,
    Robot,
    Section,
    StudyName,
    Workspace,
    without_password,
)
from iksamples.study.training import Method, Network, Training


class Readings(Section):
    """A search over readings of the paper, and the best of them again with fresh seeds."""

    count: int = Field(600, ge=1, le=20_000, description="Readings drawn at random.")
    seeds: int = Field(
        16,
        ge=2,
        le=1000,
        description="Networks of each reading and grid in the search; 16 train as fast as one.",
    )
    best: int = Field(12, ge=1, le=1000, description="Best readings that are trained again.")
    fresh_seeds: int = Field(
        100, ge=2, le=10_000, description="Networks of each when it is trained again."
    )
    jobs: int = Field(8, ge=1, le=256, description="Jobs into which each of the two is cut.")
    seed: int = Field(0, ge=0, lt=2**31, description="Seed of the draw.")


class Budget(Section):
    """What a study may take; one that is expected to take more is not started."""

    memory_gb: float = Field(
        8.0, gt=0, le=100_000, description="Memory of any one job, at most [GB]."
    )
    processor_hours: float = Field(
        24.0,
        gt=0,
        le=10_000_000,
        description="Time of one core, all jobs together, at most [h]; `iksamples plan` says how "
        "long a study is expected to take.",
    )


NETWORK = "network"
"""Name of the method that a study's own ``network`` and ``training`` sections describe."""

_FOLDERS = ("benchmarks", "cache", "floor", "fresh", "logs", "parts", "recordings", "samples")
"""What lies in the results beside the folders of the methods."""


PROVED_TOGETHER = 50
"""Networks that are searched together for their worst cases. What is found depends in its last
digits on who is searched beside, so that jobs are cut only between them."""


class Tracking(Section):
    """Where MLflow keeps the runs."""

    uri: str | None = Field(
        None,
        description="Tracking URI; null: MLFLOW_TRACKING_URI, else sqlite:///mlflow.db here. A "
        "password in it is kept in no file; better name the server without it, and the whole "
        "address in MLFLOW_TRACKING_URI.",
    )

    @field_serializer("uri")
    def _kept_without_password(self, uri: str | None) -> str | None:
        return uri and without_password(uri)


class Study(Section):
    """A study: one arm, one workspace, several sample sizes, many seeds."""

    name: StudyName = Field(description="Name of the study's folders under results/ and reports/.")
    title: str = Field("", max_length=200, description="One line for the head of the report.")
    robot: Robot = Robot()
    arm: Arm | None = Field(
        None,
        description="How the arm itself differs from its drawing, the robot's file; null: not at "
        "all.",
    )
    task: Asked = Asked()
    workspace: Workspace = Workspace()
    samples: Samples = Samples()
    network: Network = Network()
    training: Training = Training()
    methods: dict[Name, Method] = Field(
        {},
        max_length=1000,
        description="Further methods to compare on the same samples, by name.",
    )
    evaluation: Evaluation = Evaluation()
    bounds: Bounds = Bounds()
    tolerance: Tolerance = Tolerance()
    replication: Replication = Replication()
    tracking: Tracking = Tracking()
    seeds_per_job: int | None = Field(
        None,
        ge=PROVED_TOGETHER,
        le=100_000,
        multiple_of=PROVED_TOGETHER,
        description="Seeds that one job trains, on all samples, or proves; null: as many as take "
        "about ten minutes, which for most studies are all. No number depends on it.",
    )
    budget: Budget = Budget()
    paper: bool = Field(
        False,
        description="Whether this is the paper's own case (arXiv 2605.23583): its bounds, its "
        "claims and its Table 1 are held against the results.",
    )
    readings: Readings | None = Field(
        None,
        description="Search for the reading of the paper that gives its Table 1, and nothing else; "
        "null: an ordinary study.",
    )

    @model_validator(mode="before")
    @classmethod
    def _methods_inherit(cls, data: Any) -> Any:
        """A method says only what differs from the study's own network and training."""
        methods = data.get("methods") if isinstance(data, dict) else None
        if not isinstance(methods, dict):
            return data
        own = {key: data[key] for key in ("network", "training") if key in data}
        full = {name: _own_budget(overlay(own, one), one) for name, one in methods.items()}
        return {**data, "methods": full}

    @model_validator(mode="after")
    def _names_exist(self) -> "Study":
        for name, method in self.methods.items():
            records, own = self.samples.recorded, (method.kind, method.design)
            chosen = records and records.kind == "sockets" and own == ("calibrated", "optimal")
            if method.design and not chosen and (records or method.kind == "network"):
                raise ValueError(
                    f"'methods.{name}.design' is for methods that are not trained, on samples that "
                    "are computed (or postures in sockets, for kind: calibrated, optimal); leave "
                    "it out"
                )
        if NETWORK in self.methods:
            raise ValueError(
                f"methods: '{NETWORK}' is the study's own network; choose another name"
            )
        for name in _FOLDERS:
            if name in self.methods:
                raise ValueError(
                    f"methods: '{name}' is another folder of the results; choose another name"
                )
        for name in ("workspace", "cube"):
            if name in self.evaluation.paths:
                raise ValueError(
                    f"evaluation.paths: '{name}' means the whole workspace; choose another name"
                )
        if self.tolerance.angle_deg and self.task.orientation == "free":
            raise ValueError(
                "'tolerance.angle_deg' is of no use with 'task.orientation: free'; leave it out"
            )
        places = ("workspace", *self.evaluation.paths)
        if self.tolerance.where not in places:
            raise ValueError(f"'tolerance.where' should be one of {', '.join(places)}")
        return self

    @model_validator(mode="after")
    def _readings_are_all_there_is(self) -> "Study":
        """Every other setting is part of a reading, or of no use to one."""
        own = {"name", "title", "readings", "budget"}
        plain = {name: field.default for name, field in type(self).model_fields.items()}
        ignored = [name for name in plain if name not in own and getattr(self, name) != plain[name]]
        if self.readings and ignored:
            raise ValueError(
                "a study with 'readings' sets nothing else, since each reading is a study of its "
                f"own; leave out {', '.join(map(repr, ignored))}"
            )
        return self

    @model_validator(mode="after")
    def _the_paper_has_no_other_arm(self) -> "Study":
        if self.paper and self.arm:
            raise ValueError("'arm' is no part of the paper's own case; leave out 'paper' or 'arm'")
        if self.arm and self.tolerance.best_of > 1:
            raise ValueError(
                "'tolerance.best_of' chooses among trainings on one arm, and with 'arm' each is on "
                "another; leave it out"
            )
        return self

    @model_validator(mode="after")
    def _records_are_of_one_real_arm(self) -> "Study":
        if self.samples.recorded is None:
            return self
        for name, given in {
            "paper": self.paper,
            "arm": self.arm,
            "replication.seeds": self.replication.seeds,
            "seeds_per_job": self.seeds_per_job,
            "tolerance.where": self.tolerance.where != "workspace",
            "tolerance.best_of": self.tolerance.best_of > 1,
        }.items():
            if given:
                raise ValueError(
                    f"'{name}' is of no use with 'samples.recorded', whose records of a real arm "
                    "are all that is learned from and judged by; leave it out"
                )
        return self

    @model_validator(mode="after")
    def _a_limit_for_each_input(self) -> "Study":
        n = self.task.n_positions
        names = {"mm": self.task.inputs[:n], "rad": self.task.inputs[n:]}
        for unit, limits in (("mm", self.workspace.lower_mm), ("rad", self.workspace.lower_rad)):
            if len(limits) != len(names[unit]):
                raise ValueError(
                    f"'workspace.lower_{unit}' and 'upper_{unit}' should have a number for each of "
                    f"the inputs ({', '.join(names[unit]) or 'none'}); they have {len(limits)}"
                )
        return self

    @model_validator(mode="after")
    def _grids_differ(self) -> "Study":
        grids = [design for design in self.designs() if design in TENSOR]
        if not grids:
            return self
        fewest, seen = 2 ** len(self.task.inputs), dict[tuple[int, ...], int]()
        alone = len(grids) == len(self.designs())
        for n in self.sizes if alone else self.sizes_of(grids[0]) or self.sizes[-1:]:
            if n < fewest:
                raise ValueError(
                    f"'samples.sizes': {n} is less than the {fewest} corners of the workspace, the "
                    "smallest grid"
                )
            shape = self.grid_shape(n)
            if shape in seen:
                raise ValueError(
                    f"'samples.sizes': {seen[shape]} and {n} are both nearest to a grid of "
                    f"{' x '.join(map(str, shape))}; leave one out"
                )
            seen[shape] = n
        return self

    @model_validator(mode="after")
    def _held_out_points_exist(self) -> "Study":
        fewest = min(self.sizes)
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

    @property
    def recording(self) -> Recorded:
        """``samples.recorded``, of a study that has it."""
        assert self.samples.recorded is not None
        return self.samples.recorded

    def require_own_arm(self) -> None:
        """Stops at records without a drawing of their arm: the default is the paper's.

        Raises:
            IksamplesError: No arm is named.
        """
        if self.samples.recorded and "urdf" not in self.robot.model_fields_set:
            raise IksamplesError(
                "samples.recorded: name the arm, robot.urdf; for records of an arm without a "
                "drawing there is `iksamples size recorded.csv`."
            )

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
    def sizes(self) -> list[int]:
        """The sizes to compare, in samples, ascending; a grid may round them."""
        return self.samples.n_samples(len(self.task.inputs))

    def sizes_of(self, design: Design) -> list[int]:
        """The sizes that a design can have: a grid has the workspace's corners at least."""
        fewest = 2 ** len(self.task.inputs) if design in TENSOR else 0
        return [n for n in self.sizes if n >= fewest]

    def designs(self, method: str | None = None) -> list[Design]:
        """How the samples of a method are placed, or of all methods."""
        of = [self.all_methods[method]] if method else self.all_methods.values()
        each = [[one.design] if one.design else self.samples.designs for one in of]
        return list(dict.fromkeys(chain.from_iterable(each)))

    def grid_shape(self, n: int) -> tuple[int, ...]:
        """Points along each side of the workspace of the grid that is nearest to n samples."""
        box = self.workspace
        sides = [high - low for low, high in zip(box.lower, box.upper, strict=True)]
        # Angles after lengths, with which they cannot be compared.
        angles = self.task.n_positions
        return grid_shape(n, [*sides[:angles], *(side * 1e-9 for side in sides[angles:])])

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of every network."""
        return self.training.all_seeds

    @property
    def arms(self) -> tuple[int, ...]:
        """The seed of every simulated arm that samples are recorded on; none without ``arm``."""
        if self.arm is None:
            return ()
        return tuple(
            sorted({seed for one in self.all_methods.values() for seed in one.training.all_seeds})
        )

    def digest(self) -> str:
        """Twelve hexadecimal digits that name the settings that numbers depend on."""
        apart = {"title", "tracking", "replication", "seeds_per_job", "budget"}
        text = json.dumps(self.model_dump(mode="json", exclude=apart), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def overlay(base: Any, change: Any) -> Any:
    """Settings with some of them replaced, section by section."""
    if not isinstance(base, dict) or not isinstance(change, dict):
        return change
    return {**base, **{key: overlay(base.get(key), value) for key, value in change.items()}}


def _own_budget(method: Any, change: Any) -> Any:
    """A method that says how many epochs does not inherit a number of steps."""
    said = change.get("training") if isinstance(change, dict) else None
    if isinstance(said, dict) and "epochs" in said and "steps" not in said:
        return {**method, "training": {**method["training"], "steps": None}}
    return method
