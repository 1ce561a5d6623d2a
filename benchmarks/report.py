"""Writes docs/benchmarks.md and its pictures from the measurements."""

from pathlib import Path
from typing import Any

import matplotlib


matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np


Costs = dict[tuple, list[float]]

PER_SEED = ("sklearn", "torch", "lightning", "keras")
COLOURS = {
    **{
        "fused": "#d1495b",
        "kernel": "#f4a6b0",
        "reference": "#edae49",
        "floor": "#444444",
        "jax": "#00798c",
    },
    **{"sklearn": "#8d96a3", "torch": "#c38d9e", "lightning": "#9b6dff", "keras": "#66a182"},
}


def write_report(
    folder: Path, titles: dict[str, str], results: dict[str, Any], facts: dict[str, Any]
) -> Path:
    """Writes the page and its pictures, and returns the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    _draw(folder, titles, results, facts)
    floor = facts["flops"] / facts["peak"] * 1e6
    lines = [
        "# Training benchmarks",
        "",
        "Written by `python benchmarks/training.py`; do not edit.",
        "",
        f"{facts['cpu']}, one of {facts['cores']} cores, load {facts['load']:.1f} at the end; "
        f"{facts['system']}; "
        + ", ".join(f"{name} {number}" for name, number in facts["versions"].items())
        + f". {facts['rounds']} interleaved rounds, medians; {facts['minutes']:.0f} minutes.",
        "",
        "The work is the paper's: its arm and cube, a 3-16-3 ReLU network, mean squared error, "
        "Adam at 1e-3, mini-batches of 8 reshuffled every epoch, float32. Costs are µs per seed "
        "and optimiser step; shuffles are timed everywhere, compilation and imports nowhere. Slow "
        "ways run fewer than 500 epochs: their cost per step is measured, totals would be "
        "extrapolated. Ours keep the validation loss and the weights' statistics of every epoch "
        "and, but for one row, run under Lightning; the others only train.",
        "",
        f"The floor by arithmetic: {facts['flops']} FLOP per seed and step at the "
        f"{facts['peak'] / 1e9:.0f} GFLOP/s that a matrix product reaches on this core are "
        f"{floor:.3f} µs.",
        "",
    ]
    if facts["quick"]:
        lines[4:4] = ["**A quick run: too few rounds to quote.**", ""]
    if facts["missing"]:
        lines += [f"Not installed, left out: {', '.join(facts['missing'])}.", ""]
    lines += _study(titles, results["study"])
    lines += _seeds(titles, results["seeds"], floor)
    lines += _grids(titles, results["grids"])
    lines += _shapes(titles, results["shapes"])
    lines += _errors(titles, results["errors"])
    path = folder / "benchmarks.md"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def ratio(costs: Costs, over: tuple, under: tuple) -> float:
    """Median of the rounds' ratios."""
    return float(np.median(np.divide(costs[over], costs[under])))


def _cost(value: float) -> str:
    return f"{value:.3f}" if value < 1 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _study(titles: dict[str, str], seconds: dict[str, list[float]]) -> list[str]:
    lines = [
        "## The paper's study",
        "",
        "Seven grids, 20 seeds, 500 epochs, on one core.",
        "",
        "| | seconds | times the fused engine |",
        "|---|---:|---:|",
    ]
    for name, values in seconds.items():
        times = np.median(np.divide(values, seconds["fused"]))
        lines.append(f"| {titles[name]} | {np.median(values):.2f} | {times:.3g}× |")
    return [*lines, ""]


def _seeds(titles: dict[str, str], costs: Costs, floor: float) -> list[str]:
    counts = sorted({key[1] for key in costs if key[0] == "fused"})
    lines = [
        "## Against the number of seeds",
        "",
        "125 samples. In brackets: times the fused engine's cost in the same rounds. Ways that "
        "train one seed after another cost the same per seed whatever their number.",
        "",
        "| | " + " | ".join(f"{count} seeds" if count > 1 else "1 seed" for count in counts) + " |",
        "|---|" + "---:|" * len(counts),
    ]
    for name, title in titles.items():
        cells = []
        for count in counts:
            key = (name, 1 if name in PER_SEED else count)
            times = ratio(costs, key, ("fused", count))
            cells.append(f"{_cost(np.median(costs[key]))} ({times:.3g}×)")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    cells = [f"{floor:.3f} ({floor / np.median(costs['fused', count]):.2f}×)" for count in counts]
    lines.append("| arithmetic at peak | " + " | ".join(cells) + " |")
    return [*lines, "", "![Cost against the number of seeds](benchmarks-seeds.svg)", ""]


