"""Global alignment: pairwise pointmaps of a set of images become one reconstruction, alone or with the robot's poses."""

import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.extras import extra
from jcr.geometry import inverse, skew
from jcr.progress import Progress
from jcr.reconstruct.global_alignment.alignment import Alignment, AlignOptions, check_connected, check_options
from jcr.reconstruct.global_alignment.gauss_newton import (
    Problem,
    Solution,
    align_fast,
    dense_alignment,
    solve_free,
)
from jcr.reconstruct.global_alignment.kinematic import contradictions, rescaled, solve_kinematic
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.records import CameraEvidence


def align(
    predictions: PairPredictions, options: AlignOptions | None = None, progress: Progress | None = None
) -> Alignment:
    """Minimise eq. 1 of the paper's section III over cameras, depths, focal lengths and pair scales.

    Raises InputError for images that no chain of pairs joins, and for options the predictions cannot serve.
    """
    options = options or AlignOptions()
    check_options(options)
    check_connected(predictions)
    if options.method == "adam":
        # torch takes seconds to import and the default does without.
        extra("torch", "networks", "--method adam")
        from jcr.reconstruct.global_alignment.adam import align_adam

        return align_adam(predictions, options, progress)
    return align_fast(predictions, options, progress)


@dataclass(frozen=True)
class RobotAlignment:
    """The better alignment in the first camera's frame, and the cameras of the images alone, for the calibration."""

    alignment: Alignment
    evidence: CameraEvidence | None
    """None for adam, which gives no covariance."""


def align_with_robot(
    predictions: PairPredictions,
    base_from_gripper: Float[ndarray, "n 4 4"],
    options: AlignOptions | None = None,
    progress: Progress | None = None,
) -> RobotAlignment:
    """Align freely and kinematically, and keep what promises the smaller error of the cameras.

    The normal equations of each, with weights measured on its own residuals, predict the errors of its cameras after
    the best similarity. Kinematic alignment is kept where these are smaller, it settled, and no gripper pose had to move
    beyond the robot pose noise, which it estimates: a wrong gripper pose would bend the scene. (The cost at the minimum
    does not decide: free cameras have 6n - 13 parameters more and always fit better.) `evidence` is of the free cameras
    in either case, as the robot's poses must not count twice. Raises InputError as `align` does.
    """
    options = options or AlignOptions()
    if options.method != "fast":
        return RobotAlignment(align(predictions, options, progress), None)
    begin = time.perf_counter()
    check_options(options)
    check_connected(predictions)
    problem = Problem.of(predictions, options)
    free = solve_free(problem, options)
    evidence = CameraEvidence(free.state.recon_from_camera, free.cameras.covariance())
    kinematic, note, warnings = _kinematic_if_better(problem, free, base_from_gripper)
    alignment = dense_alignment(problem, kinematic or free, begin, progress)
    method = "fast" if kinematic is None else "kinematic"
    alignment = replace(
        alignment, method=method, notes=(*alignment.notes, note), warnings=(*alignment.warnings, *warnings)
    )
    return RobotAlignment(alignment, evidence)


def _kinematic_if_better(
    problem: Problem, free: Solution, base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Solution | None, str, tuple[str, ...]]:
    """Kinematic alignment in the frame and unit of the free one, or None; the reason; and warnings."""
    count = problem.predictions.image_count
    if count < 3:
        return None, f"cameras aligned freely: {count} images are too few to tie them to the robot", ()
    try:
        kinematic, cameras = solve_kinematic(problem, free, base_from_gripper)
    except (RejectedError, np.linalg.LinAlgError):
        return None, "cameras aligned freely: tied to the robot's poses they are undetermined", ()
    contradicted = contradictions(cameras, problem.predictions)
    if contradicted:
        return None, "cameras aligned freely: the images contradict the robot's poses", contradicted
    if not kinematic.settled:
        return None, "cameras aligned freely: tied to the robot's poses they did not settle", ()
    metres = float(np.exp(kinematic.state.log_pair_scale.mean()))
    errors_mm = [
        1e3 * predicted_error(solution.state.recon_from_camera, solution.cameras.covariance()) * unit
        for solution, unit in ((free, metres), (kinematic, 1.0))
    ]
    promise = "expected error {:.2g} mm freely, {:.2g} mm tied to the robot's poses".format(*errors_mm)
    if errors_mm[0] <= errors_mm[1]:
        return None, f"cameras aligned freely: {promise}", ()
    return _in_first_camera(kinematic, metres), f"cameras aligned kinematically: {promise}", ()


def predicted_error(recon_from_camera: Float[ndarray, "n 4 4"], covariance: Float[ndarray, "r r"]) -> float:
    """Root mean square error of the camera centres after the best similarity, from the covariance of their steps."""
    center = recon_from_camera[:, :3, 3]
    count = len(center)
    of_centers = covariance.reshape(count, 6, count, 6)[:, :3, :, :3].reshape(3 * count, 3 * count)
    unit = np.tile(np.eye(3), (count, 1, 1))
    gauge = np.concatenate([unit, -skew(center), center[:, :, None]], axis=2).reshape(3 * count, 7)
    basis = np.linalg.qr(gauge)[0]
    left = np.trace(of_centers) - np.trace(basis.T @ of_centers @ basis)
    return float(np.sqrt(max(left, 0.0) / count))


def _in_first_camera(solution: Solution, metres: float) -> Solution:
    """A solution in the base frame and metres as a free one would have it: first camera, pairs' mean unit."""
    base_from_camera = solution.state.recon_from_camera
    relative = replace(solution.state, recon_from_camera=inverse(base_from_camera[0]) @ base_from_camera)
    return replace(solution, state=rescaled(relative, 1.0 / metres))
