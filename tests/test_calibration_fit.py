"""A drawing fitted to measurements: against closed forms, and over many arms."""

import numpy as np
import pytest
from scipy.optimize import minimize

from iksamples.arm.load import load_arm
from iksamples.arm.real import deviated, deviated_pose
from iksamples.calibration.fit import Prior, fit_arm, fit_sockets
from iksamples.errors import IksamplesError


PRIOR = Prior()


@pytest.fixture(scope="module")
def panda():
    return load_arm("config/robots/panda.urdf")


def drawn(chain, seed, prior=PRIOR):
    """An arm off its drawing by what the prior says."""
    sd = prior.deviations(chain.n_joints)
    return deviated(chain, np.random.default_rng([seed, 1]).normal(size=sd.shape) * sd)


def postures(chain, n, seed):
    return np.random.default_rng([seed, 2]).uniform(chain.lower, chain.upper, (n, chain.n_joints))


def noise(shape, sd, seed):
    return sd * np.random.default_rng([seed, 3]).normal(size=shape)


def test_a_whole_number_of_millimetres_leaves_turns_as_they_are():
    np.testing.assert_array_equal(Prior(3, 0.01).deviations(2)[0], [3, 3, 3, 0.01, 0.01, 0.01])


def test_without_noise_the_arm_is_found(chain):
    arm, q, fresh = drawn(chain, 1), postures(chain, 20, 1), postures(chain, 50, 2)
    fitted = fit_arm(chain, q, arm.forward_mm(q), prior=PRIOR, noise_mm=0)
    np.testing.assert_allclose(fitted.chain.forward_mm(fresh), arm.forward_mm(fresh), atol=1e-6)


def test_it_is_the_most_probable_arm_and_its_posterior_the_curvature(chain):
    """Against a general minimiser of the same density, written out without the model's code."""
    arm, q = drawn(chain, 2), postures(chain, 5, 2)
    x = arm.forward_mm(q) + noise((5, 3), 0.2, 2)
    sd = PRIOR.deviations(3)

    def minus_log(values):
        off = deviated(chain, values.reshape(4, 6) * sd).forward_mm(q) - x
        return 0.5 * np.sum(off**2) / 0.2**2 + 0.5 * np.sum(values**2)

    best = minimize(minus_log, np.zeros(24), method="BFGS", options={"gtol": 1e-4, "maxiter": 2000})
    fitted = fit_arm(chain, q, x, prior=PRIOR, noise_mm=0.2)
    assert minus_log((fitted.deviations / sd).ravel()) <= best.fun + 1e-6
    np.testing.assert_allclose(fitted.deviations / sd, best.x.reshape(4, 6), atol=2e-3)
    _, _, by, _ = deviated_pose(chain, fitted.deviations, q)
    by = by.reshape(15, 24)
    information = by.T @ by / 0.2**2 + np.diag(sd.ravel() ** -2.0)
    np.testing.assert_allclose(fitted.covariance @ information, np.eye(24), atol=1e-6)
    draws = fitted.draws(20_000, np.random.default_rng(0)).reshape(-1, 24)
    ratio = np.cov(draws.T).diagonal() / fitted.covariance.diagonal()
    np.testing.assert_allclose(ratio, 1, atol=0.05)


def test_coordinates_and_turns_that_were_not_measured_do_not_count(panda):
    arm, q = drawn(panda, 3), postures(panda, 30, 3)
    position, rotation = arm.pose(q)
    spoilt = np.where(np.arange(30)[:, None] < 10, [np.nan, np.nan, np.nan], position)
    spoilt[10, 2] = np.nan
    first = fit_arm(panda, q, spoilt, prior=PRIOR, noise_mm=0.1)
    again = fit_arm(panda, q[10:], spoilt[10:], prior=PRIOR, noise_mm=0.1)
    np.testing.assert_allclose(first.deviations, again.deviations, atol=1e-9)
    assert np.isnan(first.residuals_mm).sum() == 31
    fresh = postures(panda, 50, 4)
    # Positions alone leave the tool's turn open; its axis closes all of it but the turn about it.
    wanted = arm.rotation(fresh)
    poses, axes = (
        fit_arm(
            panda, q, position, prior=PRIOR, noise_mm=0.01, measured_rotation=rotation,
            noise_rad=1e-4, axis_only=axis_only,
        )
        for axis_only in (False, True)
    )  # fmt: skip
    assert np.abs(poses.chain.rotation(fresh) - wanted).max() < 1e-3
    assert np.abs(axes.chain.rotation(fresh) - wanted)[..., 2].max() < 1e-3
    assert np.abs(first.chain.rotation(fresh) - wanted)[..., 2].max() > 2e-3


