"""Jobs of a large study: cut into parts, sent through Slurm, and the same numbers."""

import os
import shutil
import socket
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_training_run import contents
from test_workflow import project_copy, snakemake

from iksamples.certify import step
from iksamples.jobs import parts
from iksamples.network import StackedMLP
from iksamples.plan import plan_study
from iksamples.samples.record import grid_samples
from iksamples.study import PROVED_TOGETHER, parse_study
from iksamples.task import study_task
from iksamples.training.run import train_study


SETTINGS = {
    "name": "parts",
    "samples": {"points_per_axis": [2]},
    "network": {"hidden": [4]},
    "training": {"epochs": 5, "seeds": PROVED_TOGETHER + 2, "snapshots": 2},
    "evaluation": {"cube_points": 64, "paths": {"heart": {"shape": "heart", "waypoints": 8}}},
    "bounds": {"sup_rtol": 0.1, "mean_rtol": 0.5},
}


def seeds_of(part):
    first, last = map(int, part.split("-"))
    return range(first, last + 1)


@given(
    seeds=st.integers(1, 5000),
    first_seed=st.integers(0, 10**6),
    sizes=st.lists(st.integers(2, 12), min_size=1, max_size=6, unique=True),
    per_job=st.none() | st.integers(1, 40).map(lambda n: n * PROVED_TOGETHER),
)
def test_parts_are_all_seeds_once(seeds, first_seed, sizes, per_job):
    study = parse_study(
        {
            "name": "x",
            "samples": {"points_per_axis": sorted(sizes)},
            "training": {"seeds": seeds, "first_seed": first_seed},
            "seeds_per_job": per_job,
        }
    )
    steps = {one.step: one for one in plan_study(study).steps}
    for cut, name in ((parts(study), "train"), (parts(study, "network"), "prove")):
        whole = [seed for part in cut for seed in seeds_of(part)]
        assert whole == (list(study.seeds) if cut else [])
        assert all((seeds_of(part)[0] - first_seed) % PROVED_TOGETHER == 0 for part in cut)
        assert len(cut) != 1
        assert steps[name].jobs == max(1, len(cut))
        if per_job:
            assert max(1, len(cut)) == -(-seeds // per_job)


def test_a_usual_study_is_trained_by_one_job_and_a_large_one_by_several():
    assert parts(parse_study({"name": "x"})) == []
    large = parse_study({"name": "x", "training": {"seeds": 2000}, "network": {"hidden": [64]}})
    steps = {one.step: one for one in plan_study(large).steps}
    assert steps["prove"].seconds > 3600
    assert 300 < steps["prove"].longest_s < 610
    assert len(parts(large, "network")) == steps["prove"].jobs


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A study, its samples, and its networks trained in one piece."""
    study = parse_study(SETTINGS)
    samples = grid_samples(study, study_task(study), 2)
    folder = tmp_path_factory.mktemp("whole")
    train_study(study, [samples], folder)
    return study, samples, folder / "network"


@pytest.mark.slow
def test_training_in_parts_changes_no_bit(trained, tmp_path):
    study, samples, whole = trained
    cuts = [range(0, 50), range(50, 52)]
    for cut in cuts:
        train_study(study, [samples], None, tmp_path / f"{cut[0]}", seeds=cut)
    others = [tmp_path / f"{cut[0]}" for cut in cuts]
    train_study(study, [samples], tmp_path / "out", tmp_path / "cache", others=others)
    assert contents(tmp_path / "out/network/grid2") == contents(whole / "grid2")
    kept = list((tmp_path / "cache").rglob("seeds-*"))
    assert [file.name.split("-")[1:3] for file in kept] == [["0", "51"]]


@pytest.mark.slow
def test_proofs_in_parts_change_no_digit(trained, tmp_path, monkeypatch):
    study, samples, whole = trained
    task = study_task(study, samples.region)
    monkeypatch.setattr(step, "PROVED_TOGETHER", 2)
    network = StackedMLP.load(whole / "grid2/weights.safetensors").select(range(7))
    network.weights[0][3, 0, 0] = np.nan  # it has no worst case, and moves nobody into another part
    network.save(tmp_path / "weights.safetensors")

    def proved(seeds):
        found = step.certify(study, task, "network", samples, tmp_path, seeds)
        return found.drop(columns="seconds")

    files = []
    for first, last in ((4, 6), (0, 3)):
        files.append(tmp_path / f"{first}.csv")
        proved(range(first, last + 1)).to_csv(files[-1], index=False)
    assert step.joined(files, ["grid2"]).to_csv(index=False) == proved(None).to_csv(index=False)


CONF = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory_mb}
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def free_ports(n):
    held = [socket.socket() for _ in range(n)]
    for one in held:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in held]
    for one in held:
        one.close()
    return ports


@pytest.fixture
def slurm():
    """A cluster of this machine alone, in a folder of its own; what finds it, as environment."""
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
    missing = [
        name
        for name in ("munged", "slurmctld", "slurmd", "sbatch", "srun")
        if not shutil.which(name, path=path)
    ]
    if missing:
        pytest.skip(f"no {', '.join(missing)} here (apt install munge slurmctld slurmd)")
    # The path of a socket has to be short.
    folder = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))
    folder.chmod(0o755)
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir()
    (folder / "key").write_bytes(os.urandom(64))
    (folder / "key").chmod(0o400)
    memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    conf = folder / "slurm.conf"
    conf.write_text(
        CONF.format(
            host=socket.gethostname().split(".")[0],
            ports=free_ports(2),
            user=subprocess.check_output(["id", "-un"], text=True).strip(),
            folder=folder,
            cores=os.cpu_count(),
            memory_mb=memory_mb,
        )
    )
    # Within a job the plugin forgets where Slurm's configuration is, unless it is the system's.
    srun = folder / "bin/srun"
    srun.write_text(f'#!/bin/sh\nSLURM_CONF={conf} exec {shutil.which("srun")} "$@"\n')
    srun.chmod(0o755)
    found = {"SLURM_CONF": str(conf), "PATH": f"{folder}/bin:{path}"}
    files = {"key": "key", "socket": "munge.socket", "pid": "munge.pid", "seed": "munge.seed"}
    places = [
        f"--{name}{'' if name == 'socket' else '-file'}={folder / file}"
        for name, file in files.items()
    ]
    daemons = []
    try:
        for command in (
            ["munged", "--force", "--foreground", f"--log-file={folder}/munge.log", *places],
            ["slurmctld", "-D", "-i"],
            ["slurmd", "-D"],
        ):
            log = (folder / f"{command[0]}.log").open("w")
            daemons.append(
                subprocess.Popen(command, env={**os.environ, **found}, stdout=log, stderr=log)
            )
            log.close()
            until(lambda: (folder / "munge.socket").exists())
        environment = {**os.environ, **found}
        until(lambda: "idle" in output(["sinfo", "--noheader"], environment))
        yield found
    finally:
        output(["scancel", "--partition=all"], {**os.environ, **found})
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait(timeout=60)
        shutil.rmtree(folder)


def output(command, environment):
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return done.stdout


def until(holds, tries=600):
    for _ in range(tries):
        if holds():
            return
        time.sleep(0.1)
    raise AssertionError("Slurm does not come up")


@pytest.mark.slow
def test_slurm_makes_the_same_numbers_as_this_machine(slurm, tmp_path):
    """Through the profile, with training and proofs in parts; here without either."""
    places = {name: project_copy(tmp_path / name) for name in ("here", "there")}
    for folder in places.values():
        (folder / "study.yaml").write_text(repr(SETTINGS))
    study, target = ("--configfile", "study.yaml"), "results/parts/runs.parquet"
    with ThreadPoolExecutor() as beside:  # The other one mostly waits for its jobs.
        plain = beside.submit(snakemake, places["here"], target, "--cores", "2", *study)
        done = snakemake(
            places["there"], target, "--profile", "profiles/slurm", *study,
            "--config", f"seeds_per_job={PROVED_TOGETHER}",
            # A cluster without accounting, and in a hurry.
            "--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", "1",
            **slurm,
        )  # fmt: skip
    plain.result()
    assert done.stderr.count("Submitted array job") == 2  # of trainings, and of proofs
    here, there = (folder / "results/parts" for folder in places.values())
    cell = "network/grid2"
    assert contents(there / cell) == contents(here / cell)
    for name in ("samples/grid2", f"{cell}/cube", f"{cell}/errors", f"{cell}/waypoints", "runs"):
        assert (there / f"{name}.parquet").read_bytes() == (here / f"{name}.parquet").read_bytes()
    proofs = [
        pd.read_csv(place / "network/certificates.csv", dtype=str).drop(columns="seconds")
        for place in (here, there)
    ]
    assert len(proofs[0]) == PROVED_TOGETHER + 2
    pd.testing.assert_frame_equal(*proofs)
    assert not list(there.glob("parts/*"))
