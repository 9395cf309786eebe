"""Does a calibration keep what it claims on images that take no part in it?

The images are divided into groups; each group is left out of a calibration of its own, which places the points of the
scene in the base frame. A left-out image then has its camera at two places: where its reported gripper pose and that
calibration put it, and where it sees those points. What it sees at the centre, at the distance of the scene, differs
between the two. The mean square of that must not exceed what the calibration claims for itself and for the robot.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.adjust import adjusted
from jcr.calibration.case import Case, of_images, some_of_many
from jcr.calibration.fit import fitted
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import RobotErrors
from jcr.calibration.seen import seen_in_base
from jcr.camera import unproject
from jcr.distributions import chi2
from jcr.estimation.image_robots import Adjusted
from jcr.geometry import apply, inverse, rotation_angle, rotation_exp, transform
from jcr.live.calibration_progress import LeftOut
from jcr.records import Capture, Reconstruction, Tracks

GROUPS = 3
LEAST = 5
"""Images that a calibration without a group must keep."""
OBSERVATIONS = 150
"""An image, of a calibration without a group."""
LEAST_POINTS = 20
"""That a left-out image must see."""
GATE_PX = 2.0
BY_CHANCE = 0.01
"""Chance that images which are as exact as claimed seem not to be."""


def left_out(
    capture: Capture,
    made: Reconstruction,
    used: Bool[ndarray, " m"],
    robot: RobotErrors,
    options: CalibrateOptions,
) -> LeftOut | None:
    """The used images of a reconstruction, each placed by a calibration without it; None of too few images.

    `robot` is of the registered images.
    """
    rows = np.flatnonzero(used)
    if len(rows) * (GROUPS - 1) // GROUPS < LEAST:
        return None
    made = replace(made, tracks=some_of_many(made.tracks, OBSERVATIONS * len(made.image_index)))
    squares = []
    for group in range(GROUPS):
        out = rows[group::GROUPS]
        rest = np.setdiff1d(rows, out)
        case = adjusted(fitted(capture, _of_rows(made, rest), options, robot.of(rest)))
        if not case.hand_eye.converged or case.adjusted is None:
            return None
        for row in out:
            by_robot = capture.base_from_gripper[made.image_index[row]] @ case.hand_eye.gripper_from_camera
            by_images = _seen_from(case, case.adjusted, made.tracks.only(made.tracks.image == row))
            if by_images is not None:
                squares.append(_squares(case, by_robot, by_images))
    if len(squares) < len(rows) / 2:
        return None
    metres, radians, expected_m, expected_rad = np.sqrt(np.mean(squares, axis=0))
    # Both have three components an image; a pose's errors in them are independent of those of others.
    freedom = 3 * len(squares)
    most = float(np.sqrt(chi2.isf(BY_CHANCE, freedom) / freedom))
    return LeftOut(
        images=len(squares),
        translation_mm=1e3 * float(metres),
        rotation_deg=float(np.degrees(radians)),
        expected_mm=1e3 * float(expected_m),
        expected_deg=float(np.degrees(expected_rad)),
        agree=bool(metres <= most * expected_m and radians <= most * expected_rad),
    )


def _of_rows(made: Reconstruction, rows: Int[ndarray, " k"]) -> Reconstruction:
    kept = np.isin(np.arange(len(made.image_index)), rows)
    return replace(
        made,
        image_index=made.image_index[kept],
        recon_from_camera=made.recon_from_camera[kept],
        tracks=of_images(made.tracks, kept),
    )


def _seen_from(case: Case, found: Adjusted, seen: Tracks) -> Float[ndarray, "4 4"] | None:
    """base_from_camera of an image by the points that the calibration placed; None of too few of them."""
    intrinsics, placed = found.placed.scene.cameras[0], found.placed
    points = apply(placed.z[0], placed.scale * placed.scene.points_in_world)
    known = found.given.evidence.problem.points
    seen = seen.only(np.isin(seen.point, known))
    if len(seen.point) < LEAST_POINTS:
        return None
    at, focal = points[np.searchsorted(known, seen.point)], intrinsics.fx
    rays = focal * unproject(intrinsics, seen.x_px)[:, :2]
    pinhole = np.diag([focal, focal, 1.0])
    is_found, rotation, shift, inliers = cv2.solvePnPRansac(
        at, rays, pinhole, None, reprojectionError=GATE_PX, flags=cv2.SOLVEPNP_SQPNP
    )
    if not is_found or inliers is None or len(inliers) < LEAST_POINTS:
        return None
    some = np.asarray(inliers[:, 0], dtype=int)
    rotation, shift = cv2.solvePnPRefineLM(at[some], rays[some], pinhole, None, rotation, shift)
    return inverse(transform(rotation_exp(rotation[:, 0]), shift[:, 0]))


def _squares(
    case: Case, by_robot: Float[ndarray, "4 4"], by_images: Float[ndarray, "4 4"]
) -> tuple[float, float, float, float]:
    """Squares of the distance (m) and the angle (rad) between two places of a camera, and what is expected of both."""
    found = case.hand_eye
    intrinsics, distance = found.intrinsics or case.reconstruction.intrinsics, case.scene_distance_m
    assert distance is not None
    centre = np.array([intrinsics.cx, intrinsics.cy])
    ray = unproject(intrinsics, centre)
    point = distance * ray / np.linalg.norm(ray)
    away = apply(by_robot, point) - apply(by_images, point)
    angle = float(rotation_angle(by_robot[:3, :3].T @ by_images[:3, :3]))
    base_from_gripper = by_robot @ inverse(found.gripper_from_camera)
    expected = seen_in_base(found, intrinsics, centre, distance, base_from_gripper)
    # The points are placed in the base about as exactly as the camera on the gripper: it counts twice.
    square_m = float(np.trace(expected.together + expected.calibration))
    rotation = found.robot_noise.together[1]
    square_rad = 3 * rotation**2 + 2 * float(np.trace(found.covariance[3:6, 3:6]))
    return float(away @ away), angle**2, square_m, square_rad
