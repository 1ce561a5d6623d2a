"""Certified numbers as text: rounded outward, and points that reproduce what is said of them."""

from collections.abc import Iterable
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal


def rounded_up(bound: float, decimals: int = 4) -> str:
    """An upper bound with that many decimals, at least the bound itself."""
    return str(Decimal(float(bound)).quantize(Decimal(1).scaleb(-decimals), ROUND_CEILING))


def rounded_down(taken: float, decimals: int = 4) -> str:
    """A value that is attained with that many decimals, at most the value itself."""
    return str(Decimal(float(taken)).quantize(Decimal(1).scaleb(-decimals), ROUND_FLOOR))


def point(inputs: Iterable[float]) -> str:
    """An input with as many digits as it takes to read the same numbers back: ``(20, 37.5, 0)``."""
    return f"({', '.join(repr(float(x)).removesuffix('.0') for x in inputs)})"
