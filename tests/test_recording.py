"""Recordings, read back from the file."""

import statistics
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from iksamples.arm.chain import SerialChain
from iksamples.certify.step import MAX_BOXES, certify, map_cell
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import median_seed, networks_over_epochs, track_paths
from iksamples.evaluation.paths import waypoints
from iksamples.files import kept_file
from iksamples.network import StackedMLP, write_tensors
from iksamples.recording.record import record_path
from iksamples.recording.shown import blues, proof_text, read_proof
from iksamples.region import Region
from iksamples.results import Cell, cells
from iksamples.samples.record import grid_samples
from iksamples.study import MAX_EPOCHS, Arm, Study, parse_study
from iksamples.task import study_task


pytestmark = pytest.mark.slow


SEEDS = (3, 4, 5, 6)
EPOCHS = np.array([1, 2, 7, 40])


@pytest.fixture
def small() -> Study:
    return parse_study(
        {
            "name": "small",
            "samples": {"points_per_axis": [2, 3]},
            "training": {"seeds": len(SEEDS), "first_seed": SEEDS[0]},
            "evaluation": {
                "paths": {
                    "rectangles": {"shape": "double_rectangle", "waypoints": 40},
                    "heart": {"shape": "heart", "waypoints": 30},
                }
            },
        }
    )


@pytest.fixture
def results(small: Study, rng: np.random.Generator, tmp_path: Path) -> list[Cell]:
    """Results of networks with random weights, which draw no heart but are networks."""
    made = list(cells(small, tmp_path / "results"))
    for cell, m in zip(made, small.samples.points_per_axis, strict=True):
        cell.folder.mkdir(parents=True)
        cell.samples_path.parent.mkdir(exist_ok=True)
        samples = grid_samples(small, study_task(small), m)
        samples.save(cell.samples_path)
        shapes = {"0.weight": (3, 5), "0.bias": (5,), "1.weight": (5, 3), "1.bias": (3,)}
        tensors: dict[str, np.ndarray] = {
            f"layers.{name}": rng.normal(scale=2, size=(len(EPOCHS), len(SEEDS), *shape)).astype(
                "float32"
            )
            for name, shape in shapes.items()
        }
        layers = [
            [tensors[f"layers.{i}.{part}"][-1] for i in (0, 1)] for part in ("weight", "bias")
        ]
        network = StackedMLP(
            tuple(layers[0]),
            tuple(layers[1]),
            "relu",
            samples.offset,
            samples.scale,
            SEEDS,
        )
        network.save(cell.folder / "weights.safetensors")
        write_tensors(
            cell.folder / "snapshots.safetensors",
            {
                **tensors,
                "epochs": EPOCHS,
                "offset": samples.offset,
                "scale": samples.scale,
            },
            {"activation": "relu", "seeds": list(SEEDS)},
        )
        track_paths(small.evaluation, study_task(small), network).to_parquet(
            cell.folder / "waypoints.parquet"
        )
    return made


@pytest.fixture
def heart(small: Study, results: list[Cell], tmp_path: Path) -> Path:
    file = tmp_path / "heart.rrd"
    record_path(small, "heart", results, file)
    return file


def read(file: Path, entity: str, component: str, timeline: str | None) -> dict[int, list]:
    """Values of a component by time (0 where static), as the viewer would find them."""
    found = {}
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        if chunk.entity_path != entity or component not in names:
            continue
        if timeline is None and chunk.is_static:
            found |= dict(enumerate(batch.column(component).to_pylist()))
        elif timeline in names:
            times = batch.column(timeline).to_pylist()
            found |= dict(zip(times, batch.column(component).to_pylist(), strict=True))
    return found


def shown_network(cell: Cell, targets_mm: np.ndarray, chain: SerialChain) -> StackedMLP:
    """The network of the median seed, found without the recording's code."""
    reached = chain.forward_mm(cell.network.predict(targets_mm))
    means = np.linalg.norm(reached - targets_mm, axis=-1).mean(axis=1).tolist()
    return cell.network.select(means.index(statistics.median_low(means)))


