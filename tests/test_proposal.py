"""Where to record next: proposals and the adaptive design."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import pdist

from iksamples.answer.adaptive import adaptive_sets, train_seeds
from iksamples.answer.next_poses import next_poses
from iksamples.answer.proposal import disagreement_mm, propose, spread
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.samples.designs import fill_distance, full_grid
from iksamples.samples.record import grid_samples, record_samples, region_points
from iksamples.study import parse_study, read_study
from iksamples.task import study_chain, study_task


BOX = (20, 20, 0), (80, 80, 60)


def linear(*maps, offset=(0.0, 0.0, 0.0)):
    """Networks without hidden layer: q = x A_i in the unit cube's coordinates, one per matrix."""
    weight = np.array(maps, np.float32)
    bias = np.tile(np.float32(offset), (len(maps), 1))
    seeds = tuple(range(len(maps)))
    return StackedMLP((weight,), (bias,), "tanh", np.array(BOX[0]), np.full(3, 60.0), seeds)


def yaw_apart(*slopes):
    """Seeds whose yaw is slope * x and whose arm stays stretched out level."""
    maps = np.zeros((len(slopes), 3, 3))
    maps[:, 0, 0] = slopes
    return linear(*maps)


def in_box(positions_mm):
    return np.all((positions_mm >= BOX[0]) & (positions_mm <= BOX[1]))


def test_disagreement_is_what_the_seeds_angles_give_on_a_circle(chain, rng):
    """Two seeds that turn a stretched arm by different yaws are a chord of its circle apart."""
    points = BOX[0] + 60 * rng.random((50, 3))
    radius = np.linalg.norm(chain.forward_mm(np.zeros(3))[:2])
    yaw = (points[:, 0] - 20) / 60
    # Two points are each half of their distance from their mean.
    half_chord = radius * np.sin(yaw / 2)
    found = disagreement_mm(yaw_apart(0.0, 1.0), chain, points)
    np.testing.assert_allclose(found, half_chord, atol=1e-4)
    np.testing.assert_allclose(disagreement_mm(yaw_apart(1, 1), chain, points), 0, atol=1e-9)


def test_spread_with_equal_weights_is_the_farthest_point_design(rng):
    points = rng.random((400, 3))
    recorded = points[:1]
    chosen = spread(points, np.ones(400), recorded, 12)
    everything = np.concatenate([recorded, chosen])
    for i in range(1, len(everything)):
        # Gonzalez: each new point is the one that gave the fill distance so far.
        distance = np.linalg.norm(points[:, None] - everything[:i], axis=-1).min(axis=1)
        assert np.linalg.norm(everything[:i] - everything[i], axis=1).min() == distance.max()


def test_proposals_lie_where_the_seeds_disagree_and_do_not_clump(study, task, chain):
    samples = grid_samples(study, task, 2)
    network = yaw_apart(0.0, 1.0)  # disagreement grows with x
    positions = propose(task, samples, network, 100)
    assert in_box(positions)
    assert task.reach(positions).usable.all()
    # Evenly spread points would be as many in either third.
    assert np.sum(positions[:, 0] > 60) > 3 * np.sum(positions[:, 0] < 40)
    best = region_points(task.region, 4096)
    best = best[np.argsort(-disagreement_mm(network, chain, best))[:100]]
    assert pdist(positions).min() > 8 > 3 * pdist(best).min()
    apart = np.linalg.norm(positions[:, None] - samples.x, axis=-1)
    assert apart.min() > 5
    np.testing.assert_array_equal(propose(task, samples, network, 100), positions)
    np.testing.assert_array_equal(propose(task, samples, network, 7), positions[:7])


def test_the_worst_strategy_proposes_the_worst_point_of_each_tile(study, task, rng):
    samples = grid_samples(study, task, 2)
    centre = task.reach([[50.0, 50.0, 30.0]]).joints[0]
    maps = 0.05 * rng.standard_normal((1, 3, 3))
    network = linear(*maps, offset=centre)  # hardly moves off the workspace's centre
    positions = propose(task, samples, network, 5, "worst")
    assert positions.shape == (5, 3)
    assert in_box(positions)
    dense = BOX[0] + 60 * rng.random((30_000, 3))

    def error_mm(points):
        return np.linalg.norm(task.drawing.forward_mm(network.predict(points)[0]) - points, axis=-1)

    # Five positions are taken from 3 x 3 x 3 tiles of 20 mm; a point on a face is in several.
    for position in positions:
        tiles = [
            low
            for low in np.ndindex(3, 3, 3)
            if np.all(np.abs(position - BOX[0] - 20 * (np.array(low) + 0.5)) <= 10 + 1e-9)
        ]
        worst = []
        for low in tiles:
            inside = np.all(np.floor((dense - BOX[0]) / 20) == low, axis=1)
            worst.append(error_mm(dense[inside]).max())
        assert error_mm(position[None])[0] > 0.98 * min(worst)
    np.testing.assert_array_equal(propose(task, samples, network, 5, "worst"), positions)


def test_what_cannot_be_proposed_is_said(study, task):
    samples = grid_samples(study, task, 2)
    with pytest.raises(IksamplesError, match="at least 1"):
        propose(task, samples, yaw_apart(0, 1), 0)
    with pytest.raises(IksamplesError, match="Only one finite network"):
        propose(task, samples, yaw_apart(0, np.nan), 3)
    with pytest.raises(IksamplesError, match="diverged"):
        propose(task, samples, yaw_apart(np.nan, np.inf), 3)
    with pytest.raises(IksamplesError, match="no strategy 'best'"):
        propose(task, samples, yaw_apart(0, 1), 3, "best")
    with pytest.raises(IksamplesError, match="only 1 usable"):
        spread(samples.x, np.ones(8), samples.x[:7], 2)


