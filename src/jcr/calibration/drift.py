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
from scipy.optimize import root_scalar
from scipy.stats import chi2, ncx2

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
SETTLED = 1e-5
"""Step (m, rad) that ends the iterations."""

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
    problem, _ = pose_problem(
        gripper,
        camera,
        (calibrated.state.x[0], calibrated.state.scale, calibrated.state.z[0]),
        camera_covariance=np.asarray(block_diag(np.zeros((6 * len(old[0]),) * 2), *new[2])),
        error_covariance=systematic,
        noise_floor=calibrated.noise.given,
    )
    of_camera = _motion(problem, calibrated, len(old[0]), FindingKind.SLIP)
    of_scene = _motion(problem, calibrated, len(old[0]), FindingKind.BASE_MOVED)
    difference = of_camera.log_p - of_scene.log_p
    # Either motion fits one image exactly.
    unclear = len(new[0]) == 1 or abs(difference) < CLEAR
    return Drift(
        offset=of_camera.estimate,
        covariance=of_camera.covariance,
        p_value=float(np.exp(of_camera.log_p)),
        cause="either" if unclear else "camera" if difference < 0 else "scene",
        detectable=detectable(of_camera.covariance, alpha),
        is_noisier=any(
            now > NOISIER * then
            for now, then in zip(of_camera.noise.together, calibrated.noise.together, strict=True)
        ),
    )


def _motion(problem: Problem, calibrated: Solution, first: int, kind: FindingKind) -> Test:
    """Return the test of a motion of X or Z from image `first` on, linear about the motion that it estimates."""
    assert problem.known_rigs is not None
    arm, cameras = problem.arms[0], problem.known_rigs.world_from_rig
    x, scale, z = calibrated.state.x[0], calibrated.state.scale, calibrated.state.z[0]
    of_x = kind is FindingKind.SLIP
    columns = columns_of_arm(0)[:6] if of_x else columns_of_arm(0)[6:]
    motion, test = np.zeros(6), None
    for _ in range(10):
        # Reported without the motion, the new gripper poses fit the transforms of the calibration.
        moved = retract(x if of_x else z, motion)
        gripper = arm.base_from_gripper.copy()
        gripper[first:] = (
            gripper[first:] @ moved @ inverse(x) if of_x else z @ inverse(moved) @ gripper[first:]
        )
        at = replace(problem, arms=(replace(arm, base_from_gripper=gripper),))
        state = State(x=x[None], scale=scale, z=z[None], world_from_rig=cameras)
        equations = pose_equations(at, state, None).equations
        by_motion = equations.jacobian[:, columns].copy()
        by_motion[: 6 * first] = 0.0
        whole = replace(equations, residual=equations.residual - by_motion @ motion)
        test = confirm(whole, Row(kind=kind, columns=by_motion, place=first), freedom=KNOWN)
        step, motion = test.estimate - motion, test.estimate
        if np.abs(step).max() < SETTLED:
            break
    assert test is not None
    return test


def detectable(covariance: Float[ndarray, "6 6"], alpha: float) -> tuple[float, float]:
    """Return motions (m) and rotations (rad) in the worst direction that a test at `alpha` finds nine times in ten."""
    least = chi2.isf(alpha, 6)
    found = root_scalar(lambda squared: float(ncx2.sf(least, 6, squared)) - POWER, bracket=(1e-3, 1e3))
    length = np.sqrt(found.root)
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])
