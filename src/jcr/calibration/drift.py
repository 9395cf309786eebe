"""Test whether camera or scene moved since a calibration, from new images registered in the old reconstruction.

The equations of old and new gripper poses are combined. A motion of all new images, of the camera on the gripper or of
the scene in the base frame, is tested as an additional effect (estimation/hypotheses.py).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag
from scipy.special import chndtrinc

from jcr.distributions import chi2
from jcr.estimation.hypotheses import Test, confirm_in_equations
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import ROTATION, TRANSLATION, Effect, Problem, State, columns_of_arm, pose_problem
from jcr.estimation.solve import Solution
from jcr.findings import FindingKind
from jcr.geometry import Poses, inverse, retract

ALPHA = 1e-3
"""False-alarm rate: the probability of reporting a motion when nothing has moved."""
CLEAR = 5.0
"""Difference of log p-values from which a motion of the camera is distinguished from one of the scene (150 to 1)."""
KNOWN = 1e9
"""Degrees of freedom for robot errors of known size, with which the F test becomes a χ² test."""
POWER = 0.9
"""Probability of detecting a motion of the size `Drift.detectable`."""
NOISIER = 1.5
"""Ratio of the robot errors of old and new images to those of the old images from which `is_noisier` is set."""
SETTLED, ITERATIONS = 1e-5, 10
"""Largest step (m, rad) at which the iterations end, and largest number of iterations."""

NewPoses = Float[ndarray, "k 4 4"]
Cause = Literal["camera", "scene", "either"]


@dataclass(frozen=True, kw_only=True)
class Drift:
    """Motion of the camera on the gripper since the calibration, its test, and the more likely cause."""

    offset: Float[ndarray, "6"]
    """Step from calibrated to present gripper_from_camera: translation (m), rotation vector (rad); gripper axes."""
    covariance: Float[ndarray, "6 6"]
    """Covariance of `offset`."""
    p_value: float
    """Probability of an offset this large or larger if nothing has moved."""
    cause: Cause
    """Motion that explains the new images better: of the camera on the gripper, or of the scene in the base frame."""
    detectable: tuple[float, float]
    """Translation (m) and rotation (rad), in the worst direction, that the test detects with probability 0.9."""
    is_noisier: bool
    """Whether the estimated robot errors of old and new poses together are much larger than those of the old poses."""


def drift(
    calibrated: Solution,
    old: tuple[Poses, Poses],
    new: tuple[NewPoses, NewPoses, Float[ndarray, "k 6 6"]],
    systematic: Float[ndarray, "s s"],
) -> Drift:
    """Estimate and test the motion of the camera on the gripper between a calibration and new images.

    `calibrated` is the fit to the old poses. `old` holds base_from_gripper (m) and recon_from_camera of the n images of
    the calibration. `new` holds both for the k new images, in the same base and recon frames, and the covariances of
    their camera poses. These are covariances of steps (geometry.retract): translation in recon units, then rotation
    vector (rad), in recon axes.

    `systematic` (s,s), s = 6 (n + k), is the covariance of the systematic errors of old, then new gripper poses. Its
    rows are m and rad in base axes, for an error size of 1 rad.
    """
    gripper, camera = (np.concatenate(pair) for pair in zip(old, new[:2], strict=True))
    first, fit = len(old[0]), calibrated.state
    problem, state = pose_problem(
        gripper,
        camera,
        (fit.x[0], fit.scale, fit.z[0]),
        camera_covariance=np.asarray(block_diag(np.zeros((6 * first, 6 * first)), *new[2])),
        error_covariance=systematic,
        noise_floor=calibrated.noise.given,
    )
    of_camera, of_scene = (
        _motion(problem, state, first, kind) for kind in (FindingKind.SLIP, FindingKind.BASE_MOVED)
    )
    difference = of_camera.log_p - of_scene.log_p
    # A motion of the camera and a motion of the scene both fit a single new image exactly.
    unclear = len(new[0]) == 1 or abs(difference) < CLEAR
    now, then = np.array(of_camera.noise.together), np.array(calibrated.noise.together)
    return Drift(
        offset=of_camera.estimate,
        covariance=of_camera.covariance,
        p_value=float(np.exp(of_camera.log_p)),
        cause="either" if unclear else "camera" if difference < 0 else "scene",
        detectable=detectable(of_camera.covariance),
        is_noisier=bool((now > NOISIER * then).any()),
    )


def _motion(problem: Problem, state: State, first: int, kind: FindingKind) -> Test:
    """Return the test that gripper_from_camera (SLIP) or base_from_recon (BASE_MOVED) changed before image `first`.

    `first` is the index of the first new image. The test contains the estimated change: translation (m) and rotation
    vector (rad), in gripper axes (SLIP) or base axes (BASE_MOVED). The equations are linearized at each estimate until
    it converges.
    """
    (arm,), (x,), (z,), of_x = problem.arms, state.x, state.z, kind is FindingKind.SLIP
    columns, motion = columns_of_arm(0)[:6] if of_x else columns_of_arm(0)[6:], np.zeros(6)
    left = ITERATIONS
    while True:
        # The estimated motion is removed from the new gripper poses, so that they fit the calibrated transforms.
        moved, gripper = retract(x if of_x else z, motion), arm.base_from_gripper.copy()
        gripper[first:] = (
            gripper[first:] @ moved @ inverse(x) if of_x else z @ inverse(moved) @ gripper[first:]
        )
        at = replace(problem, arms=(replace(arm, base_from_gripper=gripper),))
        equations = pose_equations(at, state, None).equations
        by_motion = equations.jacobian[:, columns].copy()
        by_motion[: 6 * first] = 0.0
        whole = replace(equations, residual=equations.residual - by_motion @ motion)
        test = confirm_in_equations(whole, Effect(kind=kind, columns=by_motion, place=first), freedom=KNOWN)
        step, motion, left = test.estimate - motion, test.estimate, left - 1
        if np.abs(step).max() < SETTLED or left == 0:
            return test


def detectable(covariance: Float[ndarray, "6 6"]) -> tuple[float, float]:
    """Return translation (m) and rotation (rad) that a χ² test at level ALPHA detects with probability 0.9.

    `covariance` is that of an estimated motion: translation (m), then rotation vector (rad). The motions to detect have
    its least certain direction.
    """
    length = np.sqrt(chndtrinc(chi2.isf(ALPHA, 6), 6, 1 - POWER))
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])