def test_tool_goes_where_the_network_sends_it(
    small: Study, results: list[Cell], chain: SerialChain, heart: Path
) -> None:
    targets = waypoints(small.evaluation.paths["heart"], study_task(small)).x
    for cell in results:
        network = shown_network(cell, targets, chain)
        reached = chain.forward_mm(network.predict(targets)[0])
        tool = read(heart, f"/tool/{cell.label}", "Points3D:positions", "waypoint")
        assert list(tool) == list(range(30))
        np.testing.assert_allclose(np.squeeze(list(tool.values())), reached / 1000, atol=1e-6)
        error = read(heart, f"/error/waypoint/{cell.label}", "Scalars:scalars", "waypoint")
        np.testing.assert_allclose(
            np.squeeze(list(error.values())), np.linalg.norm(reached - targets, axis=1)
        )
        [samples] = read(heart, f"/samples/{cell.label}", "Points3D:positions", None).values()
        np.testing.assert_allclose(samples, cell.samples.x / 1000, atol=1e-6)
    [target] = read(heart, "/path/target", "LineStrips3D:strips", None).values()
    np.testing.assert_allclose(target[0], targets / 1000, atol=1e-6)


def test_links_carry_the_tool_to_the_path_of_the_largest_grid(
    small: Study, results: list[Cell], chain: SerialChain, heart: Path
) -> None:
    targets = waypoints(small.evaluation.paths["heart"], study_task(small)).x
    joints = shown_network(results[-1], targets, chain).predict(targets)[0]
    assert not np.all(chain.within_limits(joints))  # which the viewer would clamp by default
    frames = {}
    for name in chain.joint_names:
        entity = f"/robot/joints/{name}"
        moves = read(heart, entity, "Transform3D:translation", "waypoint")
        turns = read(heart, entity, "Transform3D:quaternion", "waypoint")
        frames[name] = [
            (np.squeeze(moves[time]), Rotation.from_quat(np.squeeze(turns[time])))
            for time in range(len(targets))
        ]
    tool = read(heart, f"/tool/{results[-1].label}", "Points3D:positions", "waypoint")
    for time in range(len(targets)):
        point = np.array([0.0, 0.0, 0.07])  # the tool in the forearm's frame, from the URDF
        for name in reversed(chain.joint_names):
            shift, turn = frames[name][time]
            point = shift + turn.apply(point)
        np.testing.assert_allclose(point, tool[time][0], atol=1e-6)


def test_an_arm_that_is_not_its_drawing_is_shown_as_it_is(
    small: Study, results: list[Cell], chain: SerialChain, tmp_path: Path
) -> None:
    """Its file's bodies are the drawing's, and would not carry the tool to where it went."""
    other = small.model_copy(update={"arm": Arm(deviation_mm=5, deviation_rad=0.05)})
    file = tmp_path / "other.rrd"
    record_path(other, "heart", results, file)
    targets = waypoints(small.evaluation.paths["heart"], study_task(small)).x
    table = results[-1].table("waypoints")
    table = table[table["path"] == "heart"]
    seed = median_seed(table)
    own = study_task(other).chain_of(seed)
    rows = table[table["seed"] == seed].sort_values("waypoint")
    joints = rows[[f"q_{name}_rad" for name in chain.joint_names]].to_numpy(float)
    reached = own.forward_mm(joints) / 1000
    assert np.linalg.norm(reached - chain.forward_mm(joints) / 1000, axis=1).min() > 1e-3
    for time in (0, len(targets) - 1):
        point = (own.tip_mm - own.points_mm[-1]) / 1000
        for name in reversed(chain.joint_names):
            entity = f"/robot/joints/{name}"
            shift = np.squeeze(read(file, entity, "Transform3D:translation", "waypoint")[time])
            turn = np.squeeze(read(file, entity, "Transform3D:quaternion", "waypoint")[time])
            point = shift + Rotation.from_quat(turn).apply(point)
        np.testing.assert_allclose(point, reached[time], atol=1e-6)


