"""Certified numbers as text: never on the wrong side, and points that read back."""

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from iksamples.certify.proof import degrees_down, degrees_up, point, rounded_down, rounded_up


@given(st.floats(0, allow_infinity=False), st.integers(0, 8))
def test_bounds_are_rounded_outward_by_less_than_a_last_place(value, decimals):
    exact, step = Fraction(value), Fraction(1, 10**decimals)
    assert exact <= Fraction(rounded_up(value, decimals)) < exact + step
    assert exact - step < Fraction(rounded_down(value, decimals)) <= exact


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=6))
def test_points_read_back_as_they_are(inputs):
    assert [float(part) for part in point(inputs).strip("()").split(", ")] == inputs


PI = Fraction("3.14159265358979323846264338327950288419716939937510")


@given(st.floats(0, float(np.pi)))
def test_degrees_are_rounded_outward(angle):
    exact = Fraction(angle) * 180 / PI
    assert Fraction(degrees_down(angle)) <= exact <= Fraction(degrees_up(angle)) <= 180
    assert degrees_up(angle) - degrees_down(angle) < 1e-12


def test_an_angle_beyond_half_a_turn_is_half_a_turn():
    assert degrees_up(np.nextafter(np.pi, 4)) == 180
    assert degrees_up(np.inf) == np.inf
    assert np.isnan(degrees_up(np.nan))
