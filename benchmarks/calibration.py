"""How many poses calibrate a drawing, and whether what is said of that holds: docs/calibration.md.

    python benchmarks/calibration.py

Three parts, all on arms drawn at random about the paper's: poses needed by method and noise; the
worst error that is said not to be exceeded, held against the true one; and recording in rounds.
"""

import argparse
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from functools import cache

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.inverse import followed
from iksamples.arm.real import deviated
from iksamples.calibration.design import CANDIDATES, in_order, optimal, postures
from iksamples.calibration.fit import fit_arm
from iksamples.calibration.known import Fitted, Prior
from iksamples.calibration.rounds import next_round
from iksamples.calibration.worst import Measured, judged_effects, worst_mm
from iksamples.methods.predictor import NotApplicableError
from iksamples.methods.registry import fit
from iksamples.samples.record import record_samples, region_points
from iksamples.study import Tolerance, parse_study
from iksamples.task import study_task


TASK = study_task(parse_study({"name": "paper"}))
DRAWING = TASK.drawing
PRIOR = Prior()
SD = PRIOR.deviations(DRAWING.n_joints)
POINTS = TASK.reach(region_points(TASK.region, 40))
NOISES_MM = (0.0, 0.1, 0.3)
LIMITS_MM = (2.0, 0.5, 0.1)
SHARE = 0.95
SIZES = (2, 3, 4, 5, 6, 8, 12, 16, 24, 40, 60)
GRIDS = {"trigonometric": (3, 4, 5, 6), "residual": (2, 3, 4, 5), "cubic": (2, 3, 4, 5, 6)}
MOST_ROUNDS = 6
MOST_ALONE = 16


def arm_of(seed: int, scale: float = 1.0) -> SerialChain:
    """An arm whose deviations are as the prior has them, or so many times larger."""
    return deviated(DRAWING, scale * SD * np.random.default_rng([seed, 1]).normal(size=SD.shape))


def noise_of(seed: int, n: int, noise_mm: float, stream: int = 2) -> Floats:
    """Noise of measured positions, point by point, shape (n, 3)."""
    return noise_mm * np.random.default_rng([seed, stream]).normal(size=(n, 3))


def true_worst_mm(arm: SerialChain, model: SerialChain) -> float:
    """The largest error over the workspace of an arm that is sent where its model says."""
    off = arm.forward_mm(followed(POINTS, model)) - POINTS.x
    return float(np.nanmax(np.linalg.norm(off, axis=1)))


def needed(sizes: Sequence[int], error_mm: Callable[[int, int], float], arms: int) -> str:
    """Fewest poses with which at least 95 % of the arms keep each tolerance, as cells of a table.

    Args:
        sizes: Numbers of poses that are tried, ascending.
        error_mm: Worst error with so many poses on the arm of a seed.
        arms: How many arms.
    """
    error_mm = cache(error_mm)

    def keeps(n: int, limit: float) -> bool:
        left = int((1 - SHARE) * arms + 1e-9)  # arms that may miss it; no more are tried
        for seed in range(arms):
            left -= not error_mm(n, seed) <= limit
            if left < 0:
                return False
        return True

    cells = []
    for limit in LIMITS_MM:
        at = bisect_left(sizes, True, key=lambda n, limit=limit: keeps(n, limit))
        cells.append(str(sizes[at]) if at < len(sizes) else f"> {sizes[-1]}")
    return " | ".join(cells)


@cache
def candidates(anywhere: bool) -> Floats:
    """Postures that may be recorded, with the tool in the workspace or anywhere."""
    places = None if anywhere else region_points(TASK.region, 1000)
    return postures(DRAWING, CANDIDATES, np.random.default_rng(0), places_mm=places)


@cache
def poses(design: str, n: int, noise_mm: float, seed: int = 0) -> Floats:
    """Postures of a design: random ones differ from arm to arm, the others do not."""
    if design == "random":
        return candidates(False)[np.random.default_rng([seed, 3]).permutation(CANDIDATES)[:n]]
    before = Fitted.unmeasured(DRAWING, PRIOR, noise_mm)
    joints = candidates(design == "optimal, anywhere")
    informs = Measured(noise_mm).informs(before, joints)
    judged = judged_effects(TASK.target, Tolerance(), before, POINTS.joints)
    return joints[optimal(before, informs, n, judged)]


