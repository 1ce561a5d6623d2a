"""Which poses to record and when to stop: against closed forms, all choices, and many arms."""

from itertools import combinations, product

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, chi2, f
from typer.testing import CliRunner

from iksamples.arm.inverse import followed
from iksamples.arm.load import load_arm
from iksamples.arm.real import deviated
from iksamples.calibration.design import in_points, optimal, postures, tour
from iksamples.calibration.fit import fit_arm
from iksamples.calibration.known import Fitted, Prior
from iksamples.calibration.rounds import next_round
from iksamples.calibration.worst import Measured, judged_effects, worst_mm
from iksamples.cli import app
from iksamples.errors import IksamplesError
from iksamples.recorded.poses import Calibration
from iksamples.recorded.read import read_recording
from iksamples.region import Region
from iksamples.samples.record import record_samples, region_points
from iksamples.study import parse_study


PRIOR = Prior()
SD = PRIOR.deviations(3)


def arm_of(chain, seed, scale=1.0):
    return deviated(chain, scale * SD * np.random.default_rng([seed, 1]).normal(size=SD.shape))


def measured(arm, q, noise_mm, seed):
    return arm.forward_mm(q) + noise_mm * np.random.default_rng([seed, 2]).normal(size=(len(q), 3))


def test_the_worst_error_of_one_point_is_a_quantile_that_is_known(chain):
    judged = np.zeros((1, 3, 24))
    judged[0, :, :3] = np.eye(3)
    known = Fitted.unmeasured(chain, Prior(displacement_mm=2.0), 0.1)
    exact = 2 * np.sqrt(chi2.ppf(0.95, 3))
    assert worst_mm(known, judged, 0.95, 20_000) == pytest.approx(exact, rel=0.02)
    # Where the noise is estimated, Hotelling's.
    guessed = Fitted(chain, 0 * SD, known.root, 0.1, 6.0, np.empty((0, 3)), noise_estimated=True)
    exact = 2 * np.sqrt(3 * f.ppf(0.95, 3, 6))
    assert worst_mm(guessed, judged, 0.95, 20_000) == pytest.approx(exact, rel=0.04)
    assert worst_mm(Fitted.unmeasured(chain, PRIOR, None), judged) == np.inf
    assert Fitted.unmeasured(chain, PRIOR, 0.0).noise_mm == 0


def test_what_is_expected_of_poses_is_what_the_fit_then_knows(chain, rng):
    q = rng.uniform(chain.lower, chain.upper, (7, 3))
    before = Fitted.unmeasured(chain, PRIOR, 0.2)
    expected = before.expecting(Measured(0.2).informs(before, q))
    fitted = fit_arm(chain, q, chain.forward_mm(q), prior=PRIOR, noise_mm=0.2)
    np.testing.assert_allclose(expected.covariance, fitted.covariance, atol=1e-9)
    assert expected.freedom == pytest.approx(fitted.freedom)
    turned = Measured(0.2, 1e-3, orientation="fixed").informs(before, q)
    poses = fit_arm(
        chain, q, chain.forward_mm(q), prior=PRIOR, noise_mm=0.2,
        measured_rotation=chain.rotation(q), noise_rad=1e-3,
    )  # fmt: skip
    np.testing.assert_allclose(before.expecting(turned).covariance, poses.covariance, atol=1e-9)


def test_chosen_poses_are_about_the_best_of_all(task, study, rng):
    chain = task.drawing
    before = Fitted.unmeasured(chain, PRIOR, 0.1)
    informs = Measured(0.1).informs(before, rng.uniform(chain.lower, chain.upper, (14, 3)))
    joints = task.reach(region_points(task.region, 30)).joints
    judged = judged_effects(task.target, study.tolerance, before, joints)

    def volume(chosen):
        return np.linalg.slogdet(before.expecting(informs[list(chosen)]).covariance)[1]

    def variance(chosen):
        moved = judged @ before.expecting(informs[list(chosen)]).root
        return np.max(np.sum(moved**2, axis=(1, 2)))

    for of, poses in ((volume, optimal(before, informs, 4)),
                      (variance, optimal(before, informs, 4, judged))):  # fmt: skip
        every = np.sort([of(some) for some in combinations(range(14), 4)])
        assert len(set(poses)) == 4
        # Among the best hundredth of all 1001 choices.
        assert of(poses) <= every[10]
    with pytest.raises(IksamplesError, match="15 poses out of 14"):
        optimal(before, informs, 15)


