"""What is proved of networks that were read from a file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.checker import Claim, verify
from iksamples.certify.compared import Measure
from iksamples.certify.printing import degrees_down, degrees_up, point, rounded_down, rounded_up
from iksamples.certify.readers.network import Reading
from iksamples.certify.rounding import inference_slack, stored_slack
from iksamples.certify.search import certify_stack
from iksamples.region import Region


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proved:
    """What the checker proved of one network: of its position [mm], or of its angle [deg].

    Attributes:
        what: What it is about, in words.
        unit: ``"mm"`` or ``"deg"``.
        upper: No input of the region has a larger error; infinite: nothing is proved.
        lower: The error at ``argmax`` is at least this.
        argmax: An input of the region, shape (d,).
        float32: What evaluating the layers in float32 adds at most.
        boxes: Boxes that the search bounded.
        complete: Whether the bounds met as closely as asked.
    """

    what: str
    unit: str
    upper: float
    lower: float
    argmax: Floats
    float32: float
    boxes: int
    complete: bool

    def in_words(self) -> str:
        """The bounds, rounded outward."""
        if self.upper == math.inf:
            return f"NOT PROVED, so there is no bound of the {self.what}"
        return (
            f"no {self.what} is missed by more than {rounded_up(self.upper)} {self.unit}; at "
            f"{point(self.argmax)} it is missed by {rounded_down(self.lower)} {self.unit}"
        )


def float32_in_words(proved: Iterable[Proved]) -> str:
    """What evaluating the layers in float32 adds at most, over several bounds."""
    most: dict[str, float] = {}
    for one in proved:
        most[one.unit] = max(most.get(one.unit, 0.0), one.float32)
    if math.inf in most.values():
        return "evaluating these layers in float32 may overflow"
    added = " and ".join(f"{rounded_up(value)} {unit}" for unit, value in most.items())
    return f"evaluating these layers in float32 adds at most {added}"


def prove(
    reading: Reading,
    chain: SerialChain,
    region: Region,
    target: Target,
    *,
    rtol: float = 1e-3,
    time_limit_s: float = 60.0,
    max_boxes: int = 1_000_000,
) -> dict[Measure, list[Proved]]:
    """Bounds the largest errors of every network that was read, and checks the proofs.

    Args:
        reading: The networks.
        chain: The arm.
        region: The inputs.
        target: What is asked of the tool.
        rtol: How closely the bounds are to meet.
        time_limit_s: Time for each search, per network [s].
        max_boxes: Boxes that each search bounds at most, per network.

    Returns:
        Of the position and, unless the orientation is free, of the angle: one per network.

    Raises:
        IksamplesError: Network, arm, region and target do not fit together.
    """
    limits = {"rtol": rtol, "time_limit_s": time_limit_s, "max_boxes": max_boxes}
    measures: list[Measure] = ["position"]
    if target.orientation != "free":
        measures.append("angle")
    return {
        measure: _proved(reading, chain, region, target, measure, limits) for measure in measures
    }


def _proved(
    reading: Reading,
    chain: SerialChain,
    region: Region,
    target: Target,
    measure: Measure,
    limits: dict[str, Any],
) -> list[Proved]:
    """What is proved of one measure, by network."""
    network = reading.network
    # Half a unit in the last place of each number is within what plain evaluation rounds. Distances
    # and angles between rotations are metrics, so what it does to the tool can be added.
    rounding = stored_slack(network, chain, region, target, measure)
    allowance = inference_slack(network, chain, region, target, measure)
    found = certify_stack(
        network, chain, region, target=target, measure=measure, keep_leaves=True, **limits
    )
    proved = []
    for row, one in enumerate(found):
        claim = Claim(
            network, row, chain, region, one.upper, one.lower, one.argmax, target, measure
        )
        # What the checker itself has proved holds, also where the search stated less or more.
        check = verify(claim, one.leaves)
        upper, lower, single = check.upper, check.lower, float(allowance[row])
        if not reading.exact:
            upper = math.nextafter(upper + rounding[row], math.inf)
            lower = max(math.nextafter(lower - rounding[row], -math.inf), 0.0)
        what, unit = "position", "mm"
        if measure == "angle":
            what = "rotation" if target.orientation == "fixed" else "direction of the tool's z axis"
            unit = "deg"
            upper, lower, single = degrees_up(upper), degrees_down(lower), degrees_up(single)
        proved.append(Proved(what, unit, upper, lower, one.argmax, single, one.boxes, one.complete))
    return proved