def test_an_arm_from_a_table_is_drawn_with_simple_bodies(
    small: Study, results: list[Cell], chain: SerialChain, heart: Path, tmp_path: Path
) -> None:
    """The paper's arm by its Denavit-Hartenberg parameters moves as its URDF does."""
    table = tmp_path / "arm.yaml"
    table.write_text(
        "convention: standard\njoints:\n"
        "- {name: yaw, d_mm: 70, alpha_deg: 90, lower_deg: 0, upper_deg: 180}\n"
        "- {name: shoulder, a_mm: 70, theta_deg: 90, lower_deg: -180, upper_deg: 0}\n"
        "- {name: elbow, a_mm: 70, lower_deg: -180, upper_deg: 0}\n"
    )
    other = small.model_copy(update={"robot": small.robot.model_copy(update={"urdf": str(table)})})
    file = tmp_path / "drawn.rrd"
    record_path(other, "heart", results, file)
    for name in chain.joint_names:
        for part in ("translation", "quaternion"):
            ours, urdfs = (
                read(one, f"/robot/joints/{name}", f"Transform3D:{part}", "waypoint")
                for one in (file, heart)
            )
            np.testing.assert_allclose(
                np.squeeze(list(ours.values())), np.squeeze(list(urdfs.values())), atol=1e-6
            )
    drawn = {
        chunk.entity_path
        for chunk in RrdReader(file).stream().to_chunks()
        if any("Mesh3D" in n or "Cylinders3D" in n for n in chunk.to_record_batch().schema.names)
    }
    assert len(drawn) >= 3


def test_training_is_replayed_up_to_the_final_path(
    small: Study, results: list[Cell], heart: Path
) -> None:
    targets = waypoints(small.evaluation.paths["heart"], study_task(small)).x
    for cell in results:
        entity = f"/path/reached/{cell.label}"
        learning = read(heart, entity, "LineStrips3D:strips", "epoch")
        final = read(heart, entity, "LineStrips3D:strips", "waypoint")
        assert list(learning) == EPOCHS.tolist()
        assert list(final) == [0]
        assert learning[40] == final[0]
        assert learning[1] != learning[2]
        errors = read(heart, f"/error/epoch/{cell.label}", "Scalars:scalars", "epoch")
        for epoch, [strip] in learning.items():
            distance_mm = np.linalg.norm(1000 * np.array(strip) - targets, axis=1)
            assert errors[epoch][0] == pytest.approx(distance_mm.mean(), rel=1e-5)


def test_rectangles_are_two_strips(small: Study, results: list[Cell], tmp_path: Path) -> None:
    file = tmp_path / "rectangles.rrd"
    record_path(small, "rectangles", results, file)
    [target] = read(file, "/path/target", "LineStrips3D:strips", None).values()
    assert [len(strip) for strip in target] == [20, 20]
    assert all(len({z for *_, z in strip}) == 1 for strip in target)
    for strips in read(file, "/path/reached/grid3", "LineStrips3D:strips", "epoch").values():
        assert [len(strip) for strip in strips] == [20, 20]


def test_layout_travels_with_the_file(heart: Path) -> None:
    reader = RrdReader(heart)
    assert len(reader.blueprints()) == 1
    [recording] = reader.recordings()
    assert recording.recording_id == "small-heart"
    [[text]] = read(heart, "/about", "TextDocument:text", None).values()
    for said in ("heart", "seed shown", "waypoint", "epoch", "metres", "27 samples"):
        assert said in text
    assert heart.stat().st_size < 1_000_000


def test_two_recordings_of_the_same_results_are_the_same(
    small: Study, results: list[Cell], heart: Path, tmp_path: Path
) -> None:
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_path(small, "heart", results, again)
    record_path(small, "heart", results[1:], other)

    def same(file: Path) -> bool:
        rerun = str(Path(sys.executable).with_name("rerun"))
        call = [rerun, "rrd", "compare", "--unordered", str(heart), str(file)]
        return subprocess.run(call, capture_output=True, check=False).returncode == 0

    assert same(again)
    assert not same(other)


