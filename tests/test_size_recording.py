"""Records of an arm: learned from and judged without a leak, and every odd row named."""

import numpy as np
import pandas as pd
import pytest
from measured_arms import NAMES, recorded
from typer.testing import CliRunner

from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.doubts import checked
from iksamples.recorded.judge import judged, n_held, orders
from iksamples.recorded.learn import recorded_task
from iksamples.recorded.read import read_recording
from iksamples.study import parse_study


URDF = "config/robots/rrr70.urdf"
DEG = 180 / np.pi


def study_of(path, kinds, **recording):
    return parse_study(
        {
            "name": "s",
            "samples": {"recorded": {"path": str(path), **recording}, "sizes": [8, 24]},
            "network": {"hidden": [8], "activation": "tanh"},
            "training": {"optimizer": "levenberg-marquardt", "epochs": 60},
            "methods": {kind: {"kind": kind} for kind in kinds},
        }
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Judged with and without the drawing."""
    drawing, arm, table = recorded()
    path = tmp_path_factory.mktemp("recorded") / "arm.csv"
    table.to_csv(path, index=False)
    kinds = ["nominal", "calibrated", "residual", "gaussian-process"]
    study = study_of(path, kinds, subsets=4)
    recording = read_recording(path, drawing)
    with_drawing, none = judged(study, recording, recorded_task(study, recording))
    without, left = judged(study, recording, None)
    assert none == {}
    assert set(left) == {"nominal", "calibrated", "residual"}
    return study, drawing, arm, table, with_drawing, without


@pytest.mark.slow
def test_no_record_judges_what_has_learned_from_it(found):
    study, *_ = found
    some = orders(study, 60)
    assert some.held.shape == (4, 15)
    for learned, held in zip(some.learned, some.held, strict=True):
        assert sorted([*learned, *held]) == list(range(60))
    assert len({tuple(held) for held in some.held}) == 4


def test_the_drawing_is_judged_by_where_it_puts_the_tool(found):
    _, drawing, _, table, rows, _ = found
    own = rows[rows["method"] == "nominal"]
    off = drawing.forward_mm(table[NAMES[3:]].to_numpy()) - table[NAMES[:3]].to_numpy()
    np.testing.assert_allclose(own["error_mm"], np.linalg.norm(off, axis=1))
    assert set(own["n_samples"]) == {0}


def test_methods_are_judged_as_the_arm_itself_would(found):
    """The tool of the arm itself, sent to where the fitted drawing's inverse says."""
    study, drawing, arm, table, rows, without = found
    from iksamples.calibration.fit import fit_arm
    from iksamples.calibration.known import Prior

    x, q = table[NAMES[:3]].to_numpy(), table[NAMES[3:]].to_numpy()
    learned, held = (part[2] for part in (orders(study, 60).learned, orders(study, 60).held))
    fitted = fit_arm(drawing, q[learned[:24]], x[learned[:24]], prior=Prior(), noise_mm=0.1)
    own = rows[(rows["method"] == "calibrated") & (rows["n_samples"] == 24) & (rows["seed"] == 2)]
    answers = q[held].copy()
    for _ in range(20):  # the fitted arm's inverse, from the recorded joints
        jacobian = fitted.chain.jacobian_mm(answers)
        off = x[held] - fitted.chain.forward_mm(answers)
        answers += np.linalg.solve(jacobian, off[..., None])[..., 0]
    true = np.linalg.norm(arm.forward_mm(answers) - arm.forward_mm(q[held]), axis=1)
    np.testing.assert_allclose(own["error_mm"], true, rtol=0.03, atol=2e-3)
    # Without a drawing, to first order: planes through noisy neighbours are no better than this.
    keys = ["method", "n_samples", "seed", "record"]
    both = without.merge(rows, on=keys, suffixes=("", "_drawn"))
    large = both[both["n_samples"] == 24]
    assert set(large["method"]) == {"network", "gaussian-process"}
    ratio = large["error_mm"] / large["error_mm_drawn"]
    assert 0.9 < ratio.median() < 1.1
    np.testing.assert_allclose(large["joint_deg"], large["joint_deg_drawn"])


def test_more_records_than_there_are(found):
    study, *_ = found
    with pytest.raises(IksamplesError, match=r"leave 22 to learn from; samples.sizes asks for 24"):
        orders(study, 30)
    assert n_held(study, 30) == 8


FORMS = {
    "other units": lambda t: (t * [0.1, 0.001, 1, DEG, 1, DEG]).set_axis(
        ["x [cm]", "y_m", "z_mm", "q1_deg", "q2_rad", "elbow (deg)"], axis=1
    ),
    "another order": lambda t: t[NAMES[::-1]],
    "no units": lambda t: (t * [1e-3, 1e-3, 1e-3, DEG, DEG, DEG]).set_axis(
        ["x", "y", "z", "q1", "q2", "q3"], axis=1
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_units_and_order(tmp_path, form):
    drawing, _, table = recorded()
    FORMS[form](table).to_csv(tmp_path / "arm.csv", index=False)
    found = read_recording(tmp_path / "arm.csv", drawing)
    np.testing.assert_allclose(found.position_mm, table[NAMES[:3]], atol=1e-9)
    np.testing.assert_allclose(found.joints, table[NAMES[3:]], atol=1e-9)
    assert bool(found.remarks) == (form == "no units")


def test_names_that_a_mapping_resolves(tmp_path):
    drawing, _, table = recorded()
    other = (table * [1, 1, 1, DEG, DEG, DEG]).set_axis(["tx", "ty", "x", "a", "b", "c"], axis=1)
    other.to_parquet(tmp_path / "arm.parquet")
    columns = {"x_mm": "tx", "y_mm": "ty", "z_mm": "x", "q1_deg": "a", "q2_deg": "b", "q3_deg": "c"}
    for arm in (drawing, None):
        found = read_recording(tmp_path / "arm.parquet", arm, columns)
        np.testing.assert_allclose(found.position_mm, table[NAMES[:3]], atol=1e-9)
        np.testing.assert_allclose(found.joints, table[NAMES[3:]], atol=1e-9)
    with pytest.raises(IksamplesError, match=r"columns.x_mm: no column 'ty2'"):
        read_recording(tmp_path / "arm.parquet", drawing, {"x_mm": "ty2"})


def test_columns_of_other_names_are_told_with_the_option_that_resolves_them(tmp_path):
    drawing, _, table = recorded()
    table.set_axis(["tx", "ty", "tz", "J1", "J2", "J3"], axis=1).to_csv(tmp_path / "arm.csv")
    for arm in (drawing, None):
        with pytest.raises(IksamplesError, match=r"no column x_mm.*--column x_mm=NAME"):
            read_recording(tmp_path / "arm.csv", arm)


def test_a_folder_of_nothing(tmp_path):
    said = CliRunner().invoke(app, ["size", str(tmp_path)])
    assert "neither a LeRobot data set" in str(said.exception)


@pytest.mark.parametrize("form", ["angles", "quaternion"])
def test_orientations(tmp_path, form):
    from scipy.spatial.transform import Rotation

    drawing, _, table = recorded()
    turned = Rotation.from_matrix(drawing.rotation(table[NAMES[3:]].to_numpy()))
    if form == "angles":
        angles = turned.as_euler("xyz", degrees=True)
        table[["roll_deg", "pitch_deg", "yaw_deg"]] = angles
        table = table.rename(columns={"q_yaw_rad": "q1_rad"})
    else:
        table[["qx", "qy", "qz", "qw"]] = turned.as_quat()
    table.to_csv(tmp_path / "arm.csv", index=False)
    found = read_recording(tmp_path / "arm.csv", drawing)
    np.testing.assert_allclose(found.rotation, turned.as_matrix(), atol=1e-9)
    assert found.inputs == ("x", "y", "z", "roll", "pitch", "yaw")


def test_orientations_told_in_another_way_are_left_out(tmp_path):
    from scipy.spatial.transform import Rotation

    drawing, _, table = recorded()
    turned = Rotation.from_matrix(drawing.rotation(table[NAMES[3:]].to_numpy()))
    other_frame = turned * Rotation.from_euler("x", 90, degrees=True)
    for form, lines in ((turned, 0), (other_frame, 1)):
        table[["qx", "qy", "qz", "qw"]] = form.as_quat()
        table.to_csv(tmp_path / "arm.csv", index=False)
        found, said = checked(read_recording(tmp_path / "arm.csv", drawing), drawing)
        assert len(said) == lines
        assert (found.rotation is None) == bool(lines)
        assert not lines or "the orientations are left out: half of them are 90 deg" in said[0]


def changed(rows, columns, way):
    def change(table):
        table = table.copy()
        table.loc[rows, columns] = way(table.loc[rows, columns])
        return table

    return change


def one_column(table, name, factor):
    return table.assign(**{name: table[name] * factor})


POSITIONS, ANGLES = NAMES[:3], NAMES[3:]
FAULTS = {
    "NaN": (
        changed([4], ["x_mm"], lambda v: v * np.nan),
        "row 5 (line 6) has nothing as x_mm",
        "row 5 (line 6) has nothing as x_mm",
    ),
    "rows in m": (
        changed([4, 9], POSITIONS, lambda v: v / 1000),
        "2 of 60 records fit the others only with positions times 1000: units are mixed "
        "(m among mm) in row 5 (line 6), row 10 (line 11)",
        "2 of 60 records fit the others only with positions times 1000",
    ),
    "rows in degrees": (
        changed([4, 9], ANGLES, lambda v: v * DEG),
        "2 of 60 records fit the others only with angles times 0.01745: units are mixed "
        "(rad among deg) in row 5 (line 6), row 10 (line 11)",
        "rad as its column is said to be, more than joints do. Is it in degrees?",
    ),
    "half of the rows in m": (
        changed(range(30), POSITIONS, lambda v: v / 1000),
        "the joint values do not reach|but by the arm's model it is in m|fit the others only with",
        "the positions are of two sizes",
    ),
    "a column in cm": (
        lambda t: one_column(t, "y_mm", 0.1),
        "y_mm is said to be in mm, but by the arm's model it is in cm",
        None,
    ),
    "all in degrees": (
        lambda t: t * [1, 1, 1, DEG, DEG, DEG],
        "In mm and deg they would: say so in the names, such as x_mm and q_yaw_deg",
        "turns by",
    ),
    "no unit": (
        lambda t: t.rename(columns={"x_mm": "x"}),
        None,
        "no unit is said for x, and without a drawing",
    ),
    "an outlier": (
        changed([7], ["z_mm"], lambda v: v + 60),
        "1 of 60 records have the tool much farther from where the drawing puts it than the rest",
        "1 of 60 records have the tool much farther from where records of like joints have it",
    ),
    "a repeat": (
        lambda t: pd.concat([t, t.iloc[[3]]]),
        "1 of 61 records stand there twice, the same in every number, and are left out (row 61 "
        "(line 62))",
        "1 of 61 records stand there twice",
    ),
    "too few": (lambda t: t.head(5), "5 rows; at least 8 are needed", "5 rows; at least 8"),
    "a full turn": (
        changed([11], ["q_yaw_rad"], lambda v: v + 2 * np.pi),
        "1 of 60 records have joints far from those of records near by",
        "1 of 60 records",
    ),
    "outside the limits": (
        changed([11], ["q_yaw_rad"], lambda v: v + 2 * np.pi),
        "1 of 60 records are outside the joint limits (row 12 (line 13))",
        None,
    ),
    "one height": (lambda t: t.assign(z_mm=5.0), "z is the same in every record|not reach", "z is"),
    "no joints": (
        lambda t: t[POSITIONS],
        "no column q_yaw_rad, q_shoulder_rad, q_elbow_rad",
        "no column is named like a joint",
    ),
}


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_by_row(tmp_path, fault, drawn):
    drawing, _, table = recorded()
    change, *messages = FAULTS[fault]
    message = messages[not drawn]
    change(table).to_csv(tmp_path / "arm.csv", index=False)
    known = drawing if drawn else None
    try:
        _, lines = checked(read_recording(tmp_path / "arm.csv", known), known)
        said = "\n".join(lines)
    except IksamplesError as error:
        said = str(error)
    if message is not None:
        assert any(one in said for one in message.split("|")), said


UNITS = {
    "m as mm": (POSITIONS, 1e-3, "refused", "refused"),
    "mm as m": (POSITIONS, 1e3, "refused", "refused"),
    "m as cm": (POSITIONS, 1e-2, "refused", "refused"),
    "cm as m": (POSITIONS, 1e2, "refused", "passes"),
    "cm as mm": (POSITIONS, 0.1, "refused", "passes"),
    "mm as cm": (POSITIONS, 10, "refused", "passes"),
    "deg as rad": (ANGLES, DEG, "refused", "refused"),
    "rad as deg": (ANGLES, 1 / DEG, "refused", "noted"),
    "x in m": (["x_mm"], 1e-3, "refused", "noted"),
    "yaw in deg": (["q_yaw_rad"], DEG, "refused", "refused"),
    "yaw as deg": (["q_yaw_rad"], 1 / DEG, "refused", "noted"),
}


def outcome(path, table, drawing):
    """What is said of records, and whether they pass all the same."""
    table.to_csv(path, index=False)
    try:
        lines = checked(read_recording(path, drawing), drawing)[1]
    except IksamplesError as error:
        return "refused", [str(error)]
    return ("noted" if lines else "passes"), lines


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("case", UNITS)
def test_whole_columns_in_another_unit(tmp_path, case, drawn):
    drawing, _, table = recorded()
    columns, factor, *expected = UNITS[case]
    table[columns] *= factor
    assert (
        outcome(tmp_path / "arm.csv", table, drawing if drawn else None)[0] == expected[not drawn]
    )


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("pair", [("x_mm", "y_mm"), ("q_yaw_rad", "q_elbow_rad")])
def test_swapped_names(tmp_path, pair, drawn):
    drawing, _, table = recorded()
    swapped = table.rename(columns=dict([pair, pair[::-1]]))
    found, _ = outcome(tmp_path / "arm.csv", swapped, drawing if drawn else None)
    assert found == ("refused" if drawn else "passes")


@pytest.mark.parametrize(
    ("column", "drawn", "passes", "named"),
    [
        ("z_mm", True, 15, 20),
        ("z_mm", False, 15, 30),
        ("q_elbow_rad", True, 0.2, 0.4),
        ("q_elbow_rad", False, 0.3, 0.4),
    ],
)
def test_how_far_off_a_record_has_to_be(tmp_path, column, drawn, passes, named):
    """docs/recorded.md has these figures."""
    drawing, _, table = recorded()
    for row in (0, 30):
        for off, lines in ((passes, 0), (named, 1)):
            odd = table.copy()
            odd.loc[row, column] += off
            said = outcome(tmp_path / "arm.csv", odd, drawing if drawn else None)[1]
            assert sum(f"row {row + 1} (" in line for line in said) >= lines
            assert bool(said) == bool(lines)


def test_another_branch_is_named(tmp_path):
    drawing, arm, table = recorded()
    task_branch = table.copy()
    q = task_branch.loc[[5], ANGLES].to_numpy()
    from iksamples.arm.solvers import yaw_pitch_pitch

    for elbow in ("negative", "positive"):
        other = yaw_pitch_pitch(drawing, drawing.forward_mm(q), elbow, None)
        if np.abs(other - q).max() > 0.5:
            table.loc[[5], ANGLES] = other
            table.loc[[5], POSITIONS] = arm.forward_mm(other)
    table.to_csv(tmp_path / "arm.csv", index=False)
    _, lines = checked(read_recording(tmp_path / "arm.csv", drawing), drawing)
    assert any("another branch" in line and "row 6 (line 7)" in line for line in lines)


def test_clean_records_raise_no_doubt(tmp_path):
    drawing, _, table = recorded()
    table.to_csv(tmp_path / "arm.csv", index=False)
    for known in (drawing, None):
        recording, lines = checked(read_recording(tmp_path / "arm.csv", known), known)
        assert (len(recording), lines) == (60, [])


@pytest.mark.slow
def test_the_command(tmp_path):
    _, _, table = recorded()
    table.to_csv(tmp_path / "arm.csv", index=False)
    options = ["--robot", URDF, "--tolerance-mm", "1", "--subsets", "20", "--of", "mean"]
    said = CliRunner().invoke(app, ["size", str(tmp_path / "arm.csv"), *options])
    assert said.exit_code == 0, said.output
    part = said.output.split("\ncalibrated")[1].split("\nresidual")[0]
    assert "4 samples will do; fewer were not tried" in part
    assert "it fails, and no samples change that" in said.output
    nothing = CliRunner().invoke(app, ["size"])
    assert "name your records" in str(nothing.exception)
