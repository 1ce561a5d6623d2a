"""The training step of a whole study: every network of it, on every set of samples."""

from collections.abc import Sequence
from pathlib import Path

from iksamples.results import networks
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.training.problem import held_out_counts
from iksamples.training.run import train


def train_study(
    study: Study,
    sample_sets: Sequence[SampleSet],
    output: Path,
    cache: Path | None = None,
    progress: bool = False,
    methods: Sequence[str] | None = None,
) -> None:
    """Trains every network of a study on every set of samples.

    Args:
        study: The study.
        sample_sets: The samples.
        output: Gets a folder ``<method>/<samples>`` for each.
        cache: Folder of trained seeds, one inside it for each of these; None: keep none.
        progress: Report on stderr.
        methods: Only these; None: all networks.
    """
    for method in methods or networks(study):
        held_out = study.all_methods[method].training.held_out
        for samples in sample_sets:
            n_trained = samples.n_samples
            if held_out.source == "grid":
                n_trained -= sum(held_out_counts(n_trained, held_out))
            train(
                study.for_method(method, n_trained),
                [samples],
                [output / method / samples.label],
                cache / method / samples.label if cache else None,
                progress,
            )