def test_long_paths_and_trainings_are_thinned(
    small: Study, results: list[Cell], tmp_path: Path
) -> None:
    settings = small.model_dump(mode="json")
    settings["evaluation"]["paths"]["heart"]["waypoints"] = 2001
    long = parse_study(settings)
    track_paths(long.evaluation, study_task(long), results[1].network).to_parquet(
        results[1].folder / "waypoints.parquet"
    )
    file = tmp_path / "long.rrd"
    record_path(long, "heart", list(cells(long, results[1].results))[1:], file)
    tool = read(file, "/tool/grid3", "Points3D:positions", "waypoint")
    assert list(tool) == list(range(0, 2001, 4))
    [[strip]] = read(file, "/path/reached/grid3", "LineStrips3D:strips", "waypoint").values()
    np.testing.assert_array_equal(strip, np.squeeze(list(tool.values())))

    snapshots = {
        "layers.0.weight": np.arange(200, dtype="float32").reshape(200, 1, 1, 1),
        "layers.0.bias": np.zeros((200, 1, 1), "float32"),
        "epochs": np.arange(1, 201),
        "offset": np.zeros(1),
        "scale": np.ones(1),
    }
    file = tmp_path / "snapshots.safetensors"
    write_tensors(file, snapshots, {"activation": "relu", "seeds": [9]})
    last: Any = SimpleNamespace(weights=[snapshots["layers.0.weight"][-1]])
    cell: Any = SimpleNamespace(folder=tmp_path, network=last)
    epochs, networks = networks_over_epochs(cell, 9)
    assert len(epochs) == MAX_EPOCHS
    assert (epochs[0], epochs[-1]) == (1, 200)
    np.testing.assert_array_equal(networks.weights[0].ravel(), epochs - 1)


def test_a_diverged_grid_is_left_out_and_named(
    small: Study, results: list[Cell], tmp_path: Path
) -> None:
    table = results[1].table("waypoints")
    table.loc[table["seed"] != 4, ["q_yaw_rad", "reached_x_mm", "error_mm"]] = np.nan
    table.to_parquet(results[1].folder / "waypoints.parquet")
    file = tmp_path / "heart.rrd"
    record_path(small, "heart", results, file)
    assert not read(file, "/tool/grid3", "Points3D:positions", "waypoint")
    [[text]] = read(file, "/about", "TextDocument:text", None).values()
    assert "diverged: 27 samples" in text
    none = tmp_path / "none.rrd"
    record_path(small, "heart", results[1:], none)
    [[text]] = read(none, "/about", "TextDocument:text", None).values()
    assert "diverged: 27 samples" in text
    assert "no network to draw" in text
    assert read(none, "/path/target", "LineStrips3D:strips", None)


def test_a_path_that_was_not_evaluated_leaves_no_file(
    small: Study, results: list[Cell], tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    more = small.model_dump(mode="json")
    more["evaluation"]["paths"]["star"] = {"shape": "heart", "waypoints": 30}
    study = parse_study(more)
    with pytest.raises(IksamplesError, match="the file lacks path star"):
        record_path(study, "star", cells(study, results[0].results), tmp_path / "out" / "star.rrd")
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="a device of Linux")
def test_a_full_disk_is_said_by_the_system(small: Study, results: list[Cell]) -> None:
    with pytest.raises(OSError, match="No space left"):
        record_path(small, "heart", results, "/dev/full")


@given(st.lists(st.floats(0, 100), min_size=1, max_size=9, unique=True), st.randoms())
def test_median_seed(means: list[float], random: object) -> None:
    table = pd.DataFrame(
        [(10 + seed, mean + shift) for seed, mean in enumerate(means) for shift in (-1.0, 1.0)],
        columns=["seed", "error_mm"],
    )
    means = [float(np.mean([mean - 1.0, mean + 1.0])) for mean in means]
    assert means[median_seed(table) - 10] == statistics.median_low(means)


def test_blues_darken() -> None:
    shades = blues(7)
    assert len(set(shades)) == 7
    brightness = [sum(shade) for shade in shades]
    assert brightness == sorted(brightness, reverse=True)
    assert all(blue > max(red, green) for red, green, blue in shades)
    assert len(blues(1)) == 1


