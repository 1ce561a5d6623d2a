"""Arms from files: what is read, and what is refused in a line that says why and what to do."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iksamples.arm.chain import angles_of, roll_pitch_yaw
from iksamples.arm.drawing import drawn_urdf, shows_bodies
from iksamples.arm.load import load_arm
from iksamples.errors import IksamplesError


ORDINARY = """<robot name="arm">
  <link name="base"/><link name="upper"/><link name="fore"/><link name="tip"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1" rpy="0 0 0.5"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="2" effort="1" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="upper"/><child link="fore"/>
    <origin xyz="0.2 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-0.05" upper="0.15" effort="1" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="fore"/><child link="tip"/>
    <origin xyz="0.05 0 0"/></joint>
</robot>
"""
LAST = "</robot>"
SNAKE = (
    '<robot name="snake"><link name="l0"/>'
    + "".join(
        f'<link name="l{i + 1}"/><joint name="j{i}" type="continuous"><parent link="l{i}"/>'
        f'<child link="l{i + 1}"/><origin xyz="0.1 0 0"/><axis xyz="0 0 1"/></joint>'
        for i in range(33)
    )
    + LAST
)
UPPER = '<link name="upper"/>'
XML = '<?xml version="1.0" encoding="%s"?>'


def fixed(parent: str, child: str) -> str:
    return (
        f'<joint name="l" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'
        + LAST
    )


def load(tmp_path: Path, content: str | bytes, name: str = "arm.urdf", **options):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_arm(path, **options)


def same_arm(a, b):
    assert (a.joint_names, a.joint_kinds) == (b.joint_names, b.joint_kinds)
    for name in ("axes", "points_mm", "tip_mm", "tip_rotation", "lower", "upper"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)


def test_units_and_frames_of_an_ordinary_urdf(tmp_path):
    arm = load(tmp_path, ORDINARY)
    assert arm.joint_names == ("j1", "j2")
    assert arm.joint_units == ("rad", "mm")
    np.testing.assert_allclose([arm.lower, arm.upper], [[-1, -50], [2, 150]])
    # Turned by 0.5 rad and q1, 250 mm along x and q2 along y.
    c, s = np.cos(0.8), np.sin(0.8)
    np.testing.assert_allclose(
        arm.forward_mm([0.3, 20]), [250 * c - 20 * s, 250 * s + 20 * c, 100], atol=1e-12
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.encode("utf-8-sig"),
        lambda text: (XML % "UTF-16" + text).encode("utf-16"),
        lambda text: (XML % "ISO-8859-1" + "<!-- für -->" + text).encode("latin1"),
        lambda text: "\n\n" + '<?xml version="1.0"?>\n' + text.replace("\n", "\r\n"),
        lambda text: text.replace("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" '),
        lambda text: text.replace(LAST, "<xacro:property name='w' value='${1}'/>" + LAST),
        lambda text: text.replace(LAST, "<transmission name='t'><joint name='j1'/></transmission>"
                                  "<gazebo><link name='base'/></gazebo>" + LAST),
        lambda text: text.replace('<link name="fore"/>', """<link name="fore"><visual>
            <geometry><mesh filename="package://none/of.stl"/></geometry>
            <geometry><box size="a b"/></geometry></visual><inertial/></link>"""),
        lambda text: text.replace('xyz="0 0 1"', 'xyz=" 0\t0\n 2 "'),
        lambda text: text.replace("effort=", "effort='nan' ignored="),
        lambda text: text.replace(LAST, "<link name='floor'/>" + LAST),
        lambda text: text.replace(LAST, """<link name="finger"/><joint name="f" type="floating">
            <parent link="base"/><child link="finger"/></joint>""" + LAST),
    ],
)  # fmt: skip
def test_what_does_not_place_the_tool_does_not_stop_it(tmp_path, change):
    expected = load(tmp_path, ORDINARY)
    same_arm(load(tmp_path, change(ORDINARY), base_link="base", tip_link="tip"), expected)


def test_a_joint_without_limits_is_fine_until_a_study_needs_them(tmp_path):
    for limit in ("", '<limit effort="1" velocity="1"/>'):
        text = ORDINARY.replace('<limit lower="-1" upper="2" effort="1" velocity="1"/>', limit)
        arm = load(tmp_path, text)
        assert np.isinf([arm.lower[0], arm.upper[0]]).all()
        with pytest.raises(IksamplesError, match=r"'j1' has no limits .* robot\.limits_rad\.j1"):
            arm.with_limits({"j2": (0, 10)})
        np.testing.assert_array_equal(arm.with_limits({"j1": (0, 1)}).upper, [1, 150])
    with pytest.raises(IksamplesError, match=r"limits_mm\.j2: the lower limit 9 is not below"):
        load(tmp_path, ORDINARY).with_limits({"j2": (9, -9)})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (ORDINARY, " \n", "empty"),
        (ORDINARY, "version https://git-lfs.github.com/spec/v1\noid", "git lfs pull"),
        (ORDINARY, "<!DOCTYPE html><html/>", "web page"),
        (ORDINARY, "<!DOCTYPE r [<!ENTITY a 'b'>]><robot name='&a;'/>", "DOCTYPE"),
        (ORDINARY, "<a>" * 100_000, "deep"),
        (ORDINARY, "solid arm", "not a valid URDF .line 1"),
        (LAST, "", "not a valid URDF .line 12"),
        (ORDINARY, XML % "none" + ORDINARY, "not a valid URDF .line 1: unknown encoding"),
        (ORDINARY, "<sdf/>", "<sdf>"),
        (ORDINARY, "<robot><xacro:arm/></robot>", "expand the xacro"),
        (ORDINARY, "<robot/>", "no links"),
        (ORDINARY, "<robot><link name='a'/></robot>", "no moving joint"),
        (UPPER, "", "'j1': its child link 'upper' is not defined"),
        (UPPER, UPPER + UPPER, "'upper' is defined twice"),
        ('name="j2"', 'name="j1"', "joint 'j1' is defined twice"),
        ('name="j2"', 'name=" "', "<joint> number 2 has no name"),
        ('<parent link="base"/>', "", "'j1' names no parent link"),
        ('<child link="upper"/>', "<child/>", "'j1' names no child link"),
        (LAST, fixed("tip", "base"), "loop"),
        (LAST, fixed("base", "tip"), "'tip' hangs from joint 'flange' and from joint 'l'"),
        (LAST, "".join(f'<joint name="l{i}"/>' for i in range(30_000)) + LAST, "30003 joints"),
        (ORDINARY, SNAKE, "33 moving joints"),
        (LAST, '<link name="table"/>' + LAST,
         r"2 links .* .base, table.*--base-link.*robot\.base_link"),
        (LAST, '<link name="cam"/>' + fixed("base", "cam"),
         r"2 end links .tip, cam.*--tip-link.*robot\.tip_link"),
        ('type="prismatic"', 'type="planar"', "'j2' is planar"),
        ('type="prismatic"', 'type="floating"', "'j2' is floating"),
        ('type="prismatic"', "", "'j2' is of no type"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="j1"/>', "'j2' mimics joint 'j1'"),
        ('<axis xyz="0 1 0"/>', '<mimic joint="j9"/>', "'j9', which does not exist"),
        ('<axis xyz="0 1 0"/>', "<axis/>", "axis's xyz is missing"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="1 0 0"/>', "has 2 <axis>"),
        ('"0 1 0"', '"0 0 0"', "axis is zero"),
        ('"0 1 0"', '"0 1e-200 0"', "axis is zero"),
        ('"0 1 0"', '"0 nan 0"', "'nan', not a finite number"),
        ('"0 1 0"', '"0 1e999 0"', "'1e999', not a finite number"),
        ('"0 1 0"', '"0,1,0"', "spaces, not commas"),
        ('"0 1 0"', '"0 1"', "2 numbers instead of 3"),
        ('"0 1 0"', '"0 1 0 0"', "4 numbers instead of 3"),
        ('"0 1 0"', '"0 one 0"', "'one', not a finite number"),
        ('"0.2 0 0"', '"1e307 0 0"', "'j2' lies 1e.307 m from the one before"),
        ('"0.2 0 0"', '"${a} 0 0"', "expand the xacro"),
        ('"0 0 0.5"', '"0 inf 0"', "origin's rpy is 'inf'"),
        ('lower="-1" upper="2"', 'lower="2" upper="-1"', "'j1': its limits are swapped"),
        ('lower="-1" upper="2"', 'lower="0" upper="0"', "'j1': its limits are equal"),
        ('lower="-1" upper="2"', 'lower="-1"', "only a lower limit"),
        ('lower="-1" upper="2"', 'lower="-inf" upper="2"', "lower limit is '-inf'"),
        ('lower="-1" upper="2"', 'lower="1_0" upper="20"', "'1_0', not a finite number"),
    ],
)  # fmt: skip
def test_a_broken_urdf_is_refused_in_one_line(tmp_path, old, new, message):
    assert old in ORDINARY
    with pytest.raises(IksamplesError, match=message) as refusal:
        load(tmp_path, ORDINARY.replace(old, new))
    text = str(refusal.value)
    assert text.startswith(str(tmp_path / "arm.urdf"))
    assert "\n" not in text
    assert len(text) < 400


def test_an_arm_without_length_is_refused(tmp_path):
    text = "<robot><link name='a'/><link name='b'/><link name='c'/>"
    for i, (parent, child) in enumerate(["ab", "bc"]):
        text += (f"<joint name='j{i}' type='continuous'><parent link='{parent}'/>"
                 f"<child link='{child}'/><axis xyz='{i} 0 1'/></joint>")  # fmt: skip
    with pytest.raises(IksamplesError, match="has no length"):
        load(tmp_path, text + LAST)


def test_a_file_that_is_too_large_or_no_file_is_refused(tmp_path):
    with pytest.raises(IksamplesError, match="over 10 MB"):
        load(tmp_path, ORDINARY + " " * 10_000_001)
    with pytest.raises(IksamplesError, match="cannot read the arm"):
        load_arm(tmp_path)
    with pytest.raises(IksamplesError, match="cannot read the arm"):
        load_arm(tmp_path / "nowhere.urdf")


def test_a_drawn_arm_is_the_arm(tmp_path):
    """The arm without bodies of its own as a URDF that has some, down to its gimbal lock."""
    for path in (*sorted(Path("config/robots").glob("*.urdf")), tmp_path / "scara.yaml"):
        if path.suffix == ".yaml":
            path.write_text(STANDARD)
        arm = load_arm(path, tool_offset_mm=[1, 2, 30])
        text = drawn_urdf(arm)
        same_arm(load(tmp_path, text, "drawn.urdf"), arm)
        assert shows_bodies(tmp_path / "drawn.urdf")
        assert text.count("<cylinder") >= arm.n_joints


def test_whether_a_file_shows_bodies(tmp_path, monkeypatch):
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "there.stl").touch()
    mesh = '<link name="fore"><visual><geometry><mesh %s/></geometry></visual></link>'
    for names, shown in (
        ('filename="there.stl"', True),
        ('filename="gone.stl"', False),
        ('filename="package://a/b.stl"', False),
    ):
        text = ORDINARY.replace('<link name="fore"/>', mesh % names)
        (tmp_path / "arm.urdf").write_text(text)
        assert shows_bodies(tmp_path / "arm.urdf") == shown
    (tmp_path / "arm.urdf").write_text(ORDINARY)
    assert not shows_bodies(tmp_path / "arm.urdf")
    assert shows_bodies(Path("config/robots/rrr70.urdf"))


@pytest.mark.parametrize("in_ros", [False, True])
def test_an_arm_of_others_names_no_file_but_what_it_came_with(tmp_path, monkeypatch, in_ros):
    """Rerun would open it, or fetch it, and copy it into a recording that is passed on."""
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path) if in_ros else "")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    private, folder = tmp_path / "private.stl", tmp_path / "arm"
    private.touch()
    folder.mkdir()
    (folder / "link.stl").symlink_to(private)
    (folder / "there.stl").touch()
    body = "<visual><geometry><mesh %s/></geometry></visual>"
    own = body % 'filename="there.stl"'
    for names in (
        f'filename="{private}"',
        f'filename="file://{private}"',
        f"filename='&#47;{str(private)[1:]}'",
        'filename="../private.stl"',
        'filename="there.stl/../../private.stl"',
        'filename="package://arm/../private.stl"',
        'filename="link.stl"',
        'filename="http://127.0.0.1:9/a.stl"',
        f'scale=">" filename="{private}"',
        'filename="http://127.0.0.1:9/a.stl" scale=\'"\'',
        'filename="."',
        'filename=""',
        f'filename="{"a" * 5000}"',
        f'file="{private}"',
    ):
        link = f'<link name="fore">{own}{body % names}</link>'
        (folder / "arm.urdf").write_text(ORDINARY.replace('<link name="fore"/>', link))
        load_arm(folder / "arm.urdf")
        assert not shows_bodies(folder / "arm.urdf"), names


@given(st.tuples(*[st.floats(-3.2, 3.2)] * 3))
def test_angles_of_undoes_roll_pitch_yaw(angles):
    rotation = roll_pitch_yaw(angles)
    np.testing.assert_allclose(roll_pitch_yaw(angles_of(rotation)), rotation, atol=1e-8)


# A SCARA by both conventions: two parallel axes, a quill that slides down, and its turn.
STANDARD = """
convention: standard
joints:
  - {name: shoulder, a_mm: 250, d_mm: 300, lower_deg: -130, upper_deg: 130}
  - {name: elbow, a_m: 0.2, alpha_rad: 3.141592653589793, lower_deg: -140, upper_deg: 140}
  - {name: quill, kind: prismatic, d_mm: 40, lower_mm: 0, upper_mm: 150}
  - {name: turn, theta_deg: 90, d_mm: 10, lower_rad: -3, upper_rad: 3}
