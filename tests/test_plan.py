"""A plan against what a study then does."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from measured_arms import recorded
from typer.testing import CliRunner

from iksamples import task
from iksamples.arm.inverse import solve
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.plan import plan_study, require_affordable, resources, steps
from iksamples.plan.text import in_words, plan_text
from iksamples.results import sample_sets
from iksamples.samples.record import record_samples
from iksamples.study import parse_study, read_study
from iksamples.task import study_task
from iksamples.training.run import train_study, trained_before


SETTINGS = {
    "name": "planned",
    "samples": {"points_per_axis": [2, 3]},
    "training": {"seeds": 3, "epochs": 4, "snapshots": 2},
    "methods": {
        "steps": {"training": {"steps": 30, "seeds": 2}},
        "held-out": {"training": {"held_out": {"source": "grid", "validation_share": 0.2}}},
        "second": {"training": {"optimizer": "levenberg-marquardt", "epochs": 3}},
        "table": {"kind": "multilinear"},
    },
}


def test_networks_and_steps_are_those_that_are_trained(tmp_path):
    study = parse_study(SETTINGS)
    sets = [record_samples(study, study_task(study), *one) for one in sample_sets(study).values()]
    before = plan_study(study)
    train_study(study, sets, tmp_path, tmp_path / "cache")
    assert [one.method for one in before.methods] == ["network", "steps", "held-out", "second"]
    for one in before.methods:
        members = pd.concat(
            pd.read_parquet(tmp_path / one.method / samples.label / "members.parquet")
            for samples in sets
        )
        assert one.networks == one.to_train == len(members)
        assert one.steps == members["steps"].sum()
        assert one.seconds > 0

    # Now that all is trained, and with one seed more.
    more = {**SETTINGS, "training": {**SETTINGS["training"], "seeds": 4}}
    for settings, missing in ((SETTINGS, [0, 0, 0, 0]), (more, [2, 0, 2, 2])):
        again = parse_study(settings)
        plan = plan_study(again, trained_before(again, sets, tmp_path / "cache"))
        assert [one.to_train for one in plan.methods] == missing
        assert [one.steps == 0 for one in plan.methods] == [not n for n in missing]


def test_more_of_anything_takes_longer():
    def seconds(**settings):
        return plan_study(parse_study({"name": "s", **settings})).seconds(2)

    paper = seconds()
    for more in (
        {"training": {"epochs": 500_000}},
        {"training": {"seeds": 2000}},
        {"network": {"hidden": [512]}},
        {"training": {"optimizer": "levenberg-marquardt"}},
        {"training": {"engine": "reference"}},
        {"samples": {"points_per_axis": [2, 3, 4, 5, 6, 7, 8, 16]}},
        {"samples": {"designs": ["grid", "adaptive"]}},
        {"methods": {"cubic": {"kind": "cubic"}}},
        {"replication": {"seeds": 1000}},
    ):
        assert seconds(**more) > paper, more
    large = parse_study({"name": "s", "network": {"hidden": [512, 512]}})
    assert (
        plan_study(large).largest.memory_mb
        > plan_study(parse_study({"name": "s"})).largest.memory_mb
    )


def test_one_core_takes_longer_than_two():
    plan = plan_study(parse_study({"name": "s"}))
    assert plan.seconds(1) > plan.seconds(2) > plan.seconds(2000)
    assert plan.seconds(2000) >= max(step.longest_s for step in plan.steps)


def test_the_text_adds_up():
    study = parse_study(SETTINGS)
    plan = plan_study(study)
    text = plan_text(study, plan, 2)
    assert "5 methods on 2 sets of 8 to 27 samples" in text
    row = next(line for line in text.splitlines() if line.startswith("in all")).split()
    networks, steps = (sum(getattr(m, key) for m in plan.methods) for key in ("networks", "steps"))
    assert row[2:5] == [str(networks), str(networks), str(steps)]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "1 s"), (89, "89 s"), (90, "2 min"), (3600, "60 min"), (9000, "2.5 h")],
)
def test_times_in_words(seconds, text):
    assert in_words(seconds) == text


def test_arms_of_which_nothing_can_be_proved_have_a_plan():
    study = parse_study({**SETTINGS, "arm": {"backlash_rad": 0.01}})
    steps = {step.step: step for step in plan_study(study).steps}
    assert "prove" not in steps
    assert steps["evaluate"].seconds > 0


def test_every_rule_is_planned():
    """And asks for what is planned for it, or for what it is a part of."""
    rules = "".join(file.read_text() for file in Path("workflow/rules").glob("*.smk"))
    pairs = re.findall(r'^rule (\w+):(?:(?!^rule ).)*?asked\(STUDY, "(\w+)"\)', rules, re.M | re.S)
    assert len(pairs) == len(re.findall(r"^rule ", rules, re.M))
    for rule, asked in pairs:
        assert asked == rule.removesuffix("_part")
        assert asked in steps.START


@pytest.mark.parametrize(
    ("more", "step", "times"),
    [
        ({"task": {"orientation": "axis", "reference_rpy_rad": [0, 0, 0]}}, "evaluate", 1.5),
        ({"task": {"orientation": "axis", "reference_rpy_rad": [0, 0, 0]}}, "prove", 1.2),
        ({"bounds": {"mean_rtol": 0.005}}, "prove", 2),
        ({"arm": {"payload_kg": 1, "stiffness_nm_per_rad": 5000}}, "evaluate", 5),
        ({"training": {"snapshots": 25}}, "map", 0.8),
    ],
)
def test_what_a_step_takes_hangs_on_what_it_does(more, step, times):
    large = {"evaluation": {"cube_points": 100_000}}
    seconds = [
        {one.step: one.seconds for one in plan_study(parse_study(settings)).steps}[step]
        for settings in ({"name": "s", **large, **more}, {"name": "s", **large})
    ]
    assert seconds[0] > times * seconds[1] if times > 1 else seconds[0] < times * seconds[1]


def test_a_scheduler_is_asked_for_more_than_the_estimate():
    study = parse_study(SETTINGS)
    for step in plan_study(study).steps:
        asked = resources(study, step.step)
        assert asked["mem_mb"] > step.memory_mb
        assert 60 * asked["runtime"] > step.longest_s
    for apart in ({"readings": {}}, {"samples": {"recorded": {"path": "r.csv"}}}):
        assert resources(parse_study({"name": "s", **apart}), "learn")["mem_mb"] > 0


SIX = {
    "task": {"inputs": ["x", "y", "z", "roll", "pitch", "yaw"], "orientation": "fixed"},
    "workspace": {"lower_rad": [-0.1] * 3, "upper_rad": [0.1] * 3},
}
HUGE = {
    "samples.points_per_axis": {"samples": {"points_per_axis": [32]}, **SIX},
    "training.seeds": {"training": {"seeds": 100_000}},
    "network.hidden": {"network": {"hidden": [1024] * 8}},
    "training.epochs": {"training": {"epochs": 1_000_000, "seeds": 1000}},
    "training.snapshots": {"training": {"snapshots": 1000, "seeds": 100_000, "epochs": 1000}},
    "evaluation.cube_points": {
        "evaluation": {"cube_points": 1_000_000},
        "training": {"seeds": 20_000, "epochs": 1, "snapshots": 2},
    },
    "evaluation.paths": {
        "evaluation": {"paths": {"long": {"shape": "heart", "waypoints": 100_000}}},
        "training": {"seeds": 10_000},
    },
    "methods.kernel": {
        "arm": {"deviation_mm": 1.0},
        "samples": {"sizes": [4000]},
        "methods": {"kernel": {"kind": "gaussian-process"}},
        "training": {"seeds": 1000},
    },
    "samples.sizes": {
        "samples": {"sizes": list(range(8, 208)), "designs": ["sobol"]},
        "methods": {f"m{i}": {} for i in range(1000)},
    },
    "replication.seeds": {"replication": {"seeds": 100_000}},
    "readings.count": {"readings": {"count": 20_000, "seeds": 1000}},
    "samples.recorded.subsets": {
        "samples": {"recorded": {"path": "r.csv", "subsets": 1000}, "sizes": [100_000]},
    },
}


@pytest.mark.parametrize("setting", HUGE)
def test_a_huge_wish_is_refused_until_its_budget_is_raised(setting):
    settings = {"name": "huge", **HUGE[setting]}
    with pytest.raises(IksamplesError) as refused:
        require_affordable(parse_study(settings))
    said = str(refused.value)
    assert len(said.splitlines()) == 2
    assert setting in said.splitlines()[0]
    assert "raise budget." in said.splitlines()[1]
    large = {"memory_gb": 100_000, "processor_hours": 10_000_000}
    require_affordable(parse_study({**settings, "budget": large}))


@pytest.mark.parametrize("file", sorted(Path("config").rglob("*.yaml")))
def test_the_studies_that_come_along_are_affordable(file):
    if "robots" not in file.parts:
        require_affordable(read_study(file))


@pytest.mark.parametrize("command", ["check", "plan", "samples", "train"])
def test_commands_refuse_before_they_make_anything(command, tmp_path, monkeypatch):
    study = tmp_path / "huge.json"
    study.write_text(json.dumps({"name": "huge", **HUGE["samples.points_per_axis"]}))
    more = [] if command in ("check", "plan") else ["-o", str(tmp_path / "made")]
    more += [str(tmp_path / "none.parquet")] if command == "train" else []
    said = CliRunner().invoke(app, [command, str(study), *more])
    assert isinstance(said.exception, IksamplesError)
    assert "budget.memory_gb" in str(said.exception)
    assert not (tmp_path / "made").exists()


LONG = {
    "samples.designs": {"samples": {"designs": ["optimal"], "sizes": [100_000]}},
    "training.seeds": {"arm": {"deviation_mm": 1.0}, "training": {"seeds": 3000}},
    "evaluation.paths": {
        "evaluation": {
            "paths": {f"p{i}": {"shape": "heart", "waypoints": 100_000} for i in range(1000)}
        }
    },
    "evaluation.cube_points": {"evaluation": {"cube_points": 1_000_000}},
}


@pytest.mark.parametrize("command", ["check", "plan"])
@pytest.mark.parametrize("setting", LONG)
def test_a_study_is_checked_and_planned_without_its_work(setting, command, tmp_path, monkeypatch):
    """The arm is asked for few points, whatever the budget allows."""
    asked = []

    def counted(chain, target, points, **how):
        asked.append(len(points))
        assert sum(asked) < 30_000
        return solve(chain, target, points, **how)

    monkeypatch.setattr(task, "solve", counted)
    large = {"memory_gb": 100_000, "processor_hours": 10_000_000}
    study = tmp_path / "long.json"
    study.write_text(json.dumps({"name": "long", "budget": large, **LONG[setting]}))
    said = CliRunner().invoke(app, [command, str(study)])
    assert said.exit_code == 0, said.exception
    told = [line for line in said.output.splitlines() if "left to the run" in line]
    assert len(told) == (setting != "evaluation.cube_points")


def test_sizing_a_recording_is_refused_where_its_orders_would_take_too_much(tmp_path):
    records = tmp_path / "records.csv"
    recorded(n=4000)[2].to_csv(records, index=False)
    arm = ["--robot", "config/robots/rrr70.urdf"]
    said = CliRunner().invoke(app, ["size", str(records), *arm, "--subsets", "1000"])
    assert isinstance(said.exception, IksamplesError)
    first, remedy = str(said.exception).splitlines()
    assert "GB of memory" in first
    assert "--subsets" in remedy


def test_a_recording_of_more_than_a_fit_can_hold_is_refused_before_it_is_read(tmp_path):
    records = tmp_path / "records.parquet"
    columns = ("x_mm", "y_mm", "z_mm", "q1_rad", "q2_rad", "q3_rad")
    pd.DataFrame(dict.fromkeys(columns, [0.5] * 100_001)).to_parquet(records)
    arm = ["--robot", "config/robots/rrr70.urdf"]
    for command in (["size", str(records), *arm], ["fit-arm", "--samples", str(records), *arm]):
        said = CliRunner().invoke(
            app, [*command, *(["-o", str(tmp_path / "a.urdf")] if "fit-arm" in command else [])]
        )
        assert isinstance(said.exception, IksamplesError)
        assert "100000 rows" in str(said.exception)


def test_no_more_poses_are_proposed_than_there_are_places_for(tmp_path):
    """Before any network is trained."""
    asked = ["--samples", str(tmp_path / "none.csv"), "-o", str(tmp_path / "next.csv")]
    said = CliRunner().invoke(app, ["next", "config/config.yaml", *asked, "--count", "1000000000"])
    assert said.exit_code == 2
    assert "--count" in said.output


@pytest.mark.slow
def test_snakemake_refuses_before_it_makes_anything(tmp_path):
    study = tmp_path / "huge.json"
    study.write_text(json.dumps({"name": "huge", **HUGE["training.seeds"]}))
    root = Path.cwd()
    command = ["--snakefile", root / "Snakefile", "--directory", tmp_path, "--configfile", study]
    told = subprocess.run(
        [sys.executable, "-m", "snakemake", "--cores", "1", *map(str, command)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert told.returncode == 2
    lines = [line for line in told.stderr.splitlines() if line.startswith("Error")]
    assert len(lines) == 2
    assert "budget." in lines[1]
    assert not (tmp_path / "results").exists()
