"""Certified numbers as text: never on the wrong side, and points that read back."""

from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st

from iksamples.certify.printing import point, rounded_down, rounded_up


@given(st.floats(0, 1e6, allow_subnormal=True), st.integers(0, 8))
def test_bounds_are_rounded_outward_by_less_than_a_last_place(value, decimals):
    exact, step = Fraction(value), Fraction(1, 10**decimals)
    assert exact <= Fraction(rounded_up(value, decimals)) < exact + step
    assert exact - step < Fraction(rounded_down(value, decimals)) <= exact


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=6))
def test_points_read_back_as_they_are(inputs):
    assert [float(part) for part in point(inputs).strip("()").split(", ")] == inputs