def test_chosen_postures_of_points_are_about_the_best_of_all(chain, rng):
    before = Fitted.unmeasured(chain, PRIOR, 0.1)
    informs, counts = [rng.normal(size=(6, 3, 24)) * 3 / SD.ravel() for _ in range(2)], [3, 2]

    def information(chosen):
        # The points' places beside the deviations, then taken out: Schur's complement.
        rows = np.vstack(
            [
                np.hstack([own[i], np.kron(np.arange(2) == point, -np.eye(3))])
                for point, (own, some) in enumerate(zip(informs, chosen, strict=True))
                for i in some
            ]
        )
        whole = rows.T @ rows + np.diag(np.append(1 / SD.ravel() ** 2, np.zeros(6)))
        a, b, c = whole[:24, :24], whole[:24, 24:], whole[24:, 24:]
        return np.linalg.slogdet(a - b @ np.linalg.solve(c, b.T))[1]

    ways = [list(combinations(range(6), k)) for k in counts]
    every = np.sort([information(chosen) for chosen in product(*ways)])
    chosen = in_points(before, informs, counts)
    assert [len(set(some)) for some in chosen] == counts
    # Among the best hundredth of all 300 choices, and no exchange makes it better.
    assert information(chosen) >= every[-3]


def test_postures_are_inside_the_limits_and_have_the_tool_there():
    panda = load_arm("config/robots/panda.urdf")
    region = Region.box([300, -100, 300], [500, 100, 500])
    places = region_points(region, 100)
    q = postures(panda, 200, np.random.default_rng(0), places_mm=places)
    assert q.shape == (200, 7)
    assert panda.within_limits(q).all()
    assert region.contains(np.round(panda.forward_mm(q), 5)).all()
    # All over the joint space: not near one posture.
    assert np.ptp(q, axis=0).min() > 1.5
    with pytest.raises(IksamplesError, match="only 0 have the tool there"):
        postures(panda, 4, np.random.default_rng(0), places_mm=np.full((1, 3), 5e3))


@pytest.mark.slow
def test_no_posture_is_much_worse_than_those_that_are_judged():
    study = parse_study({"name": "s", "robot": {"urdf": "config/robots/panda.urdf"}})
    asked = Calibration.of(study, None)
    before = asked.fitted(None)
    q = postures(asked.drawing, 12, np.random.default_rng(7))
    known = before.expecting(Measured(0.1).informs(before, q))
    generator = np.random.default_rng(8)
    many = generator.uniform(asked.drawing.lower, asked.drawing.upper, (40_000, 7))
    effects = judged_effects(asked.target, asked.tolerance, known, many)
    order = np.argsort(-np.sum((effects @ known.root) ** 2, axis=(1, 2)))
    worst = worst_mm(known, effects[order[:1000]], draws=1000)
    assert worst_mm(known, asked.judged(known), draws=1000) > 0.93 * worst


def test_a_tour_is_short(rng):
    line = rng.permutation(20)
    order = tour(line[:, None].astype(float), np.array([-1.0]))
    assert line[order].tolist() == list(range(20))
    q = rng.uniform(size=(40, 3))

    def length(some):
        return np.linalg.norm(np.diff(np.vstack([np.zeros(3), q[some]]), axis=0), axis=1).sum()

    order = tour(q, np.zeros(3))
    assert sorted(order) == list(range(40))
    assert length(order) < 0.5 * length(np.arange(40))


