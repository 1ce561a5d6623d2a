"""The training step as a whole: its files read back, and its cache."""

import json
import os

import numpy as np
import pandas as pd
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file

from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.samples.record import grid_samples
from iksamples.study import parse_study
from iksamples.task import study_task
from iksamples.training import run
from iksamples.training.problem import pose_problem


FILES = ("weights.safetensors", "snapshots.safetensors", "history.parquet", "members.parquet")


def make_study(**training):
    settings = {"epochs": 12, "seeds": 3, "snapshots": 5, **training}
    return parse_study({"name": "x", "network": {"hidden": [6]}, "training": settings})


@pytest.fixture
def trained(monkeypatch):
    """The seeds that were really trained, one list per fit."""
    fits, fit = [], run._fit

    def listen(study, samples, seeds, *rest):
        fits.append((samples.label, list(seeds)))
        return fit(study, samples, seeds, *rest)

    monkeypatch.setattr(run, "_fit", listen)
    return fits


def train_all(study, sets, folders, cache=None):
    for samples, folder in zip(sets, folders, strict=True):
        run.train(study, samples, folder, cache / samples.label if cache else None)


def contents(folder):
    """Everything in the four files, to the last bit (safetensors writes metadata in any order)."""
    found = {}
    for name in FILES:
        path = folder / name
        if path.suffix == ".parquet":
            found[name] = path.read_bytes()
            continue
        with safe_open(path, "numpy") as file:
            found[name] = file.metadata() | {
                key: file.get_tensor(key).tobytes() for key in sorted(file.keys())
            }
    return found


def test_a_job_of_slurm_trains_as_any_other(tmp_path, monkeypatch):
    """Lightning looks for Slurm by itself, in the environment and for its commands."""
    study = make_study()
    sets = [grid_samples(study, study_task(study), 2)]
    train_all(study, sets, [tmp_path / "here"])
    (tmp_path / "srun").write_text("#!/bin/sh\n")
    (tmp_path / "srun").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    train_all(study, sets, [tmp_path / "beside"])
    job = {"JOB_ID": "7", "JOB_NAME": "j", "NTASKS": "4", "NNODES": "2", "PROCID": "3"}
    for name, value in job.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    train_all(study, sets, [tmp_path / "there"])
    here = contents(tmp_path / "here")
    assert contents(tmp_path / "beside") == here == contents(tmp_path / "there")