@pytest.fixture(scope="module")
def quick():
    return {
        "name": "quick",
        "network": {"activation": "tanh"},
        "training": {"epochs": 20, "seeds": 4},
    }


@pytest.mark.slow
def test_adaptive_sets_are_nested_and_do_not_depend_on_each_other(quick):
    study = parse_study(quick)
    chain = study_chain(study)
    sets = adaptive_sets(study, study_task(study), [27, 8])
    assert list(sets) == [8, 27]
    small, large = sets[8], sets[27]
    assert (small.label, large.label) == ("adaptive8", "adaptive27")
    assert (large.design, large.points_per_axis, large.n_samples) == ("adaptive", 3, 27)
    assert np.isnan(large.spacing_mm)
    np.testing.assert_array_equal(large.x[:8], small.x)
    np.testing.assert_array_equal(small.x, grid_samples(study, study_task(study), 2).x)
    np.testing.assert_allclose(chain.forward_mm(large.joints), large.x, atol=1e-9)
    assert len(np.unique(large.x, axis=0)) == 27
    assert in_box(large.x)
    assert pdist(large.x).min() > 8
    region = region_points(study_task(study).region, 2048)
    assert fill_distance(large.x, region) < 35
    # Neither other sizes nor how a study trains for long, nor its seeds, move the points.
    longer = parse_study({**quick, "training": {"epochs": 900, "seeds": 2, "first_seed": 5}})
    assert adaptive_sets(longer, study_task(longer), [27])[27].digest() == large.digest()
    other = parse_study({**quick, "samples": {"seed": 1}})
    moved = adaptive_sets(other, study_task(other), [27])[27].x
    np.testing.assert_array_equal(moved[:8], small.x)
    assert not np.array_equal(moved, large.x)


@pytest.mark.slow
def test_adaptive_samples_keep_off_what_the_arm_cannot_use(quick):
    study = parse_study(
        {**quick, "workspace": {"upper_mm": [120, 120, 90]}, "samples": {"unreachable": "mask"}}
    )
    assert not study_task(study).reach([[120.0, 120.0, 90.0]]).usable[0]
    [samples] = adaptive_sets(study, study_task(study), [27]).values()
    assert samples.n_samples == 27
    assert samples.n_masked == 0
    assert study_task(study).reach(samples.x).usable.all()


def test_adaptive_samples_cannot_be_recorded_in_one_step(study, task):
    with pytest.raises(IksamplesError, match=r"adaptive27.*trained on the way"):
        record_samples(study, task, "adaptive", 27)


def test_next_poses_are_usable_and_the_same_with_the_trained_weights(quick, tmp_path):
    study = parse_study(quick)
    chain = study_chain(study)
    samples = grid_samples(study, study_task(study), 3)
    table = next_poses(study, study_task(study), samples, 6)
    joints = [f"q_{name}_rad" for name in chain.joint_names]
    assert list(table) == ["x_mm", "y_mm", "z_mm", *joints, "disagreement_mm", "error_mm"]
    positions = table[["x_mm", "y_mm", "z_mm"]].to_numpy()
    assert len(table) == 6
    assert in_box(positions)
    assert chain.within_limits(table[joints].to_numpy()).all()
    np.testing.assert_allclose(chain.forward_mm(table[joints].to_numpy()), positions, atol=1e-9)
    assert (table["disagreement_mm"] > 0).all()
    sixteen = parse_study({**quick, "training": {"epochs": 20, "seeds": 16}})
    train_seeds(sixteen, samples).save(tmp_path / "weights.safetensors")
    again = next_poses(
        study, study_task(study), samples, 6, weights=tmp_path / "weights.safetensors"
    )
    pd.testing.assert_frame_equal(again, table)
    (tmp_path / "other.safetensors").write_text("no weights")
    with pytest.raises(IksamplesError, match="not a file of trained networks"):
        next_poses(study, study_task(study), samples, 6, weights=tmp_path / "other.safetensors")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar2r", "scara"])
def test_adaptive_samples_of_any_task(name):
    """They start from the corners and are in the region, whatever the inputs and their units."""
    study = read_study(f"config/studies/{name}.yaml")
    task = study_task(study)
    corners = 2 ** len(task.x)
    first = max(8, corners)
    sets = adaptive_sets(study, task, [first, first + 3])
    small, large = sets[first], sets[first + 3]
    assert {tuple(x) for x in full_grid(task.x.lower, task.x.upper, 2)} <= {
        tuple(x) for x in small.x
    }
    np.testing.assert_array_equal(large.x[:first], small.x)
    assert len(np.unique(large.x, axis=0)) == first + 3
    assert task.region.contains(large.x).all()
    assert task.reach(large.x).usable.all()


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["disagreement", "worst"])
def test_next_poses_of_another_arm_carry_their_units(strategy):
    study = read_study(
        "config/studies/scara.yaml",
        changes={"training": {"optimizer": "adam", "epochs": 60}},
    )
    task = study_task(study)
    samples = record_samples(study, task, "grid", 16)
    table = next_poses(study, task, samples, 5, strategy)
    joints = ["q_joint1_rad", "q_joint2_rad", "q_joint3_mm", "q_joint4_rad"]
    inputs = ["x_mm", "y_mm", "z_mm", "yaw_rad"]
    assert list(table.columns) == [*inputs, *joints, "disagreement_mm", "error_mm"]
    x = table[inputs].to_numpy()
    assert task.region.contains(x).all()
    reached = task.drawing.forward_mm(table[joints].to_numpy())
    np.testing.assert_allclose(reached, x[:, :3], atol=1e-6)
    assert (table["error_mm"] > 0).all()