def fitted(
    arm: SerialChain, joints: Floats, noise_mm: float, seed: int, known: bool = True
) -> Fitted:
    """The drawing fitted to what an arm's tool is measured at in some postures."""
    x = arm.forward_mm(joints) + noise_of(seed, len(joints), noise_mm)
    return fit_arm(DRAWING, joints, x, prior=PRIOR, noise_mm=noise_mm if known else None)


def ladder(arms: int) -> Iterator[str]:
    """Poses needed, by method, noise and tolerance."""
    yield "| method | poses | noise [mm] | 2 mm | 0.5 mm | 0.1 mm |\n|---|---|---|---|---|---|"
    cells = needed([0], lambda _, seed: true_worst_mm(arm_of(seed), DRAWING), arms)
    yield f"| nominal | none | any | {cells.replace('> 0', 'never')} |"
    for design in ("random", "optimal", "optimal, anywhere"):
        for noise in NOISES_MM:

            def error_mm(n: int, seed: int, design: str = design, noise: float = noise) -> float:
                joints = poses(design, n, noise, seed if design == "random" else 0)
                return true_worst_mm(arm_of(seed), fitted(arm_of(seed), joints, noise, seed).chain)

            yield f"| calibrated | {design} | {noise:g} | {needed(SIZES, error_mm, arms)} |"
    for kind, sides in GRIDS.items():
        for noise in NOISES_MM:
            sizes = [m**3 for m in sides]
            cells = needed(sizes, on_grids(kind, sizes, noise, arms), arms)
            yield f"| {kind} | grid | {noise:g} | {cells} |"


def on_grids(
    kind: str, sizes: list[int], noise_mm: float, arms: int
) -> Callable[[int, int], float]:
    """Worst error of a method with so many samples of a grid on the arm of a seed."""
    arm = {"deviation_mm": PRIOR.displacement_mm, "deviation_rad": PRIOR.rotation_rad}
    study = parse_study(
        {"name": "arms", "arm": arm | {"noise_mm": noise_mm}, "training": {"seeds": arms}}
    )
    task = study_task(study)
    sets = {n: record_samples(study, task, "grid", n) for n in sizes}

    def error_mm(n: int, seed: int) -> float:
        try:
            joints = fit(kind, task, sets[n].of(seed)).predict(POINTS.x)[0]
        except NotApplicableError:
            return np.inf
        off = task.chain_of(seed).forward_mm(joints) - POINTS.x
        return float(np.max(np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf)))

    return error_mm


def bounds(arms: int) -> Iterator[str]:
    """The worst error that is said not to be exceeded with 95 % confidence, and the true one."""
    yield (
        "| poses | noise [mm] | noise | arms | holds | bound / true worst, median "
        "| true worst, 95 % quantile / median |"
    )
    yield "|---|---|---|---|---|---|---|"
    cases: list[tuple[str, int, float, bool, float]] = [
        ("random", 8, 0.1, True, 1.0),
        ("optimal", 8, 0.1, True, 1.0),
        ("optimal, anywhere", 8, 0.1, True, 1.0),
        ("optimal", 12, 0.3, False, 1.0),
        ("optimal", 8, 0.1, True, 2.0),
    ]
    for design, n, noise, known, scale in cases:
        held, ratio, worst = [], [], []
        for seed in range(arms):
            joints = poses(design, n, noise, seed if design == "random" else 0)
            arm = arm_of(seed, scale)
            found = fitted(arm, joints, noise, seed, known)
            judged = judged_effects(TASK.target, Tolerance(), found, followed(POINTS, found.chain))
            bound, true = worst_mm(found, judged, SHARE, 1000), true_worst_mm(arm, found.chain)
            held.append(true <= bound)
            ratio.append(bound / true)
            worst.append(true)
        off = "as expected" if scale == 1 else f"{scale:g} times as far off"
        yield (
            f"| {n} {design} | {noise:g} | {'known' if known else 'estimated'} | {arms}, {off} | "
            f"{np.mean(held):.1%} | {np.median(ratio):.2f} | "
            f"{np.quantile(worst, SHARE) / np.median(worst):.2f} |"
        )


