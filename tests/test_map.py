"""What is proved for the pictures: the boxes, and the training's bound."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.arm.chain import SerialChain
from iksamples.certify import step
from iksamples.certify.step import (
    MAX_BOXES,
    certify_networks,
    map_cell,
    merge_boxes,
    shown_seeds,
)
from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.network import StackedMLP, write_tensors
from iksamples.results import Cell, cells
from iksamples.samples.record import grid_samples
from iksamples.study import Study, parse_study
from iksamples.task import study_task


EPOCHS = np.array([0, 1, 4, 20])
SEEDS = (0, 1, 2)


@pytest.fixture
def small() -> Study:
    return parse_study(
        {
            "name": "small",
            "samples": {"points_per_axis": [4]},
            "training": {"seeds": len(SEEDS)},
            "evaluation": {"cube_points": 256},
            "tolerance": {"error_mm": 6.0},
        }
    )


@pytest.fixture
def cell(small: Study, tmp_path: Path) -> Cell:
    """Random hidden layers with least-squares output layers, approached in four steps."""
    [cell] = cells(small, tmp_path)
    samples = grid_samples(small, study_task(small), 4)
    cell.samples_path.parent.mkdir(parents=True)
    cell.folder.mkdir(parents=True)
    samples.save(cell.samples_path)
    inputs = samples.normalise(samples.x)
    parts: list[list[np.ndarray]] = [[], [], [], []]
    for seed in SEEDS:
        generator = np.random.default_rng(seed)
        kernel, bias = generator.normal(size=(3, 24)), generator.normal(size=24)
        hidden = np.column_stack([np.maximum(inputs @ kernel + bias, 0), np.ones(len(inputs))])
        out = np.linalg.lstsq(hidden, samples.joints, rcond=1e-4)[0]
        for part, value in zip(parts, (kernel, bias, out[:-1], out[-1]), strict=True):
            part.append(value)
    w0, b0, w1, b1 = (np.array(part, np.float32) for part in parts)
    network = StackedMLP((w0, w1), (b0, b1), "relu", samples.offset, samples.scale, SEEDS)
    network.save(cell.folder / "weights.safetensors")
    shares = np.array([0.0, 0.5, 0.9, 1.0])
    tensors: dict[str, Any] = {
        "epochs": EPOCHS,
        "offset": samples.offset,
        "scale": samples.scale,
    }
    for i, (weight, shift) in enumerate(((w0, b0), (w1, b1))):
        share = shares if i else np.ones(4)
        tensors[f"layers.{i}.weight"] = (share[:, None, None, None] * weight).astype("float32")
        tensors[f"layers.{i}.bias"] = (share[:, None, None] * shift).astype("float32")
    header = {"activation": "relu", "seeds": list(SEEDS)}
    write_tensors(cell.folder / "snapshots.safetensors", tensors, header)
    waypoints, cube = (
        track_paths(small.evaluation, study_task(small), network),
        cube_errors(small.evaluation, study_task(small), network),
    )
    waypoints.to_parquet(cell.folder / "waypoints.parquet")
    summarise(waypoints, cube).to_parquet(cell.folder / "errors.parquet")
    members = pd.DataFrame({"seed": SEEDS, "diverged": False})
    members.to_parquet(cell.folder / "members.parquet")
    return cell


def error_mm(network: StackedMLP, chain: SerialChain, points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(chain.forward_mm(network.predict(points)[0]) - points, axis=-1)


def test_boxes_are_bad_throughout_and_the_share_holds(
    small: Study, chain: SerialChain, cell: Cell, rng: np.random.Generator
) -> None:
    unsafe = map_cell(small, study_task(small), cell)["unsafe"]
    lower, upper = np.array(small.workspace.lower_mm), np.array(small.workspace.upper_mm)
    points = rng.uniform(lower, upper, (100_000, 3))
    for seed, rows in unsafe.groupby("seed"):
        network = cell.network.select([SEEDS.index(int(str(seed)))])
        assert 0 < len(rows) <= MAX_BOXES
        low, high = (
            rows[[f"{end}_{axis}_mm" for axis in "xyz"]].to_numpy() for end in ("lower", "upper")
        )
        assert (low >= lower - 1e-9).all()
        assert (high <= upper + 1e-9).all()
        inside = low[:, None] + rng.random((len(rows), 30, 3)) * (high - low)[:, None]
        assert error_mm(network, chain, inside.reshape(-1, 3)).min() > 6.0
        share = (error_mm(network, chain, points) <= 6.0).mean()
        assert 0.05 < share < 0.95
        head = rows.iloc[0]
        assert head["safe_lower"] - 0.005 <= share <= head["safe_upper"] + 0.005
        assert head["safe_upper"] - head["safe_lower"] <= 0.04
        drawn = np.prod((high - low) / (upper - lower), axis=1).sum()
        assert head["drawn"] == pytest.approx(drawn)
        assert drawn <= 1 - head["safe_lower"]


def test_training_is_bounded_at_every_epoch(
    small: Study, chain: SerialChain, cell: Cell, rng: np.random.Generator
) -> None:
    table = map_cell(small, study_task(small), cell)["training_bound"]
    assert list(dict.fromkeys(table["seed"])) == shown_seeds(small, cell)
    points = rng.uniform(small.workspace.lower_mm, small.workspace.upper_mm, (20_000, 3))
    for seed, rows in table.groupby("seed"):
        assert rows["epoch"].tolist() == EPOCHS.tolist()
        final = rows.iloc[-1]
        network = cell.network.select([SEEDS.index(int(str(seed)))])
        assert error_mm(network, chain, points).max() <= final["sup_upper_mm"]
        at_samples = error_mm(network, chain, cell.samples.x)
        assert final["training_max_mm"] == pytest.approx(at_samples.max(), rel=1e-6)
        # Untrained, all joints are zero and the tool is in one place: h is constant.
        home = chain.forward_mm(np.zeros(3))
        corners = np.array(
            list(product(*zip(small.workspace.lower_mm, small.workspace.upper_mm, strict=True)))
        )
        farthest = np.linalg.norm(home - corners, axis=1).max()
        assert rows.iloc[0]["sup_lower_mm"] <= farthest * (1 + 1e-9)
        assert farthest <= rows.iloc[0]["sup_upper_mm"] <= 1.03 * farthest


def test_diverged_seeds_are_not_shown(small: Study, chain: SerialChain, cell: Cell) -> None:
    members = cell.table("members")
    first = shown_seeds(small, cell)[0]
    members["diverged"] = members["seed"] == first
    members.to_parquet(cell.folder / "members.parquet")
    assert first not in shown_seeds(small, cell)
    members.assign(diverged=True).to_parquet(cell.folder / "members.parquet")
    assert all(table.empty for table in map_cell(small, study_task(small), cell).values())


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("Singular"), OverflowError("too large")])
def test_numbers_that_defeat_a_proof_leave_the_others(
    small: Study, cell: Cell, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    task, shown = study_task(small), shown_seeds(small, cell)
    search, cover = step.checked, step.certify_coverage

    def fails_on(prove, seed):
        def proves(network, *rest, **how):
            if seed in network.seeds:
                raise error
            return prove(network, *rest, **how)

        return proves

    whole = certify_networks(small, task, "network", cell.samples, cell.network)
    monkeypatch.setattr(step, "checked", fails_on(search, SEEDS[1]))
    table = certify_networks(small, task, "network", cell.samples, cell.network)
    assert list(table["seed"]) == list(SEEDS)
    assert list(table["verified"]) == [True, False, True]
    assert np.isnan(table.loc[1, "sup_upper_mm"])
    bounds = ["sup_lower_mm", "sup_upper_mm"]  # alone a search may end a little sooner or later
    np.testing.assert_allclose(table.loc[[0, 2], bounds], whole.loc[[0, 2], bounds], rtol=0.02)
    assert list(table["failed"]) == ["", f"the numbers of the proof: {error}.", ""]
    monkeypatch.setattr(step, "certify_coverage", fails_on(cover, shown[0]))
    tables = map_cell(small, task, cell)
    assert tables["unsafe"].empty
    assert set(tables["training_bound"]["seed"]) == set(shown)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_merged_boxes_fill_the_same_space(per_axis: int, pattern: int) -> None:
    chosen = np.random.default_rng(pattern).random((per_axis,) * 3) < 0.6
    low = np.argwhere(chosen) * 0.1 + 20.0
    merged_low, merged_high = merge_boxes(low, low + 0.1)
    assert len(merged_low) <= len(low)
    assert np.prod(merged_high - merged_low, axis=1).sum() == pytest.approx(
        len(low) * 0.1**3, abs=1e-9
    )
    centres = np.argwhere(np.ones_like(chosen)) * 0.1 + 20.05
    inside = (centres[:, None] > merged_low) & (centres[:, None] < merged_high)
    np.testing.assert_array_equal(inside.all(axis=-1).sum(axis=1), chosen.ravel())


def test_a_full_box_merges_into_one() -> None:
    low = np.argwhere(np.ones((4, 4, 4))).astype(float)
    merged_low, merged_high = merge_boxes(low, low + 1)
    np.testing.assert_array_equal(merged_low, [[0, 0, 0]])
    np.testing.assert_array_equal(merged_high, [[4, 4, 4]])
    assert len(merge_boxes(np.empty((0, 3)), np.empty((0, 3)))[0]) == 0
