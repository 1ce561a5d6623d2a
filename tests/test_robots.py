"""The kept robots: forward kinematics against another library and the makers' own parameters."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iksamples.arm.chain import SerialChain
from iksamples.arm.load import load_arm


ROBOTS = sorted(path.stem for path in Path("config/robots").glob("*.urdf"))


def in_double(library, monkeypatch):
    """pytorch_kinematics keeps a URDF's origins and axes in float32; this keeps them in float64."""
    import torch

    def transform(origin):
        rotation = Rotation.from_euler("xyz", (origin and origin.rpy) or [0, 0, 0]).as_matrix()
        position = (origin and origin.xyz) or [0, 0, 0]
        return library.Transform3d(pos=position, rot=torch.tensor(rotation), dtype=torch.float64)

    monkeypatch.setattr(library.urdf, "_convert_transform", transform)
    for made in (library.frame.Joint.__init__, library.chain.Chain.__init__):
        defaults = [torch.float64 if d is torch.float32 else d for d in made.__defaults__]
        monkeypatch.setattr(made, "__defaults__", tuple(defaults))
    return library


def check_against_library(path: Path, n: int, rng, monkeypatch):
    torch = pytest.importorskip("torch")
    library = in_double(pytest.importorskip("pytorch_kinematics"), monkeypatch)
    ours = load_arm(path)
    tip = re.findall(r'<child link="(\w+)"', path.read_text())[-1]
    theirs = library.build_serial_chain_from_urdf(path.read_bytes(), tip).to(dtype=torch.float64)
    q = rng.uniform(ours.lower, ours.upper, (n, ours.n_joints))
    prismatic = np.array(ours.joint_units) == "mm"
    metres = torch.tensor(np.where(prismatic, q / 1000, q))
    expected = theirs.forward_kinematics(metres).get_matrix().numpy()
    jacobian = theirs.jacobian(metres).numpy()
    position, rotation = ours.pose(q)
    linear, angular = ours.jacobians(q)
    # 1e-9 m; rotations and their Jacobian to as many digits of an arm a metre long.
    np.testing.assert_allclose(ours.forward_mm(q), 1000 * expected[:, :3, 3], atol=1e-6, rtol=0)
    np.testing.assert_allclose(position, ours.forward_mm(q), atol=1e-9, rtol=0)
    np.testing.assert_allclose(rotation, expected[:, :3, :3], atol=1e-9, rtol=0)
    scale = np.where(prismatic, 1, 1000)
    np.testing.assert_allclose(linear, jacobian[:, :3] * scale, atol=1e-6, rtol=0)
    np.testing.assert_allclose(angular, jacobian[:, 3:], atol=1e-9, rtol=0)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_agrees_with_pytorch_kinematics(robot, rng, monkeypatch):
    check_against_library(Path(f"config/robots/{robot}.urdf"), 20, rng, monkeypatch)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_agrees_with_pytorch_kinematics_at_10000_configurations(robot, rng, monkeypatch):
    check_against_library(Path(f"config/robots/{robot}.urdf"), 10_000, rng, monkeypatch)


@pytest.mark.filterwarnings("ignore")
def test_every_kind_of_joint_agrees_with_pytorch_kinematics(wrist_file, rng, monkeypatch):
    check_against_library(wrist_file, 50, rng, monkeypatch)