@pytest.mark.parametrize("source", ["fresh", "grid"])
def test_files_agree_with_each_other_and_with_the_samples(tmp_path, source):
    study = make_study(first_seed=4, held_out={"source": source, "test_share": 0.1})
    sets = [grid_samples(study, study_task(study), m) for m in (2, 3)]
    folders = [tmp_path / "a", tmp_path / "b"]
    train_all(study, sets, folders)
    for samples, folder in zip(sets, folders, strict=True):
        assert sorted(path.name for path in folder.glob("[!.]*")) == sorted(FILES)
        network = StackedMLP.load(folder / "weights.safetensors")
        assert network.seeds == (4, 5, 6)
        np.testing.assert_array_equal(network.scale, samples.scale)

        members = pd.read_parquet(folder / "members.parquet")
        problem = pose_problem(study, samples, study.seeds)
        n, steps = problem.n_train, -(-problem.n_train // 8)
        counts = members[["n_trained", "n_validation", "n_test", "epochs_run", "steps"]]
        kinds = [problem.validation_rows.shape[1], problem.test_rows.shape[1]]
        assert (counts == [n, *kinds, 12, 12 * steps]).all(axis=None)
        if source == "grid":
            assert (counts.iloc[:, :3].sum(axis=1) == samples.n_samples).all()
        else:
            assert n == samples.n_samples
        assert members.seed.tolist() == [4, 5, 6]
        assert not members.diverged.any()

        mm = np.concatenate([samples.x, samples.validation_x, samples.test_x])
        joints = np.concatenate([samples.joints, samples.validation_joints, samples.test_joints])
        for i in range(3):
            for kind in ("train", "validation", "test"):
                rows = getattr(problem, f"{kind}_rows")[i]
                loss = (
                    np.mean((network.predict(mm[rows])[i] - joints[rows]) ** 2)
                    if len(rows)
                    else np.nan
                )
                np.testing.assert_allclose(members[f"{kind}_loss"][i], loss, rtol=1e-12)

        history = pd.read_parquet(folder / "history.parquet")
        assert history.groupby("seed").epoch.apply(list).tolist() == [list(range(1, 13))] * 3
        last = history[history.epoch == 12]
        np.testing.assert_allclose(last.validation_loss, members.validation_loss, rtol=1e-4)
        entries = np.concatenate([w.reshape(3, -1) for w in network.weights], axis=1)
        np.testing.assert_allclose(last.weight_mean_abs, np.abs(entries).mean(axis=1), rtol=1e-6)
        assert (history.groupby("seed").train_loss.apply(lambda x: x.iloc[-1] < x.iloc[0])).all()

        snapshots = load_file(folder / "snapshots.safetensors")
        assert snapshots["epochs"].tolist()[0] == 0
        assert snapshots["epochs"].tolist()[-1] == 12
        for depth, weight in enumerate(network.weights):
            kept = snapshots[f"layers.{depth}.weight"]
            assert kept.shape == (len(snapshots["epochs"]), *weight.shape)
            np.testing.assert_array_equal(kept[-1], weight)
        with safe_open(folder / "snapshots.safetensors", "numpy") as file:
            assert json.loads(file.metadata()["iksamples"])["seeds"] == [4, 5, 6]


def test_only_what_is_new_is_trained_and_the_files_are_the_same(tmp_path, trained):
    cache = tmp_path / "cache"
    study = make_study()
    two, three = (grid_samples(study, study_task(study), m) for m in (2, 3))
    train_all(study, [two], [tmp_path / "2"], cache)
    train_all(study, [two, three], [tmp_path / "2", tmp_path / "3"], cache)
    more = make_study(seeds=5)
    train_all(more, [two, three], [tmp_path / "2", tmp_path / "3"], cache)
    assert trained == [
        ("grid2", [0, 1, 2]),
        ("grid3", [0, 1, 2]),
        ("grid2", [3, 4]),
        ("grid3", [3, 4]),
    ]
    train_all(more, [two, three], [tmp_path / "2", tmp_path / "3"], cache)
    assert len(trained) == 4
    train_all(more, [two, three], [tmp_path / "new2", tmp_path / "new3"])
    for m in (2, 3):
        assert contents(tmp_path / f"new{m}") == contents(tmp_path / f"{m}")
    assert len(list(cache.rglob("*.safetensors"))) == 2


def test_the_cache_forgets_what_the_study_no_longer_uses(tmp_path, trained):
    cache = tmp_path / "cache"
    three = grid_samples(make_study(), study_task(make_study()), 3)
    run.train(make_study(), three, tmp_path / "3", cache)
    run.train(make_study(seeds=2), three, tmp_path / "3", cache)
    (kept,) = cache.rglob("*.safetensors")
    assert load_file(kept)["seeds"].tolist() == [0, 1]
    assert len(trained) == 1
    run.train(make_study(seeds=2, learning_rate=0.01), three, tmp_path / "3", cache)
    assert trained[1:] == [("grid3", [0, 1])]


@pytest.mark.parametrize(
    "damage",
    [lambda b: b[:100], lambda b: b[:-40] + bytes([b[-40] ^ 1]) + b[-39:]],
    ids=["cut", "one bit"],
)
def test_a_damaged_cache_file_is_trained_again(tmp_path, trained, damage):
    cache, out = tmp_path / "cache", tmp_path / "out"
    samples = grid_samples(make_study(), study_task(make_study()), 2)
    run.train(make_study(), samples, out, cache)
    before = contents(out)
    (file,) = cache.rglob("*.safetensors")
    file.write_bytes(damage(file.read_bytes()))
    run.train(make_study(), samples, out, cache)
    assert len(trained) == 2
    assert contents(out) == before
    run.train(make_study(), samples, out, cache)
    assert len(trained) == 2


def test_an_interrupted_run_keeps_what_it_has_trained(tmp_path, trained, monkeypatch):
    cache, study = tmp_path / "cache", make_study()
    sets = [grid_samples(study, study_task(study), m) for m in (2, 3)]
    folders = [tmp_path / "2", tmp_path / "3"]
    monkeypatch.setattr(run, "SEEDS_AT_ONCE", 2)
    fit = run._fit

    def break_off(study, samples, seeds, *rest):
        if (samples.label, list(seeds)) == ("grid3", [2]):
            raise KeyboardInterrupt
        return fit(study, samples, seeds, *rest)

    monkeypatch.setattr(run, "_fit", break_off)
    with pytest.raises(KeyboardInterrupt):
        train_all(study, sets, folders, cache)
    assert not folders[1].exists()
    monkeypatch.setattr(run, "_fit", fit)
    train_all(study, sets, folders, cache)
    assert trained == [("grid2", [0, 1]), ("grid2", [2]), ("grid3", [0, 1]), ("grid3", [2])]
    train_all(study, sets, [tmp_path / "n2", tmp_path / "n3"])
    for m in (2, 3):
        assert contents(tmp_path / f"n{m}") == contents(tmp_path / f"{m}")


def test_progress_is_a_line_per_grid_where_there_is_no_terminal(tmp_path, capsys):
    study = make_study(seeds=2, epochs=2)
    samples = grid_samples(study, study_task(study), 2)
    run.train(study, samples, tmp_path, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("grid2: 8 samples, 2 seeds, 2 epochs, ")
    assert err.count("\n") == 1
    run.train(study, samples, tmp_path / "tanh/grid2", progress=True)
    assert capsys.readouterr().err.startswith("tanh/grid2: 8 samples")
    run.train(study, samples, tmp_path)
    assert capsys.readouterr() == ("", "")


def test_a_diverged_seed_is_a_row_that_says_so(tmp_path):
    study = make_study(epochs=3)
    samples = grid_samples(study, study_task(study), 2)
    samples.joints[:] = 1e30  # its square is beyond single precision
    run.train(study, samples, tmp_path)
    assert pd.read_parquet(tmp_path / "members.parquet").diverged.all()
    assert len(pd.read_parquet(tmp_path / "history.parquet")) == 9


@pytest.mark.parametrize(
    ("network", "training", "engine"),
    [
        ({}, {}, "fused"),
        ({}, {"engine": "reference"}, "reference"),
        ({"activation": "tanh", "hidden": [128, 128]}, {}, "fused"),
        ({"hidden": [512, 512]}, {}, "reference"),
        ({"hidden": [512, 512]}, {"engine": "fused"}, "fused"),
        ({}, {"accelerator": "gpu"}, "reference"),
        ({}, {"optimizer": "levenberg-marquardt"}, "levenberg-marquardt"),
    ],
    ids=str,
)
def test_engine_that_a_study_gets(network, training, engine):
    study = parse_study({"name": "x", "network": network, "training": training})
    assert run.choose_engine(study, 3) == engine


def test_what_the_fused_engine_cannot_do_is_said():
    settings = {"engine": "fused", "optimizer": "levenberg-marquardt"}
    with pytest.raises(IksamplesError, match="engine: fused cannot do"):
        run.choose_engine(make_study(**settings), 3)


def test_a_gpu_that_is_not_there_is_said(tmp_path):
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is one")
    study = make_study(accelerator="gpu")
    with pytest.raises(IksamplesError, match="no CUDA device"):
        run.train(study, grid_samples(study, study_task(study), 2), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_without_a_compiler_the_reference_engine_trains(monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert run.choose_engine(parse_study({"name": "x"}), 3) == "reference"
    with pytest.raises(IksamplesError, match="NUMBA_DISABLE_JIT"):
        run.choose_engine(parse_study({"name": "x", "training": {"engine": "fused"}}), 3)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    assert run.choose_engine(parse_study({"name": "x"}), 3) == "fused"
