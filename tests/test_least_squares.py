"""The damped robust Gauss-Newton and the distributions, against SciPy's."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from threadpoolctl import threadpool_info, threadpool_limits

from jcr.calibration import hand_eye
from jcr.distributions import chi2
from jcr.distributions import f as f_distribution
from jcr.geometry import apply, retract, rotation_exp, skew, step_between, transform
from jcr.least_squares import minimise
from simulation.problems import hand_eye_problem

TIME = np.linspace(0, 4, 60)


def curve(p):
    """A decaying oscillation, whose parameters are badly scaled and far from linear."""
    return p[0] * np.exp(-p[1] * TIME) * np.cos(p[2] * TIME) + 100 * p[3]


def linearised(observed):
    def at(p):
        decayed = np.exp(-p[1] * TIME)
        wave, slope = np.cos(p[2] * TIME), -np.sin(p[2] * TIME)
        columns = (
            decayed * wave, -TIME * p[0] * decayed * wave, TIME * p[0] * decayed * slope, np.full(60, 100.0),
        )  # fmt: skip
        return (curve(p) - observed)[:, None], np.stack(columns, axis=1)[:, None]

    return at


def plus(p, step):
    return p + step


@pytest.fixture
def observed():
    rng = np.random.default_rng(0)
    noisy = curve(np.array([3.0, 0.4, 2.5, 0.01])) + 0.1 * rng.normal(size=60)
    noisy[::9] += 5.0
    return noisy


@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_the_minimum_is_scipys(loss, observed):
    start = np.array([2.0, 0.2, 2.2, 0.0])
    expected = least_squares(
        lambda p: curve(p) - observed, start, loss=loss, x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-12
    )
    found = minimise(linearised(observed), start, plus, loss)
    assert found.settled
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    np.testing.assert_allclose(found.unknowns, expected.x, rtol=1e-5)
    if loss == "linear":
        np.testing.assert_allclose(found.normal, expected.jac.T @ expected.jac, rtol=1e-4, atol=1e-2)


def test_steps_that_overshoot_are_damped():
    """Rosenbrock's valley: the first undamped step makes the cost seventy times as large."""

    def at(p):
        residual = np.array([[10 * (p[1] - p[0] ** 2)], [1 - p[0]]])
        return residual, np.array([[[-20 * p[0], 10.0]], [[-1.0, 0.0]]])

    found = minimise(at, np.array([-1.2, 1.0]), plus)
    assert found.settled
    np.testing.assert_allclose(found.unknowns, [1.0, 1.0], atol=1e-9)


def test_losses_tame_whole_residuals_not_their_components():
    """A pose from points, some of them metres off: the loss sees three components as one length."""
    rng = np.random.default_rng(1)
    true = transform(rotation_exp(np.array([0.3, -2.0, 1.0])), np.array([1.0, 2.0, 3.0]))
    x = rng.normal(size=(40, 3))
    seen = apply(true, x) + 1e-3 * rng.normal(size=(40, 3))
    seen[:8] += rng.normal(size=(8, 3)) * 3

    def at(pose):
        arm = x @ pose[:3, :3].T
        jacobian = np.zeros((40, 3, 6))
        jacobian[:, :, :3] = np.eye(3)
        jacobian[:, :, 3:] = -skew(arm)
        return (arm + pose[:3, 3] - seen) / 1e-2, jacobian / 1e-2

    found = minimise(at, np.eye(4), retract, "cauchy")
    assert np.abs(step_between(found.unknowns, true)).max() < 1e-3
    length = np.linalg.norm(at(found.unknowns)[0], axis=1)
    assert found.cost == pytest.approx(0.5 * np.log1p(length**2).sum())


def test_small_systems_are_solved_by_one_blas_thread(monkeypatch: pytest.MonkeyPatch):
    """With two, and other work on the machine, a calibration took minutes and not seconds."""
    seen: list[int] = []

    def look(*arguments: object, **options: object) -> None:
        seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        raise InterruptedError

    monkeypatch.setattr(hand_eye, "robust_fit", look)
    problem = hand_eye_problem(np.random.default_rng(0), 6)
    with threadpool_limits(2, user_api="blas"), pytest.raises(InterruptedError):
        hand_eye.solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    assert seen and set(seen) == {1}


@pytest.mark.parametrize("name", ["cdf", "sf", "ppf", "isf"])
def test_chi_squared_is_that_of_scipy(name: str) -> None:
    x = np.array([0.0, 0.05, 0.5, 0.95]) if name in ("ppf", "isf") else np.array([0.0, 0.3, 6.0, 300.0])
    for freedom in (1.0, 6.0, 40.0):
        np.testing.assert_allclose(
            getattr(chi2, name)(x, freedom), getattr(stats.chi2, name)(x, freedom), rtol=1e-10
        )


def test_the_tail_of_f_is_that_of_scipy_down_to_nothing() -> None:
    x = np.array([0.0, 1.0, 30.0, 1e3])
    np.testing.assert_allclose(f_distribution.logsf(x, 3, 200), stats.f.logsf(x, 3, 200), rtol=1e-8)
    # Beyond the smallest number the logarithm stays finite and keeps its order.
    values = f_distribution.logsf(np.array([1e5, 1e7, 1e9]), 3, 200)
    assert np.isfinite(values).all() and (np.diff(values) < 0).all()
