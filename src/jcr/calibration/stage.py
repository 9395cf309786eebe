"""The calibration of a capture: fit, adjust, checks, verdict, requirement."""

from dataclasses import replace

import numpy as np

from jcr.calibration.adjust import adjusted
from jcr.calibration.case import Case
from jcr.calibration.checks.table import CHECKS
from jcr.calibration.fit import fitted
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.requirement import advised, assumptions_of
from jcr.calibration.robot_errors import RobotErrors, robot_errors
from jcr.calibration.verdict import with_checked
from jcr.estimation.point_uncertainty import with_given_intrinsics
from jcr.least_squares import one_blas_thread
from jcr.records import Capture, HandEye, Reconstruction


@one_blas_thread
def calibrate(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions | None = None
) -> HandEye:
    """Hand-eye calibration of the registered images; per-pose fields are in the reconstruction's order.

    Camera poses that come with their covariance are weighed with it, and that is all. Else bundle adjustment
    follows on correspondences found in the images; on those between pointmaps, whose errors neighbours share,
    its result stands only where its leave-one-out error is smaller. Raises InputError for options that cannot be, and
    RejectedError with fewer than two registered images.
    """
    check_options(options := options or CalibrateOptions())
    robot = robot_errors(capture, options).of(reconstruction.image_index)
    case = checked(capture, reconstruction, options, robot)
    hand_eye = advised(
        case.hand_eye, case.base_from_gripper, options, robot, assumptions_of(case), case.scene_uncertainty
    )
    if capture.intrinsics is None or (distance_m := case.scene_distance_m) is None:
        return hand_eye
    pair = with_given_intrinsics(hand_eye.estimate, reconstruction.intrinsics, distance_m)
    return replace(hand_eye, with_given_intrinsics=pair)


@one_blas_thread
def checked(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrors
) -> Case:
    """The same without advice: fit, adjustment, and what the checks found. `robot` is of the registered images."""
    case = adjusted(fitted(capture, reconstruction, options, robot))
    for check in CHECKS:
        if check.needs(case):
            try:
                case = with_checked(case, check.run(case))
            except np.linalg.LinAlgError:
                # A rejected fit may be so wrong, points behind the cameras, that there is nothing to compute.
                if case.hand_eye.converged:
                    raise
    return case