def rounds(arms: int) -> Iterator[str]:
    """Recording in rounds: how often a stop misses the tolerance, and what it costs."""
    yield (
        "| tolerance [mm] | noise [mm] | noise | arms | missed at the stop | rounds: 1, 2, 3, more "
        "| poses, median (most) | least for this arm | for 95 % of arms | ratio to it |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    cases = [
        (2.0, 0.1, True, 1.0),
        (0.5, 0.1, True, 1.0),
        (1.0, 0.3, True, 1.0),
        (0.5, 0.1, False, 1.0),
        (1.0, 0.3, False, 1.0),
        (0.5, 0.1, True, 2.0),
    ]
    for limit, noise, known, scale in cases:
        step = one_step(noise if known else None, limit)
        missed, taken, n, least = [], [], [], []
        for seed in range(arms):
            arm = arm_of(seed, scale)
            stop, done, joints, model = recorded(arm, seed, noise, known, limit, step)
            missed.append(not stop or true_worst_mm(arm, model) > limit)
            taken.append(done)
            n.append(len(joints))
            least.append(least_poses(arm, seed, noise, limit))
        oracle = float(np.quantile(least, SHARE, method="inverted_cdf"))
        share = [np.mean(np.array(taken) == k) for k in (1, 2, 3)]
        off = "as expected" if scale == 1 else f"{scale:g} times as far off"
        yield (
            f"| {limit:g} | {noise:g} | {'known' if known else 'estimated'} | {arms}, {off} | "
            f"{np.mean(missed):.1%} | {', '.join(f'{s:.0%}' for s in share)}, "
            f"{1 - sum(share):.0%} | {np.median(n):g} ({max(n)}) | {np.median(least):g} "
            f"(ratio {np.median(np.array(n) / np.array(least)):.2f}) | {oracle:g} | "
            f"{np.median(n) / oracle:.2f} |"
        )


def one_step(noise_mm: float | None, limit: float) -> Callable[[Fitted], tuple[bool, Floats]]:
    """What the rule says of what is known; before the first pose it is the same for all arms."""
    joints = candidates(False)

    def step(known: Fitted) -> tuple[bool, Floats]:
        at = followed(POINTS, known.chain)
        judged = judged_effects(TASK.target, Tolerance(), known, at)
        found = next_round(known, Measured(known.noise_mm).informs(known, joints), judged, limit)
        return found.stop, joints[found.chosen]

    first = step(Fitted.unmeasured(DRAWING, PRIOR, noise_mm))
    return lambda known: step(known) if known.residuals_mm.size else first


def recorded(
    arm: SerialChain,
    seed: int,
    noise_mm: float,
    known: bool,
    limit: float,
    step: Callable[[Fitted], tuple[bool, Floats]],
) -> tuple[bool, int, Floats, SerialChain]:
    """An arm's rounds: whether they end with a stop, how many, the poses and the model."""
    joints = np.empty((0, DRAWING.n_joints))
    found = Fitted.unmeasured(DRAWING, PRIOR, noise_mm if known else None)
    for done in range(MOST_ROUNDS + 1):
        stop, more = step(found)
        if stop or done == MOST_ROUNDS:
            break
        joints = np.concatenate([joints, more])
        found = fitted(arm, joints, noise_mm, seed, known)
    return stop, done, joints, found.chain


def least_poses(arm: SerialChain, seed: int, noise_mm: float, limit: float) -> int:
    """Fewest poses that would have done, each the best for D beside those before it."""
    order = d_optimal(noise_mm)
    for n in range(1, len(order)):
        if true_worst_mm(arm, fitted(arm, order[:n], noise_mm, seed).chain) <= limit:
            return n
    return len(order)


@cache
def d_optimal(noise_mm: float) -> Floats:
    """Postures in the order in which each adds most."""
    before, joints = Fitted.unmeasured(DRAWING, PRIOR, noise_mm), candidates(False)
    return joints[in_order(before, Measured(noise_mm).informs(before, joints), MOST_ALONE)]


def main() -> None:
    """Prints the three tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=200, help="Arms of the ladder.")
    parser.add_argument("--checked", type=int, default=1000, help="Arms of each bound.")
    parser.add_argument("--rounds", type=int, default=1000, help="Arms of each row of rounds.")
    parser.add_argument("--parts", nargs="*", default=["ladder", "bounds", "rounds"])
    asked = parser.parse_args()
    for part, arms in ((ladder, asked.arms), (bounds, asked.checked), (rounds, asked.rounds)):
        if part.__name__ not in asked.parts:
            continue
        began = time.process_time()
        print(f"\n## {(part.__doc__ or '').splitlines()[0]}\n", flush=True)
        for line in part(arms):
            print(line, flush=True)
        print(f"\n({time.process_time() - began:.0f} s of processor time)", flush=True)


if __name__ == "__main__":
    main()
