"""A fitted drawing to take away: the file is the fit, and what is said of it holds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from measured_arms import NAMES, recorded
from typer.testing import CliRunner

from iksamples.arm.load import load_arm
from iksamples.arm.real import deviated, deviated_pose
from iksamples.calibration.fit import fit_arm
from iksamples.calibration.known import Fitted, Prior
from iksamples.calibration.urdf import ADDED, fitted_urdf, require_agreement
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.fitted import fit_recording
from iksamples.study import parse_study


URDF = "config/robots/rrr70.urdf"
ARMS = sorted(Path("config/robots").glob("*.urdf"))


def fitted(chain, seed=0):
    """A fit with any deviations at all."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(chain.n_joints + 1, 6)) * np.repeat([5, 0.05], 3)
    size = rows.size
    return Fitted(chain, rows, np.eye(size), 0.1, 1.0, np.empty((0, 3)))


@pytest.mark.parametrize("path", ARMS, ids=lambda path: path.stem)
def test_the_file_is_the_fitted_arm(tmp_path, path):
    chain = load_arm(path)
    found = fitted(chain)
    text, tip = fitted_urdf(path, found, None, None)
    (tmp_path / "out.urdf").write_text(text)
    read = load_arm(tmp_path / "out.urdf", tip_link=tip)
    arm = deviated(chain, found.deviations)
    q = np.random.default_rng(1).uniform(chain.lower, chain.upper, (100, chain.n_joints))
    np.testing.assert_allclose(read.forward_mm(q), arm.forward_mm(q), atol=1e-6)
    np.testing.assert_allclose(read.rotation(q), arm.rotation(q), atol=1e-9)
    np.testing.assert_array_equal(read.lower, chain.lower)
    # What is no part of the chain, bodies above all, stays.
    assert text.count("<visual") == path.read_text().count("<visual")
    assert text[: text.index("<robot")] == path.read_text()[: path.read_text().index("<robot")]


def test_a_tool_that_no_fixed_joint_carries_gets_one(tmp_path):
    bare = Path(URDF).read_text()
    tip = load_arm(URDF).joint_names[-1]
    link = bare.split(f'<joint name="{tip}"')[1].split('<child link="')[1].split('"')[0]
    chain = load_arm(URDF, tip_link=link)
    found = fitted(chain)
    text, tool = fitted_urdf(Path(URDF), found, None, link)
    assert tool == ADDED
    (tmp_path / "out.urdf").write_text(text)
    require_agreement(tmp_path / "out.urdf", found, None, tool)
    with pytest.raises(IksamplesError, match="from what was fitted"):
        require_agreement(tmp_path / "out.urdf", found, None, link)


def test_a_table_becomes_a_urdf(tmp_path):
    table = tmp_path / "dh.csv"
    table.write_text(
        "# convention: standard\nname,a_mm,alpha_deg,d_mm,theta_deg\n"
        "a,0,90,100,0\nb,200,0,0,0\nc,150,0,0,0\n"
    )
    chain = load_arm(table)
    found = fitted(replace(chain, lower=-np.ones(3), upper=np.ones(3)))
    text, tip = fitted_urdf(table, found, None, None)
    (tmp_path / "out.urdf").write_text(text)
    require_agreement(tmp_path / "out.urdf", found, None, tip)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    drawing, arm, table = recorded(n=40, noise_mm=0.1)
    path = tmp_path_factory.mktemp("fit") / "arm.csv"
    table.to_csv(path, index=False)
    study = parse_study(
        {"name": "s", "robot": {"urdf": URDF}, "samples": {"recorded": {"path": str(path)}}}
    )
    return path, drawing, arm, table, fit_recording(study)


def test_held_out_errors_are_those_of_the_arm_and_its_noise(records):
    _, drawing, arm, table, found = records
    q, x = table[NAMES[3:]].to_numpy(), table[NAMES[:3]].to_numpy()
    np.testing.assert_allclose(found.drawn_mm, np.linalg.norm(drawing.forward_mm(q) - x, axis=1))
    # Noise of 0.1 mm along three axes: 0.16 mm in the mean, and a little for the fit.
    noise = 0.1 * np.sqrt(8 / np.pi)
    assert noise * 0.8 < found.held_out_mm.mean() < noise * 1.4
    model = np.linalg.norm(found.fitted.chain.forward_mm(q) - arm.forward_mm(q), axis=1)
    assert found.model_mm[0] == pytest.approx(np.sqrt(np.mean(model**2)), rel=0.7)


def test_a_tool_that_is_less_certain_is_expected_to_be(records, tmp_path):
    """Its place on the flange is 6 mm off: told so, the fit moves that and hardly the links."""
    path, drawing, *_ = records
    q = pd.read_csv(path)[NAMES[3:]].to_numpy()[:8]
    moved = drawing.with_tool([0, 0, 6])
    table = pd.DataFrame(np.hstack([moved.forward_mm(q), q]), columns=NAMES)
    table.to_csv(tmp_path / "moved.csv", index=False)
    recording = {"path": str(tmp_path / "moved.csv"), "assumed": {"tool_mm": 6, "noise_mm": 0.01}}
    study = {"name": "s", "robot": {"urdf": URDF}, "samples": {"recorded": recording}}
    found = fit_recording(parse_study(study))
    assert (found.prior_sd[-1, :3] == 6).all()
    assert (found.prior_sd[:-1, :3] == 1).all()
    assert np.abs(found.fitted.deviations[:-1, :3]).max() < 0.5
    assert np.linalg.norm(found.fitted.deviations[-1, :3]) > 4


def test_more_records_are_foretold_as_if_each_had_been_measured_again(records):
    _, drawing, _, table, found = records
    q, x = table[NAMES[3:]].to_numpy(), table[NAMES[:3]].to_numpy()
    for times, foretold in zip((2, 4), found.model_mm[1:], strict=True):
        again = fit_arm(
            drawing,
            np.tile(q, (times, 1)),
            np.tile(x, (times, 1)),
            prior=Prior(1.0, 0.01745),
            noise_mm=found.fitted.noise_mm,
        )
        by = deviated_pose(drawing, again.deviations, q)[2]
        spread = np.einsum("nki,ij,nkj->n", by, again.covariance, by)
        assert foretold == pytest.approx(np.sqrt(spread.mean()), rel=0.01)


def test_the_command(records, tmp_path):
    path, _, arm, table, found = records
    output, parameters = tmp_path / "out.urdf", tmp_path / "parameters.csv"
    said = CliRunner().invoke(
        app,
        f"fit-arm --robot {URDF} --samples {path} --output {output} --parameters {parameters}",
    )
    assert said.exit_code == 0, said.output
    q = table[NAMES[3:]].to_numpy()
    off = np.linalg.norm(load_arm(output).forward_mm(q) - arm.forward_mm(q), axis=1)
    assert off.mean() < 0.1 < 1 < found.drawn_mm.mean()
    rows = pd.read_csv(parameters)
    np.testing.assert_allclose(rows["value"], found.fitted.deviations.ravel())
    np.testing.assert_allclose(rows["sd"] ** 2, found.fitted.covariance.diagonal())
    assert f"{found.held_out_mm.mean():.3g} mm in the mean" in said.output
    missing = ["fit-arm", "--robot", "no.urdf", "--samples", str(path), "--output", str(output)]
    assert "no.urdf: cannot read the arm" in str(CliRunner().invoke(app, missing).exception)
