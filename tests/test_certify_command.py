"""`iksamples certify`: what is asked, said and proved."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from certificate_cases import plain_tip, points_in, turned_away
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from iksamples.arm.load import load_arm
from iksamples.arm.target import Target
from iksamples.cli import app
from iksamples.errors import IksamplesError


ROBOTS = Path("config/robots").resolve()
BOX = "--box 20 20 0 80 80 60"
SCALED = "--offset-mm 20 20 0 --scale-mm 60 60 60"


def certify(words, code=0):
    result = CliRunner().invoke(app, ["certify", *words.split()])
    if isinstance(result.exception, IksamplesError):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def bounds(text, what="position", unit="mm"):
    """The upper bound, the error that is taken, and where."""
    upper, where, lower = re.search(
        rf"no (?:{what}) is missed by more than ([0-9.]+) {unit}; "
        rf"at \((.*)\) it is missed by ([0-9.]+) {unit} \(checked",
        text,
    ).groups()
    return float(upper), float(lower), np.array([float(x) for x in where.split(",")])


def save(path, widths=(3, 8, 3), scale=1.0):
    torch.manual_seed(5)
    first, last = torch.nn.Linear(*widths[:2]), torch.nn.Linear(*widths[1:])
    with torch.no_grad():
        last.weight *= scale
        last.bias *= scale
    model = torch.nn.Sequential(first, torch.nn.Tanh(), last).double()
    torch.save(model.state_dict(), path)
    return model


@pytest.fixture
def net(tmp_path):
    save(tmp_path / "net.pt")
    return tmp_path / "net.pt"


def test_the_sentence_reproduces(net):
    """The bound holds at random points, and the point has the error that is printed."""
    model = save(net)
    robot = ROBOTS / "rrr70.urdf"
    upper, lower, at = bounds(
        certify(f"--weights {net} --activation tanh --robot {robot} {BOX} {SCALED}")
    )
    points = np.random.default_rng(2).uniform((20, 20, 0), (80, 80, 60), (2000, 3))
    points = np.concatenate([points, at[None]])
    given = torch.tensor((points - (20, 20, 0)) / 60)
    tips = plain_tip(load_arm(robot), model(given).detach().numpy())
    errors = np.linalg.norm(tips - points, axis=1)
    assert errors.max() <= upper
    assert errors[-1] >= lower
    assert upper <= 1.0011 * lower


def test_units_and_scalings_of_both_ends_say_the_same(tmp_path):
    """One function, told in four ways."""
    net, robot = tmp_path / "net.pt", ROBOTS / "rrr70.urdf"
    save(net)
    rad = bounds(certify(f"--weights {net} --activation tanh --robot {robot} {BOX} --input-unit m"))
    save(net, scale=180 / np.pi)
    start = f"--weights {net} --activation tanh --robot {robot} {BOX}"
    degrees = f"{start} --output-unit deg"
    ways = [
        f"{degrees} --input-unit m",
        f"{degrees} --scale-mm 1000 1000 1000",
        f"{start} --scale-mm 1000,1000,1000 --output-scale {' '.join([repr(np.pi / 180)] * 3)}",
        f"{degrees} --input-unit m --output-scale 1 1 1 --output-offset 0 0 0",
    ]
    for words in ways:
        found = bounds(certify(words))
        np.testing.assert_allclose(found[0], rad[0], atol=2e-4)
        np.testing.assert_array_equal(found[2], rad[2])
    save(net)
    turned = bounds(
        certify(f"--weights {net} --activation tanh --robot {robot} {BOX} {SCALED} "
                "--output-scale 2 2 2 --output-offset 10 -20 30 --output-unit deg")
    )  # fmt: skip
    at = turned[2]
    answer = save(net)(torch.tensor((at - (20, 20, 0)) / 60)).detach().numpy()
    tip = plain_tip(load_arm(robot), np.radians(2 * answer + (10, -20, 30))[None])[0]
    assert np.linalg.norm(tip - at) == pytest.approx(turned[1], abs=1e-4)


def test_angles_in_degrees_and_a_tool_on_top_say_the_same(tmp_path):
    """A network that takes degrees, on an arm whose tool the file does not have."""
    net, robot = tmp_path / "net.pt", ROBOTS / "planar3r.urdf"
    model = save(net)
    box = "--box 100 20 -0.4 130 60 0.4 --inputs x,y,yaw --rtol 0.05"
    longer = tmp_path / "longer.urdf"
    longer.write_text(
        robot.read_text().replace(
            "</robot>",
            '<link name="pen"/><joint name="grip" type="fixed"><parent link="tcp"/>'
            '<child link="pen"/><origin xyz="0.03 -0.01 0.002"/></joint></robot>',
        )
    )
    words = f"--weights {net} --activation tanh {box}"
    expected = certify(f"{words} --robot {longer}")
    with torch.no_grad():
        model[0].weight[:, 2] *= np.pi / 180
    torch.save(model.state_dict(), net)
    found = certify(f"{words} --robot {robot} --input-unit deg --tool-offset-mm 30 -10 2")
    assert bounds(found) != bounds(certify(f"{words} --robot {robot} --input-unit deg"))
    for what, unit in (("position", "mm"), ("rotation", "deg")):
        for one, other in zip(bounds(found, what, unit), bounds(expected, what, unit), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5)


DOWN = (np.pi, 0.0, np.pi / 2)
POSE = ("x", "y", "z", "roll", "pitch", "yaw")


@pytest.mark.parametrize(
    ("robot", "box", "inputs", "orientation", "rpy"),
    [
        ("planar2r.urdf", "20 20 80 80", ("x", "y"), None, None),
        ("planar3r.urdf", "20 20 -0.4 80 80 0.4", ("x", "y", "yaw"), None, None),
        ("ur5e.urdf", "300 -100 300 400 0 400", ("x", "y", "z"), None, None),
        ("ur5e.urdf", "300 -100 300 400 0 400", ("x", "y", "z"), "axis", DOWN),
        ("scara.urdf", "250 -50 20 -0.5 300 50 60 0.5", (*"xyz", "yaw"), "fixed", (np.pi, 0, 0)),
        ("ur5e.urdf", "300 -50 300 -0.1 -0.1 -0.1 350 0 350 0.1 0.1 0.1", POSE, None, DOWN),
        ("elbow.csv", "20 20 0 80 80 60", ("x", "y", "z"), "fixed", (0.1, -0.2, 0.3)),
    ],
)
def test_positions_and_angles_of_any_task(tmp_path, robot, box, inputs, orientation, rpy):
    """No point is off by more than is printed, and the points that are printed by as much."""
    path = ROBOTS / robot
    if robot == "elbow.csv":
        path = tmp_path / robot
        path.write_text(
            "# convention: standard\ntheta_deg,d_mm,a_mm,alpha_deg\n"
            "0,70,0,90\n10,0,60,0\n-20,0,60,0\n"
        )
    chain = load_arm(path)
    model = save(tmp_path / "net.pt", (len(inputs), 6, chain.n_joints))
    scale = np.where([name in "xyz" for name in inputs], 100.0, 1.0)
    words = f"--weights {tmp_path / 'net.pt'} --activation tanh --robot {path} --box {box}"
    words += f" --scale-mm {' '.join(map(str, scale))} --rtol 0.1"
    words += "" if inputs in (("x", "y"), ("x", "y", "z")) else f" --inputs {','.join(inputs)}"
    words += "" if orientation is None else f" --orientation {orientation}"
    words += "" if rpy is None else f" --reference-rpy-rad {' '.join(map(repr, rpy))}"
    text = certify(words)

    reference = Rotation.from_euler("xyz", rpy or (0, 0, 0)).as_matrix()
    turned = orientation or ("fixed" if set(inputs) & set(POSE[3:]) else "free")
    target = Target(inputs, turned, reference)
    found = [("mm", bounds(text))]
    if turned == "free":
        assert "deg" not in text
    else:
        found.append(("deg", bounds(text, "rotation|direction of the tool's z axis", "deg")))
    for unit, (upper, lower, at) in found:
        points = points_in(np.random.default_rng(3), *np.reshape(box.split(), (2, -1)), 3000)
        points = np.concatenate([points, at[None]])
        joints = model(torch.tensor(points / scale)).detach().numpy()
        if unit == "mm":
            rows = [k for k, name in enumerate("xyz") if name in inputs]
            errors = plain_tip(chain, joints)[:, rows] - points[:, : len(rows)]
            errors = np.linalg.norm(errors, axis=1)
        else:
            errors = np.degrees(turned_away(chain, target, joints, points))
        assert errors.max() <= upper
        assert errors[-1] >= lower - 1e-9
        assert lower <= upper <= 1.1001 * lower + 1e-4


def test_a_search_that_is_stopped_ends_with_a_checked_bound(net):
    start = f"--weights {net} --activation tanh --robot {ROBOTS / 'rrr70.urdf'} {BOX} {SCALED}"
    whole = bounds(certify(f"{start} --rtol 1e-6"))
    for limit in ("--time-limit 0", "--max-boxes 1"):
        text = certify(f"{start} --rtol 1e-6 {limit}")
        assert "stopped early" in text
        assert bounds(text)[0] >= whole[1]


@pytest.mark.parametrize("which", [("position",), ("angle",), ("position", "angle")])
def test_what_is_not_proved_is_not_said(net, monkeypatch, which):
    """Neither error stands for the other."""
    import iksamples.certify.checker as checker

    proved = checker._Checks.largest

    def largest(self, *given):
        return np.inf if self.measure in which else proved(self, *given)

    monkeypatch.setattr(checker._Checks, "largest", largest)
    text = certify(
        f"--weights {net} --activation tanh --robot {ROBOTS / 'rrr70.urdf'} {BOX} {SCALED} "
        "--orientation fixed",
        code=1,
    )
    assert text.count("NOT PROVED") == len(which)
    assert ("no position" in text) == ("position" not in which)
    assert ("no rotation" in text) == ("angle" not in which)
    assert "Proved" not in text


def test_the_order_that_was_read_is_said(net):
    text = certify(f"--weights {net} --activation tanh --robot {ROBOTS / 'rrr70.urdf'} {BOX}")
    assert "3 inputs, 0 (8), tanh, 2 (3), 3 outputs" in text
    assert "in mm" in text


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ("--box 20 20 0 80 80", "--box has 5 numbers"),
        ("--box 0 80", "--box has 2 numbers"),
        ("--box 20 20 0 80 80 0", "--box.*empty"),
        ("--box 20 20 0 nan 80 60", "--box"),
        ("--box 20,20,x,80,80,60", "--box: 'x' is not a number"),
        (f"{BOX} --offset-mm 1 2", "--offset-mm has 2 numbers; one per coordinate"),
        (f"{BOX} --scale-mm 1 0 1", "zero"),
        (f"{BOX} --scale-mm 1 inf 1", "not finite"),
        (f"{BOX} --input-unit m --scale-mm 1 1 1", "leave out --input-unit"),
        (f"{BOX} --input-unit km", "give rad, deg, mm, m"),
        (f"{BOX} --input-unit deg", "no angle is among the inputs"),
        (f"{BOX} --input-unit m --input-unit mm", "two units of lengths"),
        (f"{BOX} --tool-offset-mm 0 0", "--tool-offset-mm: give x, y and z"),
        (f"{BOX} --tool-offset-mm 0 0 inf", "--tool-offset-mm: give x, y and z"),
        (f"{BOX} --output-unit turns", "give rad, deg"),
        (f"{BOX} --output-unit m", "no prismatic joint"),
        (f"{BOX} --output-unit deg --output-unit rad", "two units"),
        (f"{BOX} --output-scale 1", "--output-scale has 1 numbers; one per joint"),
        (f"{BOX} --output-scale 0,1,x", "--output-scale"),
        (f"{BOX} --tip-link nowhere", "nowhere"),
        (f"{BOX} --base-link nowhere", "nowhere"),
        ("--box 20 20 0 0 80 80 60 1", "4 coordinates; name them: --inputs x,y,z,roll"),
        (f"{BOX} --inputs x,y", "--inputs names 2 coordinates, and --box has 3"),
        (f"{BOX} --inputs x,z,y", "--inputs: .* in this order"),
        (f"{BOX} --inputs x,y,left", "--inputs: .* is no input"),
        (f"{BOX} --inputs x,y,yaw --orientation free", "--orientation: with yaw"),
        (f"{BOX} --reference-rpy-rad 1 0 0", "orientation is free"),
        (f"{BOX} --orientation axis --reference-rpy-rad 1 0", "three numbers"),
        (f"{BOX} --orientation axis --reference-rpy-rad nan 0 0", "three numbers"),
        ("--box 20 20 80 80", "takes 3 values and answers 3; the box has 2 coordinates"),
    ],
)
def test_a_line_says_what_is_wrong(net, words, match):
    with pytest.raises(IksamplesError, match=match) as caught:
        certify(f"--weights {net} --activation tanh --robot {ROBOTS / 'rrr70.urdf'} {words}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("extreme", "said"),
    [
        ("--scale-mm 1e-310 1 1", "float32 may overflow"),
        ("--output-scale 1e39 1e39 1e39", "float32 may overflow"),
        ("--output-scale 1e30 1 1", "float32 adds at most"),
    ],
)
def test_what_float32_cannot_hold_is_no_traceback(net, extreme, said):
    start = f"--weights {net} --activation tanh --robot {ROBOTS / 'rrr70.urdf'} {BOX}"
    text = certify(f"{start} {extreme} --max-boxes 1")
    assert said in text
    assert bounds(text)[0] >= bounds(text)[1]


def test_progress_is_said_after_a_second(capsys):
    import time

    from iksamples.cli.common import shown

    with shown("thinking"):
        time.sleep(0.2)
    assert capsys.readouterr().err == ""
    with shown("thinking"):
        time.sleep(1.3)
    captured = capsys.readouterr()
    assert "1 s: thinking ..." in captured.err
    assert captured.out == ""
