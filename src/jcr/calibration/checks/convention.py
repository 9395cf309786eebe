"""Diagnosis of wrong pose conventions: hand-eye fits with the gripper poses in other conventions and other orders.

Candidates are ranked by screw congruence (gripper and camera rotate by the same angle between two images), and the best
are fitted. A convention that fits is reported, and never applied.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.adjust import with_adjusted_images
from jcr.calibration.case import Case
from jcr.calibration.hand_eye import poses_agree, solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import errors_of
from jcr.capture.pairing import paired_by_name
from jcr.estimation.closed_form import closed_form
from jcr.estimation.robust import least_trimmed
from jcr.findings import Finding, FindingKind
from jcr.geometry import Poses, inverse, transform

SOLVED = 24
"""Largest number of candidate conventions, ranked by congruence, that are examined by a closed form or a fit."""
SAME_ANGLE = np.radians(0.1)
"""Step (rad) to which the angle differences of candidates are rounded for ranking; ties go to usual mistakes."""
FITS = 3.0
"""Misfit (mm) up to which the given poses count as correct."""
BETTER = 3.0
"""Ratio of the misfit of the given poses to that of a candidate, above which the candidate is reported."""
ROUGHLY = 2.0
"""Factor by which the misfit of a closed form may differ from that of a fit."""
USUAL = 13
"""Number of first candidates that are examined before those whose angles are nearer the cameras'."""
ADJUSTED = 2
"""Largest number of candidates with which the images are adjusted; each takes seconds."""
MIN_SHARE = 0.8
"""Smallest fraction of the images that must agree with a candidate convention."""
MIRRORED = "mirrored ones (the images are mirrored, or the base's axes are left-handed)"
BY_NUMBER = "those of the images in order of their names as numbers (1, 2, … 10)"
BY_TEXT = "those of the images in order of their names as text (1, 10, 11, … 2)"
AT_SOURCE = "correct them at their source"
EULER_ORDERS = (
    *("xyz", "ZYX", "zyx", "XYZ", "ZYZ", "zyz", "xzy", "yxz", "yzx", "zxy", "XZY", "YXZ", "YZX", "ZXY"),
    *("xyx", "xzx", "yxy", "yzy", "zxz", "XYX", "XZX", "YXY", "YZY", "ZXZ"),
)
"""Sequences of Euler angles in SciPy's notation (lower case: fixed axes, upper case: moving axes), usual ones first."""
_Candidate = tuple[str, str, Float[ndarray, "_ 4 4"], Int[ndarray, " _"]]
"""Candidate convention: name, remedy, base_from_gripper in it, and for each pose the index of its camera pose."""


def check_convention(case: Case) -> Case:
    """Return the case with a finding if its calibration is rejected and the gripper poses fit in another convention.

    No convention is searched if a wrong board size explains the rejection.
    """
    fit, capture, camera = case.pose_fit, case.capture, case.recon_from_camera
    by_board = any(one.kind is FindingKind.BOARD_SIZE for one in case.hand_eye.findings)
    if case.hand_eye.converged or fit.converged or by_board:
        return case
    rows, by_name = case.reconstruction.image_index, paired_by_name(capture.images, capture.base_from_gripper)
    # Estimated intrinsics are too poor to compare conventions before the images are adjusted.
    is_poor = capture.intrinsics is None and case.is_adjustable and not case.tracks.from_pointmaps

    def with_images(poses: Poses, image: Int[ndarray, " k"]) -> Calibration:
        """Return the calibration from adjusted images with other gripper poses of the registered images `image`."""
        every = capture.base_from_gripper.copy()
        every[rows[image]] = poses
        reported = every[rows]
        other = replace(
            case,
            capture=replace(capture, base_from_gripper=every),
            robot=errors_of(reported),
            hand_eye=replace(
                solve_hand_eye(reported, camera, camera_errors="none"), intrinsics=fit.intrinsics
            ),
            fit=None,
            chosen_tracks=None,
            adjusted=None,
        )
        return with_adjusted_images(other).hand_eye

    observable = case.hand_eye.observability.observable
    found = better_reading(
        capture.base_from_gripper, camera, observable, by_name, rows, with_images if is_poor else None
    )
    return case.after(found)