def _grids(titles: dict[str, str], costs: Costs) -> list[str]:
    grids = sorted({key[1] for key in costs})
    lines = [
        "## Against the number of samples",
        "",
        "20 seeds (one for the ways that train one at a time). µs per seed and step, and times the "
        "fused engine's.",
        "",
        "| | " + " | ".join(f"n = {m**3}" for m in grids) + " |",
        "|---|" + "---:|" * len(grids),
    ]
    for name, title in titles.items():
        cells = [
            f"{_cost(np.median(costs[name, m]))} ({ratio(costs, (name, m), ('fused', m)):.3g}×)"
            if (name, m) in costs
            else ""
            for m in grids
        ]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return [*lines, "", "![Cost against the number of samples](benchmarks-samples.svg)", ""]


def _shapes(titles: dict[str, str], costs: Costs) -> list[str]:
    shapes = list(dict.fromkeys(key[1] for key in costs))
    names = list(dict.fromkeys(key[0] for key in costs))
    lines = [
        "## Against width and depth",
        "",
        "125 samples, 32 seeds. µs per seed and step, and times the fused engine's.",
        "",
        "| hidden layers | " + " | ".join(titles[name] for name in names) + " |",
        "|---|" + "---:|" * len(names),
    ]
    for shape in shapes:
        cells = [
            f"{_cost(np.median(costs[name, shape]))} "
            f"({ratio(costs, (name, shape), ('fused', shape)):.3g}×)"
            for name in names
        ]
        lines.append(f"| {'-'.join(map(str, shape))} | " + " | ".join(cells) + " |")
    return [*lines, "", "![Cost against width and depth](benchmarks-shapes.svg)", ""]


def _errors(titles: dict[str, str], errors: dict[str, tuple[int, float, float]]) -> list[str]:
    _, mean, own = errors["fused"]
    lines = [
        "## The same error",
        "",
        "Mean position error over the workspace after 500 epochs on 27 samples. Last column: "
        "distance from the fused engine in standard errors of the difference. (The C kernel shares "
        "initial weights and shuffles with the fused engine; scikit-learn starts its biases at "
        "random.)",
        "",
        "| | seeds | error [mm] | ± | distance |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, (count, value, error) in errors.items():
        distance = abs(value - mean) / np.hypot(error, own)
        lines.append(f"| {titles[name]} | {count} | {value:.3f} | {error:.3f} | {distance:.1f} |")
    return [*lines, ""]


def _draw(
    folder: Path, titles: dict[str, str], results: dict[str, Any], facts: dict[str, Any]
) -> None:
    plt.rcParams.update({"svg.hashsalt": "benchmarks", "svg.fonttype": "none", "font.size": 9})

    def save(figure: Any, name: str) -> None:
        figure.tight_layout()
        figure.savefig(folder / f"benchmarks-{name}.svg", metadata={"Date": None})
        plt.close(figure)

    costs = results["seeds"]
    figure, axes = plt.subplots(figsize=(7, 4.2))
    counts = sorted({key[1] for key in costs if key[0] == "fused"})
    for name, title in titles.items():
        if name in PER_SEED:
            axes.axhline(np.median(costs[name, 1]), color=COLOURS[name], label=title, ls=":")
        else:
            y = [np.median(costs[name, count]) for count in counts]
            axes.loglog(counts, y, "o-", color=COLOURS[name], label=title)
    axes.axhline(facts["flops"] / facts["peak"] * 1e6, color="k", ls="--", lw=0.8, label="peak")
    axes.set(xscale="log", yscale="log", xlabel="seeds", ylabel="µs per seed and step")
    axes.legend(fontsize=7, bbox_to_anchor=(1.01, 1), loc="upper left")
    save(figure, "seeds")

    costs = results["grids"]
    figure, axes = plt.subplots(figsize=(7, 4.2))
    for name, title in titles.items():
        grids = sorted(key[1] for key in costs if key[0] == name)
        y = [np.median(costs[name, m]) for m in grids]
        style = ":" if name in PER_SEED else "-"
        axes.loglog([m**3 for m in grids], y, f"o{style}", color=COLOURS[name], label=title)
    axes.set(xlabel="samples n", ylabel="µs per seed and step")
    axes.legend(fontsize=7, bbox_to_anchor=(1.01, 1), loc="upper left")
    save(figure, "samples")

    costs = results["shapes"]
    figure, axes = plt.subplots(figsize=(7, 4.2))
    for name in dict.fromkeys(key[0] for key in costs):
        for depth, marker in ((1, "o-"), (2, "s--"), (3, "^:")):
            shapes = sorted(key[1] for key in costs if key[0] == name and len(key[1]) == depth)
            if shapes:
                y = [np.median(costs[name, shape]) for shape in shapes]
                label = f"{titles[name]}, {depth} hidden"
                axes.loglog([s[0] for s in shapes], y, marker, color=COLOURS[name], label=label)
    axes.set(xlabel="neurons per hidden layer", ylabel="µs per seed and step")
    axes.legend(fontsize=7, bbox_to_anchor=(1.01, 1), loc="upper left")
    save(figure, "shapes")