def test_the_noise_is_estimated(chain):
    found, freedom = [], 0.0
    for seed in range(40):
        arm, q = drawn(chain, seed), postures(chain, 15, seed)
        x = arm.forward_mm(q) + noise((15, 3), 0.3, seed)
        fitted = fit_arm(chain, q, x, prior=PRIOR, noise_mm=None)
        found.append(fitted.noise_mm)
        freedom = fitted.freedom
    # A chi-squared of so many degrees of freedom: its mean over 40 is within four standard errors.
    assert 20 < freedom < 45
    assert np.mean(np.square(found)) / 0.09 == pytest.approx(1, abs=4 * np.sqrt(2 / freedom / 40))
    with pytest.raises(IksamplesError, match="too few to tell how well they were measured"):
        fit_arm(chain, q[:1], x[:1], prior=PRIOR, noise_mm=None)


def test_sockets_find_what_the_points_and_their_distances_tell(panda):
    """Postures with the tool in two points 50 mm apart, that nobody measured."""
    prior = Prior(3.0, 0.01, tool_mm=50.0)
    arm = drawn(panda, 5, prior)
    home = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.5])
    centre = arm.forward_mm(home)
    groups = []
    for i, point in enumerate([centre, centre + np.array([50.0, 0, 0])]):
        q = home + np.random.default_rng([5, i]).uniform(-0.5, 0.5, (60, 7))
        for _ in range(60):  # nearest joints with the tool in the point
            off = point - arm.forward_mm(q)
            q += (np.linalg.pinv(arm.jacobian_mm(q)) @ off[..., None])[..., 0].clip(-0.3, 0.3)
        assert np.abs(arm.forward_mm(q) - point).max() < 1e-9
        groups.append(q)
    fitted = fit_sockets(panda, groups, [(0, 1, 50.0)], prior=prior, noise_mm=0.01)
    assert np.abs(fitted.residuals_mm).max() < 0.05
    assert np.linalg.norm(np.subtract(*fitted.centres_mm)) == pytest.approx(50, abs=0.1)
    # Elsewhere it is the arm but for a rigid motion of everything: distances between poses are.
    fresh = home + np.random.default_rng(7).uniform(-0.4, 0.4, (40, 7))

    def lengths(chain):
        at = chain.forward_mm(fresh)
        return np.linalg.norm(at[:, None] - at, axis=-1)

    drawn_off = np.abs(lengths(panda) - lengths(arm)).max()
    assert np.abs(lengths(fitted.chain) - lengths(arm)).max() < 0.05 * drawn_off
    with pytest.raises(IksamplesError, match="fewer than two postures"):
        fit_sockets(panda, [groups[0], groups[1][:1]], prior=prior, noise_mm=0.1)


def test_what_cannot_be_fitted_is_said(chain):
    q, x = np.zeros((2, 3)), np.zeros((2, 3))
    with pytest.raises(IksamplesError, match=r"positions of shape \(1, 3\)"):
        fit_arm(chain, q, x[:1], prior=PRIOR, noise_mm=0.1)
    with pytest.raises(IksamplesError, match="give 3 finite ones for each pose"):
        fit_arm(chain, q[:, :2], x, prior=PRIOR, noise_mm=0.1)
    with pytest.raises(IksamplesError, match="give 3 finite ones for each pose"):
        fit_arm(chain, q + np.nan, x, prior=PRIOR, noise_mm=0.1)
    with pytest.raises(IksamplesError, match="noise, -1 mm"):
        fit_arm(chain, q, x, prior=PRIOR, noise_mm=-1)
    with pytest.raises(IksamplesError, match="noise_rad"):
        fit_arm(chain, q, x, prior=PRIOR, noise_mm=1, measured_rotation=np.eye(3)[None])
    with pytest.raises(IksamplesError, match="above zero"):
        Prior(displacement_mm=0)