def better_reading(
    base_from_gripper: Poses,
    recon_from_camera: Float[ndarray, "m 4 4"],
    observable: bool = True,
    by_name: Mapping[bool, Poses] | None = None,
    rows: Int[ndarray, " m"] | None = None,
    calibrate: Callable[[Poses, Int[ndarray, " k"]], Calibration] | None = None,
) -> tuple[Finding, ...]:
    """Return a finding of the pose convention that fits much better than the given one; an empty tuple if none does.

    Its `misfit` must be below that of the given poses divided by BETTER, its errors acceptable (`poses_agree`), and
    most images (MIN_SHARE) in agreement. There is no finding if the given poses fit already (FITS). The finding only
    warns unless the motions are `observable`, because degenerate motions may fit another convention by chance.

    `rows` holds the index of the gripper pose of each of the m camera poses; None: both arrays have the same order and
    length. `by_name` holds the gripper poses that the images have if they are sorted by name, as numbers (key True) or
    as text (key False). `calibrate` returns the calibration with other gripper poses of the k images with the given
    indices among the camera poses; None: the fit to the camera poses.
    """
    rows = np.arange(len(base_from_gripper)) if rows is None else rows
    n = len(rows)
    given, *others = _candidates(base_from_gripper, by_name or {}, rows)

    def fit(candidate: _Candidate) -> Calibration:
        """Return the calibration of the images with the gripper poses as a candidate convention reads them."""
        _, _, poses, image = candidate
        if calibrate is not None:
            return calibrate(poses, image)
        return solve_hand_eye(poses, recon_from_camera[image], camera_errors="none")

    as_given = fit(given)
    if misfit(as_given) < FITS and as_given.images_used >= MIN_SHARE * n:
        return ()
    worth = _congruent(others, recon_from_camera)
    rough = [_rough_error(candidate, recon_from_camera) for candidate in worth]
    # Candidates whose closed form fits too badly are not fitted; shuffled poses fit no candidate.
    enough = 1e-3 * ROUGHLY / BETTER * misfit(as_given)
    if not min(rough) <= min(enough, _rough_error(given, recon_from_camera) / ROUGHLY):
        return ()
    near = min(ROUGHLY * min(rough), enough)
    nearest = np.argsort(rough, kind="stable")[: SOLVED if calibrate is None else ADJUSTED]
    fits = [(worth[k], fit(worth[k])) for k in np.sort(nearest) if rough[k] <= near]
    least = min(misfit(found) for _, found in fits)
    best, found = next((one, found) for one, found in fits if misfit(found) < 1.05 * least + 0.01)
    if (
        not poses_agree(found.robot_noise)
        or found.images_used < MIN_SHARE * (n - 2)
        or misfit(found) * BETTER >= misfit(as_given)
    ):
        return ()
    errors = [(one, *one.robot_noise.together) for one in (found, as_given)]
    words = [
        f"{1e3 * metres:.1f} mm and {np.degrees(radians):.2f}° per axis over {one.images_used} images"
        for one, metres, radians in errors
    ]
    details = {"reading": best[0], "remedy": best[1], "fits": words[0], "given": words[1]}
    severity, size = "rejects" if observable else "warns", errors[0][1]
    return (Finding.of(FindingKind.POSE_CONVENTION, severity, "poses", value=size, **details),)


def misfit(fit: Calibration) -> float:
    """Return the misfit (mm) of a fit: the estimated robot error in translation, plus 5 mm per degree of rotation."""
    metres, radians = fit.robot_noise.together
    return 1e3 * metres + 5 * float(np.degrees(radians))


def _congruent(candidates: Sequence[_Candidate], recon_from_camera: Poses) -> list[_Candidate]:
    """Return the candidates whose rotation angles between poses agree best with those of the camera poses.

    The measure is the 60 % quantile of the angle differences over all image pairs. Candidates up to twice the smallest
    value, plus SAME_ANGLE, are returned, at most SOLVED. Usual mistakes come first (the first USUAL candidates), then
    the others by this measure.
    """
    camera_angle, gaps = _angles(recon_from_camera), []
    for _, _, gripper, image in candidates:
        gap = np.abs(_angles(gripper) - camera_angle[np.ix_(image, image)])
        gaps.append(np.quantile(gap[np.triu_indices(len(gap), 1)], 0.6))
    nearest = np.round(np.divide(gaps, SAME_ANGLE))
    nearest[:USUAL] = 0
    near = [k for k in np.argsort(nearest, kind="stable") if gaps[k] < 2 * min(gaps) + SAME_ANGLE]
    return [candidates[k] for k in near[:SOLVED]]


