"""The networks, how they are trained, and the methods they are compared with."""

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from iksamples.study.recorded import Design
from iksamples.study.sections import Section


class Network(Section):
    """The network's shape."""

    hidden: list[Annotated[int, Field(ge=1, le=1024)]] = Field(
        [16], max_length=8, description="Neurons of each hidden layer."
    )
    activation: Literal["relu", "tanh"] = Field(
        "relu", description="Activation of the hidden layers; the output layer is linear."
    )

    def n_parameters(self, n_inputs: int, n_outputs: int) -> int:
        """Weights and biases of a network of so many inputs and outputs."""
        return sum((a + 1) * b for a, b in pairwise((n_inputs, *self.hidden, n_outputs)))


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

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """The seed of every network."""
        return tuple(range(self.first_seed, self.first_seed + self.seeds))

    @model_validator(mode="after")
    def _validation_for_early_stopping(self) -> "Training":
        if self.early_stopping and not (
            self.held_out.validation_share
            or (self.held_out.source == "fresh" and self.held_out.at_least)
        ):
            raise ValueError("early_stopping needs held_out.validation_share above 0")
        return self


MethodKind = Literal[
    "network",
    "multilinear",
    "cubic",
    "polynomial",
    "rbf",
    "gaussian-process",
    "nominal",
    "calibrated",
    "trigonometric",
    "residual",
]


class Method(Section):
    """A way from samples to joint angles, compared with the study's own network."""

    kind: MethodKind = Field(
        "network",
        description="A network, an interpolation of the same samples (multilinear, cubic and "
        "polynomial need a full grid), the drawing's inverse as it is (nominal), of the drawing "
        "fitted to the samples (calibrated) or corrected by a Gaussian process (residual), or a "
        "model that only knows that joints turn (trigonometric).",
    )
    design: Design | None = Field(
        None,
        description="How the samples of a method that is not trained are placed, where that is "
        "another way than `samples.designs`; null: as they say. Of recorded postures in "
        "sockets a calibrated drawing can choose as many of each socket that tell most (optimal).",
    )
    network: Network = Field(
        Network(), description="What differs from the study's `network` (kind: network)."
    )
    training: Training = Field(
        Training(), description="What differs from the study's `training` (kind: network)."
    )
