"""Worst cases searched and then proved by the checker, and their numbers, rounded outward."""

import math
from collections.abc import Iterable, Iterator
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Any

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.checker import Claim, Verification, verify
from iksamples.certify.compared import Measure
from iksamples.certify.search import Certificate, certify_stack
from iksamples.certify.table import Table
from iksamples.network import StackedMLP
from iksamples.region import Region


_ANY = Context(prec=400)
"""Digits for every float64: the largest has 309 before the point."""


def checked(
    answers: StackedMLP | Table,
    chain: SerialChain,
    region: Region,
    target: Target,
    measure: Measure,
    **search: Any,
) -> Iterator[tuple[Certificate, Verification]]:
    """The largest error of every network, and what the checker makes of it.

    Args:
        answers: The networks, or a look-up table.
        chain: The arm.
        region: The inputs.
        target: What is asked of the tool.
        measure: Which error.
        **search: What ``certify_stack`` takes besides.
    """
    found = certify_stack(
        answers, chain, region, target=target, measure=measure, keep_leaves=True, **search
    )
    for row, one in enumerate(found):
        bounds = one.upper, one.lower, one.argmax
        yield one, verify(Claim(answers, row, chain, region, *bounds, target, measure), one.leaves)


def rounded_up(bound: float, decimals: int = 4) -> str:
    """An upper bound with that many decimals, at least the bound itself."""
    return str(Decimal(float(bound)).quantize(Decimal(1).scaleb(-decimals), ROUND_CEILING, _ANY))


def rounded_down(taken: float, decimals: int = 4) -> str:
    """A value that is attained with that many decimals, at most the value itself."""
    return str(Decimal(float(taken)).quantize(Decimal(1).scaleb(-decimals), ROUND_FLOOR, _ANY))


def point(inputs: Iterable[float]) -> str:
    """An input with as many digits as it takes to read the same numbers back: ``(20, 37.5, 0)``."""
    return f"({', '.join(repr(float(x)).removesuffix('.0') for x in inputs)})"


def degrees_up(bound_rad: float) -> float:
    """An upper bound of an angle [deg], at least the one in radians and at most half a turn.

    Where there is none, there is none in degrees.
    """
    if not math.isfinite(bound_rad):
        return bound_rad
    return min(math.nextafter(math.degrees(bound_rad) * (1.0 + 2.0**-50), math.inf), 180.0)


def degrees_down(taken_rad: float) -> float:
    """A value of an angle that is attained [deg], at most the one in radians."""
    return max(math.nextafter(math.degrees(taken_rad) * (1.0 - 2.0**-50), -math.inf), 0.0)