# As their makers publish them: Universal Robots (standard), Franka (modified), and for the iiwa the
# table of Faria et al., Mech. Mach. Theory 121 (2018), Table 1 (standard).
UR5E = """convention: standard
joints:
  - {d_m: 0.1625, alpha_deg: 90}
  - {a_m: -0.425}
  - {a_m: -0.3922}
  - {d_m: 0.1333, alpha_deg: 90}
  - {d_m: 0.0997, alpha_deg: -90}
  - {d_m: 0.0996}
"""
PANDA = """convention: modified
joints:
  - {d_m: 0.333}
  - {alpha_deg: -90}
  - {d_m: 0.316, alpha_deg: 90}
  - {a_m: 0.0825, alpha_deg: 90}
  - {a_m: -0.0825, d_m: 0.384, alpha_deg: -90}
  - {alpha_deg: 90}
  - {a_m: 0.088, alpha_deg: 90}
  - {name: flange, kind: fixed, d_m: 0.107}
  - {name: hand, kind: fixed, d_m: 0.1034, theta_deg: -45}
"""
IIWA = """convention: standard
joints:
  - {d_mm: 360, alpha_deg: -90}
  - {alpha_deg: 90}
  - {d_mm: 420, alpha_deg: 90}
  - {alpha_deg: -90}
  - {d_mm: 400, alpha_deg: -90}
  - {alpha_deg: 90}
  - {d_mm: 126}
"""


@pytest.mark.parametrize(("robot", "table"), [("ur5e", UR5E), ("panda", PANDA), ("iiwa14", IIWA)])
def test_robot_is_its_makers_table(robot, table, tmp_path, rng):
    (tmp_path / "table.yaml").write_text(table)
    published, ours = load_arm(tmp_path / "table.yaml"), load_arm(f"config/robots/{robot}.urdf")
    q = rng.uniform(ours.lower, ours.upper, (500, ours.n_joints))
    for one, other in zip(ours.pose(q), published.pose(q), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_planar_arms_and_scara_are_their_formulas(rng):
    def planar(lengths, q):
        angles = np.cumsum(q, axis=-1)
        return np.stack([np.cos(angles) @ lengths, np.sin(angles) @ lengths], axis=-1)

    for robot, lengths in (("planar2r", [100, 80]), ("planar3r", [100, 80, 40])):
        q = rng.uniform(-2, 2, (50, len(lengths)))
        position, rotation = load_arm(f"config/robots/{robot}.urdf").pose(q)
        np.testing.assert_allclose(position[:, :2], planar(lengths, q), atol=1e-10)
        np.testing.assert_allclose(position[:, 2], 0, atol=1e-12)
        np.testing.assert_allclose(rotation[:, 0, 0], np.cos(q.sum(axis=-1)), atol=1e-12)
    scara = load_arm("config/robots/scara.urdf")
    q = rng.uniform(scara.lower, scara.upper, (50, 4))
    position, rotation = scara.pose(q)
    np.testing.assert_allclose(position[:, :2], planar([120, 130], q[:, :2]), atol=1e-10)
    np.testing.assert_allclose(position[:, 2], 176 + q[:, 2], atol=1e-10)
    np.testing.assert_allclose(rotation[:, 1, 0], np.sin(q[:, [0, 1, 3]].sum(axis=-1)), atol=1e-12)


def test_so101_has_the_published_distances():
    """Distances between neighbouring axes, which no choice of frames changes."""
    arm: SerialChain = load_arm("config/robots/so101.urdf")
    along = arm.axes[1]  # the three pitches

    def apart(i: int, j: int) -> float:
        between = arm.points_mm[j] - arm.points_mm[i]
        return float(np.linalg.norm(between - (between @ along) * along))

    assert arm.axes[0] @ along == 0
    np.testing.assert_allclose(arm.axes[1:4], [along] * 3)
    assert arm.points_mm[1, 0] - arm.points_mm[0, 0] == pytest.approx(30.4, abs=0.05)
    assert apart(1, 2) == pytest.approx(116.0, abs=0.05)
    assert apart(2, 3) == pytest.approx(135.0, abs=0.05)
    meets = arm.points_mm[4] - arm.points_mm[3]
    assert abs(meets @ np.cross(arm.axes[4], along)) < 1e-9


@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_is_small_mesh_free_and_limited(robot):
    path = Path(f"config/robots/{robot}.urdf")
    text = path.read_text()
    assert len(text) < 6000
    assert "<mesh" not in text
    chain = load_arm(path).with_limits({})
    assert chain.within_limits((chain.lower + chain.upper) / 2)
