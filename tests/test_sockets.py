"""Postures in sockets that nobody measured: fitted in some places, judged in others."""

import numpy as np
import pytest
from measured_arms import sockets
from typer.testing import CliRunner

from iksamples.arm.load import load_arm
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.learn import learning_curve
from iksamples.recorded.sockets import FILES, read_places
from iksamples.study import parse_study


def study_of(folder, **recording):
    return parse_study(
        {
            "name": "s",
            "robot": {"urdf": "config/robots/panda.urdf"},
            "samples": {
                "sizes": [8, 24],
                "recorded": {"path": str(folder), "kind": "sockets", "subsets": 4, **recording},
            },
            "methods": {
                "nominal": {"kind": "nominal"},
                "calibrated": {"kind": "calibrated"},
                "chosen": {"kind": "calibrated", "design": "optimal"},
            },
            "tolerance": {"error_mm": 1, "of": "mean"},
        }
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sockets")
    drawing, arm = sockets(folder)
    return folder, drawing, arm, learning_curve(study_of(folder))


def test_places_that_judge_have_no_part_in_the_fit(found):
    folder, _, _, learned = found
    rows = learned.judged
    per_place = 2 * 12
    for _, own in rows[rows["method"] == "calibrated"].groupby(["n_samples", "seed"]):
        assert len(own["record"].unique()) == len(own) == per_place  # one of four places
        assert len(set(own["record"] // per_place)) == 1
    # What judges does not change what is learned: its postures may stand in any order.
    own = rows[(rows["seed"] == 0) & (rows["n_samples"] == 24)]
    (place,) = set(own["record"] // per_place)
    path = folder / f"place{place}" / FILES[0]
    postures = np.loadtxt(path, delimiter=",")
    try:
        np.savetxt(path, postures[::-1], delimiter=",")
        again = learning_curve(study_of(folder)).judged
    finally:
        np.savetxt(path, postures, delimiter=",")
    other = again[(again["seed"] == 0) & (again["n_samples"] == 24)]
    np.testing.assert_allclose(np.sort(own["error_mm"]), np.sort(other["error_mm"]), rtol=1e-6)


def test_the_arm_itself_is_as_consistent_as_its_noise_and_the_fit_comes_near(found):
    folder, drawing, arm, learned = found

    def scatter(model):
        off = []
        for path in sorted(folder.glob("*/*.csv")):
            ball = model.forward_mm(np.loadtxt(path, delimiter=","))
            off += np.linalg.norm(ball - ball.mean(axis=0), axis=1).tolist()
        return float(np.mean(off))

    means = learned.judged.groupby(["method", "n_samples", "seed"])["error_mm"].mean()
    assert means["nominal", 0, 0] == pytest.approx(scatter(drawing), rel=1e-9)
    assert scatter(arm) < 0.1 < 2 < scatter(drawing)
    assert means["calibrated", 24].median() < 0.5
    apart = learned.judged.groupby(["method", "n_samples"])["apart_mm"].median()
    assert apart["calibrated", 24] < 0.3 < apart["nominal", 0]


def test_the_sizes_come_out_as_records(found):
    *_, learned = found
    runs = learned.runs
    assert list(runs["n_samples"]) == [0] + 8 * [8, 24]
    assert list(runs["label"])[-2:] == ["optimal8", "optimal24"]
    assert set(learned.left_out) == {"network"}


def test_few_postures_that_tell_most_leave_less_open(found):
    *_, learned = found
    means = learned.judged.groupby(["method", "n_samples"])["error_mm"].mean()
    assert means["chosen", 8] < 0.9 * means["calibrated", 8]
    # Judged by the same places.
    for _, own in learned.judged.groupby("seed"):
        judges = own[own["n_samples"] > 0].groupby("method")["record"].unique()
        assert set(judges["chosen"]) == set(judges["calibrated"])


REFUSED = {
    "degrees": (lambda q: np.degrees(q), "are they in degrees?"),
    "six joints": (lambda q: q[:, :6], "row 1 (line 1) has 6 values, but there are 7 names"),
    "NaN": (
        lambda q: np.where(np.arange(12)[:, None] == 4, np.nan, q),
        "row 5 (line 5) has 'nan' as panda_joint1, which is no plain number",
    ),
    "one posture": (lambda q: q[:1], "1 rows; at least 2 are needed"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_faulty_files_are_named(tmp_path, fault):
    change, message = REFUSED[fault]
    sockets(tmp_path, places=2)
    path = tmp_path / "place1" / FILES[1]
    np.savetxt(path, change(np.loadtxt(path, delimiter=",")), delimiter=",")
    with pytest.raises(IksamplesError) as caught:
        learning_curve(study_of(tmp_path))
    assert str(path) in str(caught.value)
    assert message in str(caught.value)


def test_links_in_a_recording_are_followed_to_no_end_and_to_no_endless_file(tmp_path):
    sockets(tmp_path, places=2)
    before = read_places(study_of(tmp_path).samples.recorded, load_arm("config/robots/panda.urdf"))
    (tmp_path / "place1" / "loop").symlink_to(tmp_path)
    (tmp_path / "up").symlink_to("..")
    (tmp_path / "round").symlink_to("round")
    settings, drawing = study_of(tmp_path).samples.recorded, load_arm("config/robots/panda.urdf")
    assert read_places(settings, drawing).keys() == before.keys()
    path = tmp_path / "place1" / FILES[1]
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(IksamplesError, match="a pipe or device, no file"):
        read_places(settings, drawing)


def test_a_recording_that_is_not_there_says_where_to_get_it(tmp_path):
    with pytest.raises(IksamplesError, match=r"It can be had from the shelf\. Its place is"):
        learning_curve(study_of(tmp_path / "none", source="the shelf"))
    sockets(tmp_path / "few", places=2, postures=6)
    with pytest.raises(IksamplesError, match="leaves 12 postures to learn from"):
        learning_curve(study_of(tmp_path / "few"))


@pytest.mark.slow
def test_steps_of_a_recorded_study_end_in_a_report(tmp_path):
    sockets(tmp_path / "in")
    study = study_of(tmp_path / "in")
    file, results = tmp_path / "study.json", str(tmp_path / "results" / "s")
    file.write_text(study.model_dump_json())
    reports = tmp_path / "reports" / "s"
    for step in (
        ["check", str(file)],
        ["learn", str(file), "--results", results],
        ["answer", str(file), "--results", results],
        ["report", str(file), "--results", results, "--output", str(reports)],
    ):
        said = CliRunner().invoke(app, step)
        assert said.exit_code == 0, (step, said.output, said.exception)
    text = (reports / "README.md").read_text()
    assert "`calibrated`" in text
    assert "\\`" not in text
    assert (reports / "figures" / "learning-curves.png").exists()
    placed = CliRunner().invoke(app, ["samples", str(file), "--output", str(tmp_path / "x")])
    assert isinstance(placed.exception, IksamplesError)


@pytest.mark.parametrize("kind", ["calibrated", "network"])
def test_who_can_choose_among_records(kind):
    chosen = {"kind": kind, "design": "optimal" if kind == "network" else "sobol"}
    recorded = {"path": "x", "kind": "sockets"}
    for samples in (recorded, {"path": "x.csv"}):
        settings = {"name": "s", "samples": {"recorded": samples}, "methods": {"own": chosen}}
        with pytest.raises(IksamplesError, match=r"methods\.own\.design.*leave it out"):
            parse_study(settings)


@pytest.mark.parametrize(
    "section",
    [
        {"paper": True},
        {"arm": {"noise_mm": 1}},
        {"replication": {"seeds": 5}},
        {"tolerance": {"where": "heart"}},
        {"tolerance": {"best_of": 2}},
    ],
)
def test_settings_that_records_have_no_use_for(section):
    settings = {"name": "s", "samples": {"recorded": {"path": "x.csv"}}} | section
    with pytest.raises(IksamplesError, match=r"is of no use with .samples\.recorded."):
        parse_study(settings)


@pytest.mark.slow
def test_a_folder_needs_no_study(tmp_path):
    sockets(tmp_path)
    options = ["--robot", "config/robots/panda.urdf", "--subsets", "3", "--of", "mean"]
    asked = ["size", str(tmp_path), *options, "--tolerance-mm", "1"]
    unsaid = CliRunner().invoke(app, asked)
    assert "say how far apart the two sockets are" in str(unsaid.exception)
    said = CliRunner().invoke(app, [*asked, "--socket-distance-mm", "50"])
    assert said.exit_code == 0, (said.output, said.exception)
    assert "96 postures with the tool in the sockets of 4 places" in said.output
    # What a study of the same says of the most postures that are learned from.
    study = study_of(tmp_path, subsets=3)
    most = study.samples.model_copy(update={"sizes": [72]})
    learned = learning_curve(study.model_copy(update={"samples": most})).judged
    part = said.output.split("\ncalibrated")[1].splitlines()
    row = next(line.split() for line in part if line.split()[:1] == ["72"])
    own = learned[learned["method"] == "calibrated"].groupby("seed")["error_mm"].mean()
    assert float(row[-3]) == pytest.approx(own.median(), rel=5e-3)
