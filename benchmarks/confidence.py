"""Whether the answers' confidence is what it says: docs/confidence.md.

    python benchmarks/confidence.py
    python benchmarks/confidence.py --backtest results/ladder results/paper

Three parts: how often a study says of some variant that a size is enough which is not, what that
confidence costs in seeds, and how often an extrapolated answer holds. The last one is tried on
made-up curves, and on finished studies, whose larger sizes are foretold from their smaller ones.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binom, norm

from iksamples.answer.collect import Variant, outcomes, read_runs, variants
from iksamples.answer.extrapolate import Forecast, extrapolate, forecast, seen, shape
from iksamples.answer.sizes import Trials, confidence_of_each, smallest_met
from iksamples.stats import Floats, met_needed, seeds_needed
from iksamples.study import Study, parse_study, read_study


SHARE, TOGETHER = 0.8, 0.95
VARIANTS = (1, 2, 4, 7, 14, 49, 50)
SEEDS = (14, 20, 30, 40, 100, 200)
SIZES = 7
STATISTICS = ("worst", "p95", "mean")
TOLERANCES = 8


def false_answers(n_variants: int, n_seeds: int, together: float, shared: bool) -> float:
    """Chance of a false answer where the true share is just below the required one everywhere.

    Args:
        n_variants: Variants.
        n_seeds: Trainings of each.
        together: The confidence.
        shared: Whether it is shared by the variants, or spent on each of them alone.

    Returns:
        The chance for variants that have nothing in common. The first size that is tested is the
        largest, so no other counts.
    """
    confidence = 1 - (1 - together) / n_variants if shared else together
    fewest = met_needed(n_seeds, SHARE, confidence)
    one = binom.sf(fewest - 1, n_seeds, SHARE) if fewest else 0.0
    return float(-np.expm1(n_variants * np.log1p(-one)))


def simulated(
    n_variants: int, n_seeds: int, truth: Floats, rng: np.random.Generator, common: float = 0.0
) -> tuple[float, int]:
    """The same by the product's own procedure, for any truth and with luck in common.

    Args:
        n_variants: Variants.
        n_seeds: Trainings of each.
        truth: True share at each size, shape (sizes,).
        rng: Draws the trainings.
        common: Correlation of the luck of one seed in any two variants and sizes.

    Returns:
        Share of the studies with a false answer, and how many studies that is of.
    """
    repeats = 4000 if n_variants * n_seeds <= 400 else 1000
    limit, false = norm.ppf(truth), 0
    for _ in range(repeats):
        own = rng.normal(size=(n_variants, len(truth), n_seeds))
        luck = np.sqrt(common) * rng.normal(size=n_seeds) + np.sqrt(1 - common) * own
        met = (luck <= limit[:, None]).sum(axis=2)
        trials = [Trials([n_seeds] * len(truth), row.tolist()) for row in met]
        each = confidence_of_each(trials, SHARE, TOGETHER)
        found = [smallest_met(one, SHARE, each) for one in trials]
        false += any(size is not None and (truth[size:] < SHARE).any() for size in found)
    return false / repeats, repeats


def print_false_answers(rng: np.random.Generator) -> None:
    """How often some variant is said to be enough that is not."""
    print(f"\nFalse answers [%], true share just below {SHARE:g} at every size; alone | together\n")
    print("| variants | " + " | ".join(f"{n} seeds" for n in SEEDS) + " |")
    print("|---" * (1 + len(SEEDS)) + "|")
    for v in VARIANTS:
        cells = [
            f"{100 * false_answers(v, n, TOGETHER, False):.1f} \\| "
            f"{100 * false_answers(v, n, TOGETHER, True):.1f}"
            for n in SEEDS
        ]
        print(f"| {v} | " + " | ".join(cells) + " |")
    just_below = np.full(SIZES, SHARE - 1e-9)
    enough_at_the_largest = np.append(just_below[1:], 1.0)
    half = np.array([1 - 1e-9 if i % 2 else SHARE - 1e-9 for i in range(SIZES)])
    truths = [(just_below, 0.0), (just_below, 0.5), (enough_at_the_largest, 0.0), (half, 0.0)]
    print("\nThe same by simulation of the procedure [% ± one standard error]\n")
    print(
        "| variants | seeds | below everywhere | the same, luck in common | but at the largest "
        "| in turns |"
    )
    print("|---|---|---|---|---|---|")
    for v, n in ((1, 14), (1, 40), (4, 20), (7, 40), (14, 40), (50, 40), (7, 200), (50, 200)):
        cells = []
        for truth, common in truths:
            rate, repeats = simulated(v, n, truth, rng, common)
            cells.append(f"{100 * rate:.1f} ± {100 * np.sqrt(rate * (1 - rate) / repeats):.1f}")
        print(f"| {v} | {n} | " + " | ".join(cells) + " |")


def print_cost() -> None:
    """What the confidence costs in seeds."""
    print("\nFewest seeds that can answer, and the chance of an answer at one size\n")
    shares, seeds = (0.9, 0.95), (20, 40, 100, 200)
    heads = ["variants", "all succeed", "one fails", "two fail"]
    heads += [f"{n} seeds, true share {share:g}" for n in seeds for share in shares]
    print("| " + " | ".join(heads) + " |")
    print("|---" * len(heads) + "|")
    for v in VARIANTS:
        each = 1 - (1 - TOGETHER) / v
        cells = [str(seeds_needed(SHARE, each, failures)) for failures in (0, 1, 2)]
        for n in seeds:
            fewest = met_needed(n, SHARE, each)
            for share in shares:
                cells.append(f"{100 * binom.sf(fewest - 1, n, share):.0f} %" if fewest else "0")
        print(f"| {v} | " + " | ".join(cells) + " |")


def tried(
    study: Study,
    variant: Variant,
    known: Forecast,
    limits_mm: Floats,
    needs: Callable[[float], float],
) -> Iterator[tuple[str, bool]]:
    """What is said of some tolerances, and whether it holds.

    Args:
        study: The study.
        variant: The variant.
        known: What is said of its curve.
        limits_mm: The tolerances [mm].
        needs: Samples that a tolerance truly takes; infinite: no number; NaN: not known.
    """
    for limit_mm in limits_mm:
        said = extrapolate(study, variant, known, float(limit_mm))
        if said.needed is None:
            yield said.reason.split(" samples (")[0].rstrip(" 0123456789"), False
            continue
        true = needs(float(limit_mm))
        if not np.isnan(true):
            yield "", bool(said.needed.low <= true <= said.needed.high)


def backtest(results: Path) -> pd.DataFrame:
    """Foretells the larger sizes of a study from its smaller ones.

    Returns:
        A row per variant, statistic, beginning of the sizes and tolerance: study, variant, kind,
        reason (empty: a number is printed), holds.
    """
    study = read_study(results / "study.json")
    runs = read_runs(study, results)
    measured = runs.assign(verified=False, sup_upper_mm=np.nan, sup_lower_mm=np.nan)
    rows = []
    for of in STATISTICS:
        asked = study.model_copy(
            update={"tolerance": study.tolerance.model_copy(update={"of": of})}
        )
        for variant, own in variants(outcomes(asked, measured)).items():
            n, curves = seen(asked, variant, own)
            if study.all_methods[variant.method].kind == "nominal" or len(n) < 6:
                continue
            behaved, curve = shape(n, curves[0]), curves[0]
            for fewer in range(5, len(n)):
                known = forecast(asked, variant, n[:fewer], curves[:, :fewer])
                low, high = curve[fewer:].min(), curve[fewer - 1]
                limits = np.geomspace(min(low, high / 2) * 1.001, high * 0.995, TOLERANCES)
                for reason, holds in tried(asked, variant, known, limits, crossing(n, curve)):
                    known_shape = behaved.monotone, behaved.convex
                    rows.append((study.name, *variant, of, fewer, reason, holds, *known_shape))
    names = ["study", "method", "design", "of", "fewer", "reason", "holds", "monotone", "convex"]
    return pd.DataFrame(rows, columns=names)


def crossing(n: Floats, curve: Floats) -> Callable[[float], float]:
    """Samples from which on a curve stays within a limit, interpolated in logarithms."""

    def needs(limit_mm: float) -> float:
        above = np.flatnonzero(curve > limit_mm)
        if not len(above):
            return float(n[0])
        i = above[-1]
        if i == len(n) - 1:
            return np.nan if (np.diff(curve) < 0).all() else np.inf
        x, y = np.log(n[i : i + 2]), np.log(curve[i : i + 2])
        return float(np.exp(x[0] + (x[1] - x[0]) * (np.log(limit_mm) - y[0]) / (y[1] - y[0])))

    return needs


def made_up(kind: str, rng: np.random.Generator) -> Callable[[Floats], Floats]:
    """A learning curve: error [mm] of n samples, about 1 mm at the largest of the sizes tried."""
    c, last = rng.uniform(0.3, 1.2), 512.0
    floor = rng.uniform(0.05, 0.9)
    at, steep = last * rng.uniform(1.05, 3), rng.uniform(0.2, 0.8)
    curves: dict[str, Callable[[Floats], Floats]] = {
        "power law": lambda n: (n / last) ** -c,
        "power law with a floor": lambda n: floor + (1 - floor) * (n / last) ** -c,
        "levels off abruptly, beyond": lambda n: np.maximum((n / last) ** -c, (at / last) ** -c),
        "turns up, beyond": lambda n: (n / last) ** -c * (1 + (n / at) ** (c + steep)),
        "flat, then falls": lambda n: 1 + 3 / (1 + (n / (last * 0.2)) ** 2) - 0.5 * (n > at),
        "in steps": lambda n: (np.exp2(np.floor(np.log2(n / last) / steep) * steep)) ** -c,
        "waves": lambda n: (n / last) ** -c * (1 + 0.2 * np.sin(3 * np.log(n))),
        "falls ever faster": lambda n: 4 - 3 * (n / last) ** steep + 0 * n,
    }
    return curves[kind]


KINDS = (
    "power law", "power law with a floor", "levels off abruptly, beyond", "turns up, beyond",
    "flat, then falls", "in steps", "waves", "falls ever faster",
)  # fmt: skip


def print_made_up(rng: np.random.Generator, repeats: int = 40) -> None:
    """How often what is printed of made-up curves holds."""
    study = parse_study({"name": "s", "methods": {"table": {"kind": "multilinear"}}})
    n = np.arange(2, 9) ** 3.0
    far = np.geomspace(8, 512 * 64, 4000)
    print("\nMade-up curves: tolerances with a number | of those, it holds\n")
    print("| curve | 20 seeds | without chance |\n|---|---|---|")
    totals = {name: np.zeros(3, int) for name in ("network", "table")}
    for kind in KINDS:
        cells = []
        for name in totals:
            printed = holds = asked = 0
            for _ in range(repeats):
                curve = made_up(kind, rng)
                errors = curve(n)[None]
                if name == "network":  # the scatter of trainings that four in five keep to
                    errors = errors * np.exp(0.1 * (rng.normal(size=(20, len(n))) - norm.ppf(0.8)))
                own = pd.DataFrame(errors, columns=n.astype(int)).melt(
                    var_name="n_samples", value_name="error_mm", ignore_index=False
                )
                own = own.rename_axis("seed").reset_index()
                variant = Variant(name, "grid")
                known = forecast(study, variant, *seen(study, variant, own))
                limits = np.geomspace(0.5, 0.95, 5) * curve(n)[-1]
                said = list(tried(study, variant, known, limits, crossing_of(curve, far)))
                asked += len(said)
                printed += sum(not reason for reason, _ in said)
                holds += sum(held for _, held in said)
            cells.append(_rate(printed, asked, holds))
            totals[name] += np.array([printed, asked, holds])
        print(f"| {kind} | " + " | ".join(cells) + " |")
    print("| **all** | " + " | ".join(_rate(*total) for total in totals.values()) + " |")


def crossing_of(curve: Callable[[Floats], Floats], far: Floats) -> Callable[[float], float]:
    """Samples from which on a made-up curve stays within a limit; infinite beyond the farthest."""

    def needs(limit_mm: float) -> float:
        above = np.flatnonzero(curve(far) > limit_mm)
        return np.inf if above[-1] == len(far) - 1 else float(far[above[-1] + 1])

    return needs


def print_backtest(folders: list[Path]) -> None:
    """How often what is printed of studies holds."""
    table = pd.concat([backtest(folder) for folder in folders], ignore_index=True)
    table["printed"] = table["reason"] == ""
    curves = table.drop_duplicates(["study", "method", "design", "of"])
    either = ~curves["monotone"] | ~curves["convex"]
    print(
        f"\n{len(curves)} learning curves: {(~curves['monotone']).sum()} not monotone, "
        f"{(~curves['convex']).sum()} not convex, {either.sum()} either\n"
    )
    print("| study | method | samples placed | not monotone | not convex | with a number, holds |")
    print("|---|---|---|---|---|---|")
    for (study, method, design), own in table.groupby(["study", "method", "design"], sort=False):
        of = own.drop_duplicates("of")
        rising, bent = (~of["monotone"]).sum(), (~of["convex"]).sum()
        rate = _rate(own["printed"].sum(), len(own), own["holds"].sum())
        shapes = f"{rising} of {len(of)} | {bent} of {len(of)}"
        print(f"| {study} | {method} | {design} | {shapes} | {rate} |")
    rate = _rate(table["printed"].sum(), len(table), table["holds"].sum())
    print(f"| **all** |  |  |  |  | {rate} |")


def _rate(printed: int, asked: int, holds: int) -> str:
    held = f", {100 * holds / printed:.0f} %" if printed else ""
    return f"{printed} of {asked}{held}"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backtest", nargs="*", type=Path, default=[], help="results folders")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    if arguments.backtest:
        print_backtest(arguments.backtest)
        return
    print_false_answers(rng)
    print_cost()
    print_made_up(rng)


if __name__ == "__main__":
    main()
