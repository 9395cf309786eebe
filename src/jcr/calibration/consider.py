"""Effect of errors of given intrinsics on a calibration from camera poses alone, which cannot estimate them.

The estimate is kept and its covariance becomes C + S Φ Sᵀ, with Φ that of the intrinsics (the consider covariance of
Schmidt; Tapley, Schutz and Born, "Statistical Orbit Determination", 2004, chapter 6).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import by_parameters, by_point
from jcr.estimation.closed_form import initial_estimate
from jcr.estimation.intrinsics_prior import Camera
from jcr.estimation.problem import LinearPrior
from jcr.estimation.solve import solve
from jcr.estimation.wrist import pose_problem
from jcr.geometry import apply, inverse, rotation_exp, skew, step_between, transform
from jcr.records import HandEye, Tracks

FEWEST = 6
"""Fewest observations of an image from which the motion of its camera with the intrinsics is computed."""


def with_intrinsics_considered(
    hand_eye: HandEye,
    base_from_gripper: Float[ndarray, "m 4 4"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    tracks: Tracks,
    camera: Camera,
    priors: tuple[LinearPrior, ...],
    systematic: Float[ndarray, "s s"],
) -> HandEye:
    """Return the calibration with the errors of its intrinsics in its covariance and budget.

    All arguments are of the used images. The sensitivity S follows from solutions with the cameras that one standard
    deviation of each parameter would give: cameras that keep the pixels of `tracks` in place.
    """
    seen = [np.flatnonzero(tracks.image == row) for row in range(len(recon_from_camera))]
    if hand_eye.budget is None or min(map(len, seen)) < FEWEST:
        return hand_eye
    each = zip(recon_from_camera, seen, strict=True)
    moved = np.array([_camera_with_other_intrinsics(one, tracks, rows, camera) for one, rows in each])

    def solved(recon_from_camera: Float[ndarray, "m 4 4"]) -> tuple[Float[ndarray, "4 4"], float]:
        problem, state = pose_problem(
            base_from_gripper,
            recon_from_camera,
            initial_estimate(base_from_gripper, recon_from_camera),
            error_covariance=systematic,
            noise_floor=hand_eye.robot_noise.given,
            priors=priors,
        )
        found = solve(problem, state, averaged=False).state
        return found.x[0], found.scale

    x, scale = solved(recon_from_camera)
    shifts = np.zeros((7, len(camera.std)))
    for k in range(len(camera.std)):
        x_k, scale_k = solved(moved[:, k])
        shifts[:, k] = np.append(step_between(x, x_k), np.log(scale_k / scale))
    considered = shifts @ shifts.T
    return replace(
        hand_eye,
        covariance=hand_eye.covariance + considered,
        budget=replace(hand_eye.budget, intrinsics=hand_eye.budget.intrinsics + considered),
    )


def _camera_with_other_intrinsics(
    recon_from_camera: Float[ndarray, "4 4"],
    tracks: Tracks,
    rows: ndarray,
    camera: Camera,
) -> Float[ndarray, "c 4 4"]:
    """Return the camera poses that fit the image's points after one standard deviation more of each parameter."""
    x_in_camera = apply(inverse(recon_from_camera), tracks.points_in_recon[tracks.point[rows]].astype(float))
    by_x = by_point(camera.intrinsics, x_in_camera)
    by_pose = np.concatenate([by_x, -by_x @ skew(x_in_camera)], axis=2).reshape(-1, 6)
    by_intrinsics = by_parameters(camera.intrinsics, x_in_camera) @ (camera.directions * camera.std)
    steps = -np.linalg.lstsq(by_pose, by_intrinsics.reshape(len(by_pose), -1), rcond=None)[0].T
    return recon_from_camera @ inverse(transform(rotation_exp(steps[:, 3:]), steps[:, :3]))
