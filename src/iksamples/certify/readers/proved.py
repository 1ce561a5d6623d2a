"""What is proved of networks that were read from a file."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.checker import Claim, verify
from iksamples.certify.readers.network import Reading
from iksamples.certify.rounding import inference_slack_mm, stored_slack_mm
from iksamples.certify.search import certify_stack
from iksamples.region import Region


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proved:
    """What the checker proved of one network.

    Attributes:
        upper_mm: No position of the region has a larger error [mm]; infinite: nothing is proved.
        lower_mm: The error at ``argmax`` is at least this [mm].
        argmax: An input of the region, shape (d,).
        float32_mm: What evaluating the layers in float32 adds at most [mm].
        boxes: Boxes that the search bounded.
        complete: Whether the bounds met as closely as asked.
    """

    upper_mm: float
    lower_mm: float
    argmax: Floats
    float32_mm: float
    boxes: int
    complete: bool


def prove(
    reading: Reading,
    chain: SerialChain,
    region: Region,
    *,
    target: Target | None = None,
    rtol: float = 1e-3,
    time_limit_s: float = 60.0,
    max_boxes: int = 1_000_000,
) -> list[Proved]:
    """Bounds the largest position error of every network that was read, and checks the proof.

    Args:
        reading: The networks.
        chain: The arm.
        region: The inputs.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.
        rtol: How closely the bounds are to meet.
        time_limit_s: Time to search, per network [s].
        max_boxes: Boxes to bound, per network.
    """
    network = reading.network
    # Half a unit in the last place of each number is within what plain evaluation rounds.
    rounding_mm = stored_slack_mm(network, chain, region, target)
    allowance_mm = inference_slack_mm(network, chain, region, target)
    found = certify_stack(
        network,
        chain,
        region,
        target=target,
        rtol=rtol,
        time_limit_s=time_limit_s,
        max_boxes=max_boxes,
        keep_leaves=True,
    )
    proved = []
    for row, one in enumerate(found):
        claim = Claim(network, row, chain, region, one.upper, one.lower, one.argmax, target)
        # What the checker itself has proved holds, also where the search stated less or more.
        check = verify(claim, one.leaves)
        upper_mm, lower_mm = check.upper, check.lower
        if not reading.exact:
            upper_mm = math.nextafter(upper_mm + rounding_mm[row], math.inf)
            lower_mm = max(math.nextafter(lower_mm - rounding_mm[row], -math.inf), 0.0)
        proved.append(
            Proved(
                upper_mm,
                lower_mm,
                one.argmax,
                float(allowance_mm[row]),
                one.boxes,
                one.complete,
            )
        )
    return proved
