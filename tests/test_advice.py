"""What a valid study may still get wrong."""

import pytest

from iksamples.advice import advice
from iksamples.study import parse_study


def notes(**settings):
    return advice(parse_study({"name": "s", **settings}))


@pytest.mark.parametrize(("seeds", "enough"), [(13, False), (14, True)])
def test_the_fewest_seeds_that_can_show_it(seeds, enough):
    # 0.8^13 is more than 5 %, and 0.8^14 less.
    assert (0.8**seeds < 0.05) is enough
    found = notes(training={"seeds": seeds})
    assert found == [] if enough else "14 can (training.seeds)" in found[0]


def test_the_best_of_several_needs_fewer():
    assert notes(training={"seeds": 13})
    assert notes(training={"seeds": 13}, tolerance={"best_of": 3}) == []


def test_a_method_without_a_grid_is_named():
    methods = {"spline": {"kind": "cubic"}, "kernel": {"kind": "rbf"}}
    [line] = notes(methods=methods, samples={"designs": ["chebyshev", "sobol"]})
    assert line.startswith("spline has no results on sobol samples")
    assert notes(methods=methods) == []