"""
MODIFIED = """# convention: modified
name, kind, a_mm, alpha_deg, d_mm, theta_deg, lower_deg, upper_deg, lower_mm, upper_mm
shoulder, revolute, 0, 0, 300, 0, -130, 130, ,
elbow, , 250, 0, 0, 0, -140, 140, ,

quill, prismatic, 200, 180, 40, , , , 0, 150
turn, continuous, 0, 0, 10, 90, , , ,
"""


def test_both_conventions_and_both_kinds_of_file_give_the_same_scara(tmp_path, rng):
    standard = load(tmp_path, STANDARD, "scara.yaml")
    modified = load(tmp_path, MODIFIED, "scara.csv")
    q = rng.uniform(-1, 1, (50, 4)) * [2, 2, 100, 3]
    position, rotation = standard.pose(q)
    a, b, slide, turn = q.T
    np.testing.assert_allclose(position[:, 0], 250 * np.cos(a) + 200 * np.cos(a + b), atol=1e-10)
    np.testing.assert_allclose(position[:, 1], 250 * np.sin(a) + 200 * np.sin(a + b), atol=1e-10)
    np.testing.assert_allclose(position[:, 2], 300 - 40 - slide - 10, atol=1e-10)
    np.testing.assert_allclose(rotation[:, 0, 0], np.cos(a + b - turn - np.pi / 2), atol=1e-12)
    for ours, theirs in zip(modified.pose(q), (position, rotation), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)
    assert standard.joint_names == modified.joint_names
    assert standard.joint_units == modified.joint_units == ("rad", "rad", "mm", "rad")
    np.testing.assert_allclose(standard.upper[:3], modified.upper[:3])
    np.testing.assert_allclose(standard.upper, [*np.radians([130, 140]), 150, 3])


def test_a_fixed_row_and_an_offset_place_the_tool(tmp_path, rng):
    extra = STANDARD + "  - {name: flange, kind: fixed, d_mm: 25, theta_deg: 30}\n"
    q = rng.uniform(-1, 1, (5, 4))
    bare = load(tmp_path, STANDARD, "a.yml", tool_offset_mm=[0, 0, 25])
    fitted = load(tmp_path, extra, "a.yml")
    np.testing.assert_allclose(fitted.forward_mm(q), bare.forward_mm(q), atol=1e-10)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("convention: standard", "", "say which convention"),
        ("standard", "craig", "not 'craig'"),
        ("joints:", "links:", "unknown key 'links'"),
        (STANDARD, "convention: standard\njoints: 3", "a list of rows"),
        (STANDARD, "convention: standard\njoints: []", "no joints"),
        ("d_mm: 300", "d: 300", "'shoulder': 'd' is no value with its unit"),
        ("d_mm: 300", "d_deg: 300", "'d_deg' is no value with its unit"),
        ("d_mm: 300", "d_mm: 300, d_m: 0.3", "d is given in two units"),
        ("d_mm: 300", "d_mm: .nan", "'shoulder': d_mm is 'nan'"),
        ("d_mm: 300", "d_mm: true", "not a number"),
        ("d_mm: 300", "d_mm: [1, 2]", "not a finite number"),
        ("name: elbow", "name: shoulder", "'shoulder' is in the table twice"),
        ("kind: prismatic", "kind: ball", "kind is 'ball'"),
        ("lower_mm: 0", "lower_deg: 0", "'quill' is prismatic: its limit cannot be lower_deg"),
        ("lower_mm: 0, ", "", "'quill' has only one limit"),
        ("lower_deg: -130, upper_deg: 130", "lower_deg: 130, upper_deg: -130", "swapped"),
    ],
)
def test_a_broken_table_is_refused_in_one_line(tmp_path, old, new, message):
    assert old in STANDARD
    with pytest.raises(IksamplesError, match=message) as refusal:
        load(tmp_path, STANDARD.replace(old, new), "arm.yaml")
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).count("arm.yaml") == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# convention: modified", "", "first line"),
        ("300, 0, -130", "300, -130", "row 1 has 9 values, the header 10"),
        ("300, 0, -130", "300, 0, 0, -130", "row 1 has 11 values"),
        ("alpha_deg", "a_mm", "stands twice"),
        ("300", "3OO", "'3OO', not a finite number"),
    ],
)
def test_a_broken_csv_is_refused_in_one_line(tmp_path, old, new, message):
    with pytest.raises(IksamplesError, match=message):
        load(tmp_path, MODIFIED.replace(old, new), "arm.csv")
    with pytest.raises(IksamplesError, match="has no links"):
        load(tmp_path, MODIFIED, "arm.csv", tip_link="tip")


def test_the_tables_in_the_docs_are_read_as_one_arm(tmp_path):
    text = Path("docs/arms.md").read_text()
    yaml = text.split("```yaml\n")[1].split("```")[0]
    table = text.split("```\n# convention")[1].split("```")[0]
    arm = load(tmp_path, yaml, "arm.yaml")
    same_arm(load(tmp_path, "# convention" + table, "arm.csv"), arm)
    assert arm.joint_units == ("rad", "rad", "mm", "rad")