@pytest.mark.slow
@pytest.mark.parametrize(("noise_known", "scale"), [(True, 1.0), (False, 1.0), (True, 2.0)])
def test_stopping_keeps_the_tolerance_and_takes_few_rounds(study, task, noise_known, scale):
    """Rounds on arms as far off as is expected, and twice as far."""
    chain, arms, noise_mm, limit_mm = task.drawing, 60, 0.1, 0.6
    at = task.reach(region_points(task.region, 60))
    q = postures(chain, 150, np.random.default_rng(0), places_mm=region_points(task.region, 200))
    missed, rounds, n = [], [], []
    for seed in range(arms):
        arm, own = arm_of(chain, seed, scale), np.empty((0, 3))
        x, fitted = own, Fitted.unmeasured(chain, PRIOR, noise_mm if noise_known else None)
        for done in range(6):
            judged = judged_effects(task.target, study.tolerance, fitted, at.joints)
            informs = Measured(fitted.noise_mm).informs(fitted, q)
            advice = next_round(fitted, informs, judged, limit_mm)
            if advice.stop:
                break
            more = q[advice.chosen]
            own = np.concatenate([own, more])
            x = np.concatenate([x, measured(arm, more, noise_mm, seed + 1000 * done)])
            fitted = fit_arm(chain, own, x, prior=PRIOR, noise_mm=noise_mm if noise_known else None)
        assert advice.stop
        off = arm.forward_mm(followed(at, fitted.chain)) - at.x
        missed.append(np.nanmax(np.linalg.norm(off, axis=1)) > limit_mm)
        rounds.append(done)
        n.append(len(own))
    # No more than five in a hundred miss it, or else this many of 60 are one in a thousand.
    assert np.sum(missed) <= binom.ppf(0.999, arms, 0.05)
    assert np.quantile(rounds, 0.95) <= 3
    assert np.median(n) <= 10


def test_optimal_samples_tell_more_than_random_ones(study, task):
    fitted = Fitted.unmeasured(task.drawing, PRIOR, 0.1)
    judged = judged_effects(
        task.target, study.tolerance, fitted, task.reach(region_points(task.region, 30)).joints
    )

    def left(design, n=6):
        samples = record_samples(study, task, design, n)
        assert samples.n_samples == n
        assert task.region.contains(samples.x).all()
        return worst_mm(fitted.expecting(Measured(0.1).informs(fitted, samples.joints)), judged)

    assert left("optimal") < 0.6 * left("uniform")
    again = record_samples(study, task, "optimal", 6)
    np.testing.assert_array_equal(again.x, record_samples(study, task, "optimal", 6).x)


def asked(*arguments):
    return CliRunner().invoke(app, ["next", *map(str, arguments)])


@pytest.mark.slow
def test_the_command_proposes_poses_until_they_are_enough(tmp_path):
    """An owner's way: no samples, then what was proposed and measured, then to stop."""
    robot, poses, samples = "config/robots/rrr70.urdf", tmp_path / "next.csv", tmp_path / "had.csv"
    options = ["--robot", robot, "--box", 20, 20, 0, 80, 80, 60, "--tolerance-mm", 1, "-o", poses]
    first = asked(*options, "--noise-mm", 0.05)
    assert first.exit_code == 0, first.output
    chain = load_arm(robot)
    arm = arm_of(chain, 3)
    table = pd.read_csv(poses)
    joints = [f"q_{name}_rad" for name in chain.joint_names]
    assert list(table)[:4] == ["pose", "x_mm", "y_mm", "z_mm"]
    q = table[joints].to_numpy()
    assert chain.within_limits(q).all()
    np.testing.assert_allclose(table[["x_mm", "y_mm", "z_mm"]], chain.forward_mm(q), atol=1e-3)
    table[["x_mm", "y_mm", "z_mm"]] = measured(arm, q, 0.05, 0)
    table.to_csv(samples, index=False)
    for _ in range(3):
        poses.unlink(missing_ok=True)
        then = asked(*options, "--noise-mm", 0.05, "--samples", samples)
        assert then.exit_code == 0, then.output
        if not poses.exists():
            break
        more = pd.read_csv(poses)
        more[["x_mm", "y_mm", "z_mm"]] = measured(arm, more[joints].to_numpy(), 0.05, 1)
        table = pd.concat([table, more])
        table.to_csv(samples, index=False)
    assert "Stop: it is within 1 mm" in then.output
    assert len(table) < 10
    more = asked(*options, "--samples", samples, "--count", 2)
    assert more.exit_code == 0, more.output
    assert len(pd.read_csv(poses)) == 2


