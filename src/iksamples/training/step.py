"""The training step of a whole study: every network of it, on every set of samples."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from iksamples.results import networks
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study
from iksamples.training.run import count_trained, train


def train_study(
    study: Study,
    sample_sets: Sequence[SampleSet],
    output: Path,
    cache: Path | None = None,
    progress: bool = False,
) -> None:
    """Trains every network of a study on every set of samples.

    Args:
        study: The study.
        sample_sets: The samples.
        output: Gets a folder ``<method>/<samples>`` for each.
        cache: Folder of trained seeds, one inside it for each of these; None: keep none.
        progress: Report on stderr.
    """
    for method, samples, own in _trainings(study, sample_sets):
        place = Path(method) / samples.label
        train(own, [samples], [output / place], cache / place if cache else None, progress)


def trained_before(study: Study, sample_sets: Sequence[SampleSet], cache: Path) -> dict[str, int]:
    """How many networks of each method the cache holds, so that they are not trained again.

    Args:
        study: The study.
        sample_sets: The samples.
        cache: The cache that ``train_study`` is given.
    """
    found = dict.fromkeys(networks(study), 0)
    for method, samples, own in _trainings(study, sample_sets):
        found[method] += count_trained(own, samples, cache / method / samples.label)
    return found


def _trainings(
    study: Study, sample_sets: Sequence[SampleSet]
) -> Iterator[tuple[str, SampleSet, Study]]:
    """Every method with every set of samples, and the study as if it had that method alone."""
    for method in networks(study):
        training = study.all_methods[method].training
        for samples in sample_sets:
            n_trained = training.n_trained(samples.n_samples)
            yield method, samples, study.for_method(method, n_trained)
