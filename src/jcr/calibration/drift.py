"""Test of a motion since an earlier calibration, from new images that are located in the old reconstruction.

Old and new gripper poses are one problem, and a motion that only the new images have is one row of the common test
(estimation/hypotheses.py): of the camera on the gripper, or of the scene in the base frame.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag
from scipy.special import chndtrinc

from jcr.distributions import chi2
from jcr.estimation.hypotheses import Row, Test, confirm
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import ROTATION, TRANSLATION, Problem, State, columns_of_arm, pose_problem
from jcr.estimation.solve import Solution
from jcr.findings import FindingKind
from jcr.geometry import Poses, inverse, retract

CLEAR = 5.0
"""Difference of log probabilities by which one explanation is preferred to the other (odds of 150 to 1)."""
KNOWN = 1e9
"""Freedom of known sizes of the errors: the test averages over them, and its rate of false alarms is the stated one."""
POWER = 0.9
"""Probability with which a motion of the size `detectable` is found."""
NOISIER = 1.5
"""Factor of the errors of the gripper poses from which new images contradict one another."""
SETTLED, ITERATIONS = 1e-5, 10
"""Step (m, rad) that ends the iterations, and their largest number."""

NewPoses = Float[ndarray, "k 4 4"]
Cause = Literal["camera", "scene", "either"]


@dataclass(frozen=True, kw_only=True)
class Drift:
    """Motion of the camera on the gripper since the calibration, and what explains the images better."""

    offset: Float[ndarray, "6"]
    """Step from the calibrated transform to the one now (m, rad; gripper axes)."""
    covariance: Float[ndarray, "6 6"]
    p_value: float
    """Probability of a motion like this or larger where nothing has moved."""
    cause: Cause
    """Motion that explains the images better: of the camera on the gripper, or of the scene in the base."""
    detectable: tuple[float, float]
    """m, rad: motions in the worst direction that the test at this `alpha` would find nine times in ten."""
    is_noisier: bool
    """Whether old and new gripper poses have much larger errors together than the old ones alone."""


def drift(
    calibrated: Solution,
    old: tuple[Poses, Poses],
    new: tuple[NewPoses, NewPoses, Float[ndarray, "k 6 6"]],
    systematic: Float[ndarray, "s s"],
    alpha: float,
) -> Drift:
    """Return the motion of the camera that new images show.

    `old` holds the gripper poses and cameras of the calibration, `new` those of the new images and the covariance of
    steps of these cameras (geometry.retract, recon axes); `systematic` is the covariance of the systematic errors of old
    and new gripper poses at 1 rad.
    """
    gripper, camera = (np.concatenate(pair) for pair in zip(old, new[:2], strict=True))
    first, state = len(old[0]), calibrated.state
    problem, _ = pose_problem(
        gripper,
        camera,
        (state.x[0], state.scale, state.z[0]),
        camera_covariance=np.asarray(block_diag(np.zeros((6 * first, 6 * first)), *new[2])),
        error_covariance=systematic,
        noise_floor=calibrated.noise.given,
    )
    state = State(x=state.x, scale=state.scale, z=state.z, world_from_rig=camera)
    of_camera, of_scene = (
        _motion(problem, state, first, kind) for kind in (FindingKind.SLIP, FindingKind.BASE_MOVED)
    )
    difference = of_camera.log_p - of_scene.log_p
    # Either motion fits one image exactly.
    unclear = len(new[0]) == 1 or abs(difference) < CLEAR
    now, then = np.array(of_camera.noise.together), np.array(calibrated.noise.together)
    return Drift(
        offset=of_camera.estimate,
        covariance=of_camera.covariance,
        p_value=float(np.exp(of_camera.log_p)),
        cause="either" if unclear else "camera" if difference < 0 else "scene",
        detectable=detectable(of_camera.covariance, alpha),
        is_noisier=bool((now > NOISIER * then).any()),
    )


def _motion(problem: Problem, state: State, first: int, kind: FindingKind) -> Test:
    """Return the test of a motion of X or Z from image `first` on, linear about the motion that it estimates."""
    (arm,), (x,), (z,), of_x = problem.arms, state.x, state.z, kind is FindingKind.SLIP
    columns, motion = columns_of_arm(0)[:6] if of_x else columns_of_arm(0)[6:], np.zeros(6)
    left = ITERATIONS
    while True:
        # Reported without the motion, the new gripper poses fit the transforms of the calibration.
        moved, gripper = retract(x if of_x else z, motion), arm.base_from_gripper.copy()
        gripper[first:] = (
            gripper[first:] @ moved @ inverse(x) if of_x else z @ inverse(moved) @ gripper[first:]
        )
        at = replace(problem, arms=(replace(arm, base_from_gripper=gripper),))
        equations = pose_equations(at, state, None).equations
        by_motion = equations.jacobian[:, columns].copy()
        by_motion[: 6 * first] = 0.0
        whole = replace(equations, residual=equations.residual - by_motion @ motion)
        test = confirm(whole, Row(kind=kind, columns=by_motion, place=first), freedom=KNOWN)
        step, motion, left = test.estimate - motion, test.estimate, left - 1
        if np.abs(step).max() < SETTLED or left == 0:
            return test


def detectable(covariance: Float[ndarray, "6 6"], alpha: float) -> tuple[float, float]:
    """Return motions (m) and rotations (rad) in the worst direction that a test at `alpha` finds nine times in ten."""
    length = np.sqrt(chndtrinc(chi2.isf(alpha, 6), 6, 1 - POWER))
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])