@pytest.fixture
def proved(small: Study, results: list[Cell], chain: SerialChain) -> Cell:
    """The largest grid with what is proved of the networks its pictures show."""
    cell = results[-1]
    waypoints = cell.table("waypoints")
    errors = waypoints.groupby(["path", "seed"], as_index=False)["error_mm"].mean()
    errors = errors.rename(columns={"path": "region", "error_mm": "error_mean_mm"})
    everywhere = errors[errors["region"] == "heart"].assign(region="cube")
    pd.concat([errors, everywhere]).to_parquet(cell.folder / "errors.parquet")
    members = pd.DataFrame({"seed": SEEDS, "diverged": False})
    with kept_file(cell.folder / "members.parquet") as file:
        members.to_parquet(file)
    for name, table in map_cell(small, study_task(small), cell).items():
        table.to_parquet(cell.folder / f"{name}.parquet")
    proofs = certify(small, study_task(small), cell.method, cell.samples, cell.folder)
    proofs.to_csv(cell.folder.parent / "certificates.csv", index=False)
    return cell


def test_what_is_proved_of_the_shown_network_is_recorded(
    small: Study, proved: Cell, chain: SerialChain, heart: Path
) -> None:
    network = shown_network(
        proved, waypoints(small.evaluation.paths["heart"], study_task(small)).x, chain
    )

    def error_mm(points: np.ndarray, network: StackedMLP = network) -> np.ndarray:
        return np.linalg.norm(chain.forward_mm(network.predict(points)[0]) - points, axis=-1)

    boxes = "/proof/above_tolerance"
    [middles] = read(heart, boxes, "Boxes3D:centers", None).values()
    [halves] = read(heart, boxes, "Boxes3D:half_sizes", None).values()
    assert 0 < len(middles) <= MAX_BOXES
    signs = np.array(list(product((-1, 0, 1), repeat=3)))
    points = 1000 * (np.array(middles)[:, None] + signs * np.array(halves)[:, None])
    # The file holds single precision in metres.
    assert error_mm(points.reshape(-1, 3)).min() > small.tolerance.error_mm - 1e-3

    [[worst]] = read(heart, "/proof/worst_point", "Points3D:positions", None).values()
    curve = read(heart, "/error/epoch/worst_case", "Scalars:scalars", "epoch")
    assert list(curve) == EPOCHS.tolist()
    bound_mm = curve[EPOCHS[-1]][0]
    spread = np.random.default_rng(0).uniform(
        small.workspace.lower_mm, small.workspace.upper_mm, (20_000, 3)
    )
    assert error_mm(spread).max() <= bound_mm
    assert error_mm(1000 * np.array([worst]))[0] == pytest.approx(bound_mm, rel=0.03)
    [[text]] = read(heart, "/about", "TextDocument:text", None).values()
    for said in ("Proved for", "orange", "worst point"):
        assert said in text
    assert heart.stat().st_size < 5_000_000


def test_a_proof_says_what_it_is_over_and_rounds_outward(small: Study, proved: Cell) -> None:
    task = study_task(small)
    part = Region.box(task.x.lower, (task.x.lower + task.x.upper) / 2)
    seed = proved.table("unsafe")["seed"].iloc[0]
    for region, place in (
        (task.region, "the workspace"),
        (part, "the usable part of the workspace"),
    ):
        proof = read_proof(replace(task, region=region), proved, seed)
        assert proof is not None
        text = proof_text(replace(proof, safe=(0.12399, 0.99991)), 27)
        assert f"every point of {place} and" in text
        assert f"of {place}, smaller ones" in text
        assert "between 12.3 % and 100 % of it" in text


def test_no_proof_is_shown_where_none_is(heart: Path) -> None:
    assert not read(heart, "/error/epoch/worst_case", "Scalars:scalars", "epoch")
    [[text]] = read(heart, "/about", "TextDocument:text", None).values()
    assert "Proved" not in text