def _rough_error(candidate: _Candidate, recon_from_camera: Poses) -> float:
    """Return the misfit (m) of a candidate convention in a closed-form calibration from the images that agree best.

    The misfit is the rms error of these images (`least_trimmed`), with angles (rad) multiplied by ARM. It is infinite
    if the scale is negative, as for mirrored poses. A fit takes 100 times as long.
    """
    _, _, base_from_gripper, image = candidate
    camera = recon_from_camera[image]
    agree, error = least_trimmed(base_from_gripper, camera)
    return error if closed_form(base_from_gripper[agree], camera[agree])[1] > 0 else np.inf


def _angles(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n n"]:
    """Return the rotation angles (rad) between all pairs of n poses; the formula is imprecise near 0 and π."""
    flat = a_from_b[:, :3, :3].reshape(-1, 9)
    return np.arccos(np.clip((flat @ flat.T - 1) / 2, -1, 1))


def _candidates(
    every_pose: Poses, by_name: Mapping[bool, Poses], rows: Int[ndarray, " m"]
) -> Iterator[_Candidate]:
    """Yield the given poses, then candidates that each correct one assumed mistake; usual mistakes come first.

    `every_pose` are all gripper poses of the capture; `rows` are the indices of those that belong to the m camera
    poses. `by_name` holds all gripper poses in the orders of the image names, as in `better_reading`.
    """
    base_from_gripper, every = every_pose[rows], np.arange(len(rows))
    yield ("they are given", "", base_from_gripper, every)
    inverses = "their inverses (gripper_from_base was given)"
    yield (inverses, "add --pose-inverted", inverse(base_from_gripper), every)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    flip = "switch off the driver's mirroring or flip the images back, or correct the sign of one axis of the poses"
    yield (MIRRORED, flip, mirror @ base_from_gripper @ mirror, every)
    yield ("listed in reverse order of the images", AT_SOURCE, every_pose[::-1][rows], every)
    for shift in range(1, min(2, len(rows) - 5) + 1):
        ahead = f"{shift} ahead of the images (image k has pose k + {shift})"
        behind = f"{shift} behind the images (image k has pose k − {shift})"
        for name, row in ((ahead, rows + shift), (behind, rows - shift)):
            inside = (row >= 0) & (row < len(every_pose))
            yield (name, AT_SOURCE, every_pose[row[inside]], every[inside])
    for by_number, poses in by_name.items():
        column = "add a column image with the images' names"
        yield (BY_NUMBER if by_number else BY_TEXT, column, poses[rows], every)
    rotation = Rotation.from_matrix(base_from_gripper[:, :3, :3])

    def with_rotation(name: str, read: Rotation, remedy: str = AT_SOURCE) -> _Candidate:
        """Return a candidate convention with the rotations `read` and the given translations."""
        return (name, remedy, transform(read.as_matrix(), base_from_gripper[:, :3, 3]), every)

    x, y, z, w = rotation.as_quat().T
    option = "in a table add --pose-convention quat-"
    for meant, taken, read in (("wxyz", "xyzw", [y, z, w, x]), ("xyzw", "wxyz", [w, x, y, z])):
        name = f"quaternions {', '.join(meant)} that were taken as {', '.join(taken)}"
        yield with_rotation(name, Rotation.from_quat(np.stack(read, 1)), option + meant)
    in_radians, vectors = "in radians that were taken as degrees", np.degrees(rotation.as_rotvec())
    yield with_rotation(f"rotation vectors {in_radians}", Rotation.from_rotvec(vectors))
    of_matrices = "in a table of matrices add --pose-convention franka"
    yield with_rotation("transposed rotations", rotation.inv(), of_matrices)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock
        angles = {order: rotation.as_euler(order) for order in EULER_ORDERS}
    for order in EULER_ORDERS:
        read = Rotation.from_euler(order, np.degrees(angles[order]))
        yield with_rotation(f"Euler angles ({order}) {in_radians}", read)
    # Angles about fixed axes equal angles about moving axes in reverse order, so each mistake occurs twice.
    named = set[tuple[str, str]]()
    for pair in sorted(permutations(EULER_ORDERS, 2), key=lambda pair: sum(map(EULER_ORDERS.index, pair))):
        taken, meant = pair
        if pair not in named:
            named |= {pair, (taken[::-1].swapcase(), meant[::-1].swapcase())}
            read = Rotation.from_euler(meant, angles[taken])
            yield with_rotation(f"Euler angles {meant} that were taken as {taken}", read)
