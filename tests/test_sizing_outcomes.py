"""Outcomes read from a study's files, certificates, and why a method fails."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from iksamples.answer.assess import answer_study
from iksamples.answer.collect import (
    COLUMNS,
    Variant,
    collect,
    errors_at_samples,
    outcomes,
    read_runs,
    variants,
)
from iksamples.answer.diagnosis import diagnose, loss_fall
from iksamples.answer.extrapolate import errors_matrix
from iksamples.columns import RUNS
from iksamples.errors import IksamplesError
from iksamples.evaluation.paths import count_waypoints
from iksamples.network import StackedMLP
from iksamples.results import Cell
from iksamples.samples.record import record_samples
from iksamples.study import parse_study
from iksamples.task import study_task


SEEDS = 6


def make_study(**settings):
    return parse_study(
        {
            "name": "s",
            "samples": {"points_per_axis": [2, 3]},
            "training": {"seeds": SEEDS},
            "methods": {"cubic": {"kind": "cubic"}},
            **settings,
        }
    )


def write_cell(cell, error, n=SEEDS, diverged=()):
    """The files of a cell: the worst error of seed k over the workspace is ``error + k``."""
    cell.folder.mkdir(parents=True, exist_ok=True)
    seeds = np.arange(n)
    parts = [
        pd.DataFrame(
            {
                "region": region,
                "seed": seeds,
                "error_mean_mm": factor * (error + seeds) / 4,
                "error_p95_mm": factor * (error + seeds) / 2,
                "error_p99_mm": factor * (error + seeds) / 1.5,
                "error_max_mm": factor * (error + seeds),
            }
        )
        for region, factor in (("rectangles", 0.5), ("heart", 0.25), ("cube", 1.0))
    ]
    pd.concat(parts).to_parquet(cell.folder / "errors.parquet")
    if cell.method == "network":
        pd.DataFrame(
            {"seed": seeds, "n_trained": 20, "diverged": np.isin(seeds, diverged)}
        ).to_parquet(cell.folder / "members.parquet")
    epochs = np.arange(1, 101)
    pd.DataFrame(
        {
            "seed": np.repeat(seeds, 100),
            "epoch": np.tile(epochs, n),
            "train_loss": np.tile(np.full(100, 0.1), n),
        }
    ).to_parquet(cell.folder / "history.parquet")


def constant_network(joints, seeds=SEEDS):
    """Networks that answer the same joint values everywhere."""
    return StackedMLP(
        (np.zeros((seeds, 3, 4), np.float32), np.zeros((seeds, 4, 3), np.float32)),
        (
            np.zeros((seeds, 4), np.float32),
            np.broadcast_to(np.float32(joints), (seeds, 3)).copy(),
        ),
        "relu",
        np.zeros(3),
        np.ones(3),
        tuple(range(seeds)),
    )


def write_results(folder):
    """A finished study: the network at 10 and 5 mm and more, cubic at 1 mm on the larger grid."""
    study = make_study()
    (folder / "samples").mkdir()
    for m in (2, 3):
        record_samples(study, study_task(study), "grid", m**3).save(
            folder / "samples" / f"grid{m}.parquet"
        )
    for label, error in (("grid2", 10.0), ("grid3", 5.0)):
        cell = Cell(study, folder, "network", label)
        write_cell(cell, error)
        constant_network([0, 0, 0]).save(cell.folder / "weights.safetensors")
    write_cell(Cell(study, folder, "cubic", "grid3"), 1.0, n=1)
    write_cell(Cell(study, folder, "cubic", "grid2"), 1.0, n=0)  # too few points for the spline
    certify(folder, seeds=[])


@pytest.fixture
def results(tmp_path):
    write_results(tmp_path)
    return tmp_path


def read(results, **settings):
    study = make_study(**settings)
    return outcomes(study, collect(study, results))


def certify(results, seeds=range(SEEDS), factor=1.01, **columns):
    """Certificates of the network on the larger grid."""
    table = pd.DataFrame(
        {
            "method": "network",
            "label": "grid3",
            "n_samples": 27,
            "seed": list(seeds),
            "sup_lower_mm": [5.0 + seed for seed in seeds],
            "sup_upper_mm": [factor * (5.0 + seed) for seed in seeds],
            "mean_lower_mm": [1.2 + seed / 4 for seed in seeds],
            "mean_upper_mm": [1.3 + seed / 4 for seed in seeds],
            "complete": True,
            "verified": True,
            "failed": "",
        }
    ).assign(**columns)
    table.to_csv(results / "network" / "certificates.csv", index=False)


def finished(study, results):
    collect(study, results).to_parquet(results / "runs.parquet")
    return answer_study(study, results)


def on_27(rows):
    return rows.query("method == 'network' and n_samples == 27")


def test_one_row_per_method_samples_seed_and_region(results):
    runs = collect(make_study(), results)
    assert list(runs.columns) == list(RUNS)
    paths = make_study().evaluation.paths
    counts = {"workspace": 8192 + 8} | {name: count_waypoints(path) for name, path in paths.items()}
    assert runs.groupby("region")["n_points"].unique().map(list).to_dict() == {
        name: [n] for name, n in counts.items()
    }
    keys = ["method", "design", "label", "seed", "region"]
    assert not runs.duplicated(keys).any()
    assert len(runs) == 3 * (2 * SEEDS + 1)
    assert set(runs["region"]) == {"workspace", "rectangles", "heart"}
    one = runs.query("method == 'network' and label == 'grid3' and seed == 2").set_index("region")
    assert one.loc["workspace", "error_max_mm"] == 7
    assert one.loc["heart", "error_max_mm"] == 7 / 4
    assert one["n_trained"].eq(20).all()
    assert runs.query("method == 'cubic'")["n_trained"].eq(27).all()
    assert not runs["verified"].any()
    assert runs[["sup_lower_mm", "sup_upper_mm", "mean_upper_mm"]].isna().all(axis=None)


def test_the_table_survives_its_file(results):
    certify(results)
    study = make_study()
    runs = collect(study, results)
    runs.to_parquet(results / "runs.parquet")
    pd.testing.assert_frame_equal(read_runs(study, results), runs)
    (results / "runs.parquet").write_bytes(b"PAR1")
    with pytest.raises(IksamplesError, match=r"runs\.parquet: cannot be read"):
        read_runs(study, results)
    runs.drop(columns="verified").to_parquet(results / "runs.parquet")
    with pytest.raises(IksamplesError, match=r"no column verified; .* Run the study again"):
        read_runs(study, results)


@pytest.mark.parametrize(
    ("column", "value"),
    [("seed", 0.5), ("n_points", np.inf), ("region_share", np.nan), ("region_share", 1.5),
     ("failed", None)],
)  # fmt: skip
def test_rows_that_are_no_runs_are_not_read(results, column, value):
    certify(results)
    collect(make_study(), results).assign(**{column: value}).to_parquet(results / "runs.parquet")
    with pytest.raises(IksamplesError, match="not as it was written"):
        read_runs(make_study(), results)


def test_errors_on_an_unknown_path_are_no_runs(results):
    file = results / "network" / "grid2" / "errors.parquet"
    pd.read_parquet(file).replace({"region": {"heart": "hart"}}).to_parquet(file)
    with pytest.raises(
        IksamplesError, match=r"grid2/errors.parquet .* different runs: the file has region hart"
    ):
        collect(make_study(), results)


def test_bounds_stand_beside_the_workspace_alone(results):
    certify(results)
    bounded = collect(make_study(), results).dropna(subset="sup_upper_mm")
    assert set(bounded["region"]) == {"workspace"}
    assert bounded["label"].tolist() == ["grid3"] * SEEDS
    np.testing.assert_allclose(bounded["mean_upper_mm"], 1.3 + np.arange(SEEDS) / 4)


def test_outcomes_are_in_the_order_of_the_study(results):
    rows = read(results)
    assert tuple(rows.columns) == COLUMNS
    assert rows["n_samples"].tolist() == [8] * SEEDS + [27] * SEEDS + [27]
    assert rows["method"].tolist() == ["network"] * 2 * SEEDS + ["cubic"]
    assert rows["error_mm"].tolist() == [10, 11, 12, 13, 14, 15, 5, 6, 7, 8, 9, 10, 1]
    assert not rows["certified"].any()
    matrix = errors_matrix(rows[rows["method"] == "network"])
    np.testing.assert_array_equal(matrix[27], 5 + np.arange(SEEDS))


@pytest.mark.parametrize(
    ("tolerance", "expected"),
    [
        ({"of": "mean"}, 10 / 4),
        ({"of": "p95"}, 10 / 2),
        ({"of": "p99"}, 10 / 1.5),
        ({"of": "worst", "where": "heart"}, 10 / 4),
        ({"of": "mean", "where": "rectangles"}, 10 / 8),
    ],
)
def test_the_error_is_the_one_the_tolerance_is_about(results, tolerance, expected):
    assert read(results, tolerance=tolerance)["error_mm"].iloc[0] == pytest.approx(expected)


def test_certificates_replace_what_was_measured(results):
    certify(results)
    rows = read(results)
    network = on_27(rows)
    np.testing.assert_allclose(network["error_mm"], 1.01 * (5 + np.arange(SEEDS)))
    np.testing.assert_allclose(network["attained_mm"], 5 + np.arange(SEEDS))
    assert rows["certified"].sum() == SEEDS
    # Only the worst case over the workspace is certified.
    for tolerance in ({"of": "p99"}, {"where": "heart"}):
        assert not read(results, tolerance=tolerance)["certified"].any()


def test_only_a_bound_that_the_checker_proved_counts(results):
    """Seeds without a certificate, and one whose certificate was not verified, are measured."""
    certify(results, seeds=[0, 2], verified=[True, False])
    rows = on_27(read(results))
    assert rows["certified"].tolist() == [True] + [False] * 5
    np.testing.assert_allclose(rows["error_mm"], [5.05, 6, 7, 8, 9, 10])
    runs = collect(make_study(), results)
    assert runs["verified"].sum() == runs["sup_upper_mm"].notna().sum() == 1


def test_an_unfinished_certificate_still_bounds(results):
    certify(results, factor=3.0, complete=False)
    rows = on_27(read(results))
    np.testing.assert_allclose(rows["error_mm"], 3 * (5 + np.arange(SEEDS)))
    assert rows["certified"].all()


def test_certificates_of_other_networks_are_noticed(results):
    certify(results, factor=0.9)
    with pytest.raises(IksamplesError, match="above its certified bound"):
        read(results)
    certify(results, seeds=[1, 1])
    with pytest.raises(IksamplesError, match="two rows of one method, label, seed"):
        read(results)
    (results / "network" / "certificates.csv").unlink()
    with pytest.raises(IksamplesError, match=r"network/certificates\.csv: there is no such file"):
        read(results)


def test_designs_of_one_size_are_kept_apart(results):
    """A certificate is of one set of samples, whatever others have as many."""
    study = make_study(samples={"points_per_axis": [3], "designs": ["grid", "chebyshev"]})
    cells = {name: Cell(make_study(), results, name, "chebyshev3") for name in ("network", "cubic")}
    record_samples(study, study_task(study), "chebyshev", 27).save(cells["network"].samples_path)
    write_cell(cells["network"], 5.0)
    write_cell(cells["cubic"], 1.0, n=1)
    certify(results)
    found = variants(outcomes(study, collect(study, results)))
    assert list(found) == [
        ("network", "grid"), ("network", "chebyshev"), ("cubic", "grid"), ("cubic", "chebyshev")
    ]  # fmt: skip
    proved = {variant: rows["certified"].all() for variant, rows in found.items()}
    assert [variant for variant, all_proved in proved.items() if all_proved] == [
        ("network", "grid")
    ]


@pytest.mark.parametrize("weights", ["diverged", "not finite"])
def test_a_diverged_seed_has_an_infinite_error(results, weights):
    cell = Cell(make_study(), results, "network", "grid3")
    if weights == "diverged":
        write_cell(cell, 5.0, diverged=[4])
    else:
        errors = cell.table("errors")
        errors.loc[errors["seed"] == 4, "error_max_mm"] = np.nan
        errors.to_parquet(cell.folder / "errors.parquet")
    certify(results)
    rows = on_27(read(results))
    assert np.isinf(rows["error_mm"]).tolist() == [False] * 4 + [True, False]
    assert not rows["certified"].iloc[4]


def test_an_unfinished_study_is_named(results):
    (results / "network" / "grid2" / "errors.parquet").unlink()
    with pytest.raises(IksamplesError, match=r"grid2/errors\.parquet: there is no such file"):
        read(results)


def test_the_whole_way_from_files_to_the_answer(results):
    certify(results)
    study = make_study(tolerance={"error_mm": 4.0})
    one = finished(study, results)
    assert "27 samples and a cubic spline" in one.headline
    assert "the paper's training needs more than 27" in one.headline
    assert one.digest == study.digest()
    kinds = [cause.kind for cause in one.variant("network").diagnosis]
    assert kinds == ["fit", "samples-suffice"]
    assert one.comparisons[0].ratio.value == pytest.approx(
        np.median(1 / (1.01 * (5 + np.arange(SEEDS))))
    )


class TestDiagnosis:
    def test_errors_at_the_samples_are_those_of_the_forward_kinematics(self, results, chain):
        cell = Cell(make_study(), results, "network", "grid3")
        expected = np.linalg.norm(chain.forward_mm(np.zeros(3)) - cell.samples.x, axis=1)
        at = errors_at_samples(make_study(), cell)
        np.testing.assert_allclose(at, [expected.max()] * SEEDS)
        mean = errors_at_samples(make_study(tolerance={"of": "mean"}), cell)
        np.testing.assert_allclose(mean, [expected.mean()] * SEEDS)

    def test_an_angle_at_the_samples_counts_too(self, results, chain):
        cell = Cell(make_study(), results, "network", "grid3")
        study = make_study(
            task={"orientation": "fixed", "reference_rpy_rad": [0.3, 0.2, 0.1]},
            tolerance={"error_mm": 4, "angle_deg": 0.01},
        )
        asked = Rotation.from_euler("xyz", [0.3, 0.2, 0.1])
        reached = Rotation.from_matrix(chain.rotation(np.zeros(3)))
        expected = 400 * np.degrees((asked.inv() * reached).magnitude())
        assert expected > errors_at_samples(make_study(), cell).max()
        np.testing.assert_allclose(errors_at_samples(study, cell), [expected] * SEEDS)

    def test_they_are_not_compared_with_a_path_or_where_samples_were_held_out(self, results):
        cell = Cell(make_study(), results, "network", "grid3")
        assert errors_at_samples(make_study(tolerance={"where": "heart"}), cell) is None
        held_out = make_study(training={"seeds": SEEDS, "held_out": {"source": "grid"}})
        assert errors_at_samples(held_out, cell) is None

    def test_a_falling_loss_is_measured(self, rng):
        def history(fall_per_epoch):
            seeds, epochs = np.meshgrid(np.arange(8), np.arange(1, 101), indexing="ij")
            loss = np.exp(-fall_per_epoch * epochs) * (1 + 0.01 * rng.normal(size=seeds.shape))
            return pd.DataFrame(
                {
                    "seed": seeds.ravel(),
                    "epoch": epochs.ravel(),
                    "train_loss": loss.ravel(),
                }
            ).sample(frac=1, random_state=0)

        fall = loss_fall(history(0.01), rng)
        assert fall.value == pytest.approx(1 - np.exp(-0.1), abs=0.01)
        assert fall.low < 1 - np.exp(-0.1) < fall.high
        flat = loss_fall(history(0.0), rng)
        assert flat.low < 0.01
        assert flat.high > -0.01
        assert not loss_fall(history(0.01).query("seed < 3"), rng).known

    def test_training_and_capacity_are_told_apart_by_other_networks(self, results, rng):
        study = make_study(
            methods={
                "longer": {"training": {"epochs": 5000}},
                "wider": {"network": {"hidden": [64]}},
                "both": {"network": {"hidden": [64]}, "training": {"epochs": 5000}},
                "worse": {"network": {"hidden": [2]}},
            }
        )
        luck = np.exp(rng.normal(size=12))
        of_variants = {
            Variant(name, "grid"): pd.DataFrame(
                {"n_samples": 27, "seed": np.arange(12), "error_mm": factor * luck}
            )
            for name, factor in {
                "network": 5.0, "longer": 3.0, "wider": 2.0, "both": 1.0, "worse": 9.0
            }.items()
        }  # fmt: skip
        cell = Cell(make_study(), results, "network", "grid3")
        found = diagnose(study, Variant("network", "grid"), of_variants, cell, {}, rng)
        assert [(cause.kind, cause.text.split(", ")[0][:36]) for cause in found] == [
            ("fit", "At its own 27 samples 6 of 6 trainin"),
            ("training", "The same network trained otherwise"),
            ("capacity", "Another network"),
        ]
        assert "60 % of its error" in found[1].text
        assert "40 % of its error" in found[2].text


def test_an_angle_counts_as_many_millimetres_as_are_allowed_of_it(results):
    """Both components are met where the larger share of what is allowed is at most one."""
    certify(results)
    study = make_study(
        task={"orientation": "fixed", "reference_rpy_rad": [0, 0, 0]},
        tolerance={"error_mm": 4, "angle_deg": 0.5},
    )
    runs = collect(study, results)
    runs["angle_max_deg"] = np.where(runs["seed"] == 0, 0.7, 0.1)
    plain = outcomes(make_study(tolerance={"error_mm": 4}), runs)
    rows = outcomes(study, runs)
    angle = runs.loc[runs["region"] == "workspace", "angle_max_deg"].to_numpy()
    np.testing.assert_allclose(rows["error_mm"], np.fmax(plain["error_mm"], 8 * angle))
    assert not rows["certified"].any()
    # Where both are proved, the bounds count.
    certify(results, angle_lower_deg=0.6, angle_upper_deg=0.75)
    runs = collect(study, results)
    unknown = outcomes(study, runs.assign(angle_upper_deg=np.nan))
    assert np.isinf(unknown["error_mm"]).all()  # an angle that nobody measured is no small one
    proved = on_27(outcomes(study, runs.assign(angle_max_deg=0.5)))
    np.testing.assert_allclose(
        proved["error_mm"], np.fmax(1.01 * (5 + np.arange(SEEDS)), 0.75 * 4 / 0.5)
    )
    np.testing.assert_allclose(proved["attained_mm"], np.fmax(5 + np.arange(SEEDS), 0.6 * 4 / 0.5))
    assert proved["certified"].all()
    with pytest.raises(
        IksamplesError, match=r"angle_deg' is of no use with 'task.orientation: free"
    ):
        make_study(tolerance={"angle_deg": 1})