def test_a_study_asks_the_same_with_what_it_expects(tmp_path):
    poses = tmp_path / "next.csv"
    found = asked("config/studies/real-arm.yaml", "--strategy", "calibration", "-o", poses)
    assert found.exit_code == 0, found.output
    assert 2 <= len(pd.read_csv(poses)) <= 6


@pytest.mark.parametrize("name", ["rrr70", "panda", "ur5e", "scara"])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_poses_are_read_though_they_lie_near_each_other(tmp_path, name, n):
    """Their spread says nothing then, and of one pose it is zero."""
    chain = load_arm(f"config/robots/{name}.urdf")
    middle = (chain.lower + chain.upper) / 2
    for seed in range(10):
        rng = np.random.default_rng(seed)
        q = middle + 0.2 + 0.05 * rng.normal(size=(n, chain.n_joints))
        arm = deviated(chain, rng.normal(size=(chain.n_joints + 1, 6)) * np.repeat([1, 0.01], 3))
        table = pd.DataFrame(arm.forward_mm(q), columns=["x_mm", "y_mm", "z_mm"])
        table[[f"q{i}_{unit}" for i, unit in enumerate(chain.joint_units, 1)]] = q
        table.to_csv(tmp_path / "had.csv", index=False)
        found = read_recording(tmp_path / "had.csv", chain, fewest=1)
        np.testing.assert_allclose(found.joints, q)
        table[["x_mm", "y_mm", "z_mm"]] /= 1000
        table.to_csv(tmp_path / "had.csv", index=False)
        with pytest.raises(IksamplesError, match="the joint values do not reach"):
            read_recording(tmp_path / "had.csv", chain, fewest=1)


def test_poses_too_few_to_tell_the_noise_promise_no_error(tmp_path):
    options = ["--robot", "config/robots/rrr70.urdf", "--tolerance-mm", 1, "--count", 1]
    found = asked(*options, "-o", tmp_path / "next.csv")
    assert found.exit_code == 0, found.output
    assert "inf mm" not in found.output
    assert "too few to tell how well was measured" in found.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name a study"),
        (["config/studies/real-arm.yaml"], "--samples: name the samples"),
        (["--robot", "config/robots/rrr70.urdf", "--strategy", "worst"], "asks networks"),
        (["--robot", "config/robots/rrr70.urdf", "--tolerance-mm", -1], "error_mm"),
        (["--robot", "config/robots/rrr70.urdf", "--noise-mm", -1], "--noise-mm has to be"),
        (["--robot", "config/robots/rrr70.urdf", "--deviation-mm", 0], "has to be above zero"),
        (["--robot", "config/robots/rrr70.urdf", "--box", 1, 1, 1, 0, 2, 2], "empty"),
        (["--robot", "no.urdf"], "no.urdf: cannot read"),
        (["--robot", "config/robots/rrr70.urdf", "--weights", "w"], "--weights: of no use"),
        (
            ["config/config.yaml", "--samples", "x.csv", "--column", "x_mm=a", "--tolerance-mm", 1],
            "--tolerance-mm: of no use",
        ),
        (
            ["config/studies/real-arm.yaml", "--strategy", "calibration", "--tip-link", "tool"],
            "--tip-link: of no use",
        ),
    ],
)
def test_questions_that_cannot_be_asked_are_refused(arguments, message, tmp_path):
    found = asked(*arguments, "-o", tmp_path / "next.csv")
    assert found.exit_code
    assert message in str(found.exception or found.output)
