"""Diagnosis of wrong pose conventions: hand-eye fits with the gripper poses in other conventions and other orders.

Candidates are ranked by screw congruence (gripper and camera rotate by the same angle between two images), and the best
are fitted. A convention that fits is reported, and never applied.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.adjust import with_adjusted_images
from jcr.calibration.case import Case
from jcr.calibration.hand_eye import MAX_NOISE, poses_agree, solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import errors_of
from jcr.capture.pairing import paired_by_name
from jcr.estimation.closed_form import closed_form
from jcr.estimation.robust import least_trimmed
from jcr.findings import Finding, FindingKind, Severity
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


@dataclass(frozen=True)
class PoseConvention:
    """Convention or order of the gripper poses, and how badly a calibration with them fits."""

    name: str
    remedy: str
    translation_mm: float
    """Estimated robot error per axis (mm), random and systematic."""
    rotation_deg: float
    """Estimated robot error per axis (degrees), random and systematic."""
    used: int
    """Number of images that agree with the fit."""

    @property
    def agrees(self) -> bool:
        """Whether both estimated robot errors per axis are at most MAX_NOISE, the limit for an accepted calibration."""
        small = self.translation_mm <= 1e3 * MAX_NOISE[0], self.rotation_deg <= np.degrees(MAX_NOISE[1])
        return all(map(bool, small))

    @property
    def misfit(self) -> float:
        """Misfit (mm): translation error plus 5 mm per degree of rotation error."""
        return self.translation_mm + 5 * self.rotation_deg


def check_convention(case: Case) -> Case:
    """Return the case with a finding if its calibration is rejected and the gripper poses fit in another convention.

    The finding only warns if the motions are degenerate, because such motions may fit another convention by chance. No
    convention is searched if a wrong board size explains the rejection.
    """
    fit, capture = case.pose_fit, case.capture
    by_board = any(one.kind is FindingKind.BOARD_SIZE for one in case.hand_eye.findings)
    if case.hand_eye.converged or fit.converged or by_board:
        return case
    by_name = paired_by_name(capture.images, capture.base_from_gripper)
    rows = case.reconstruction.image_index
    # Candidates are fitted without given noise, known lengths and camera covariance; the given poses must be, too.
    alone = not case.priors and case.reconstruction.evidence is None and fit.robot_noise.given is None
    solved = fit if alone else None
    found = better_reading(capture.base_from_gripper, case.recon_from_camera, by_name, solved, rows)
    found = found or _better_adjusted(case, by_name)
    if found is None:
        return case
    observable = case.hand_eye.observability.observable
    return case.after((convention_finding(found, "rejects" if observable else "warns"),))


def better_reading(
    base_from_gripper: Poses,
    recon_from_camera: Float[ndarray, "m 4 4"],
    by_name: Mapping[bool, Poses] | None = None,
    solved: Calibration | None = None,
    rows: Int[ndarray, " m"] | None = None,
) -> tuple[PoseConvention, PoseConvention] | None:
    """Return the pose convention that fits much better than the given one, then the given one; None if none does.

    Its `misfit` must be below that of the given poses divided by BETTER, its errors acceptable (`agrees`), and most
    images (MIN_SHARE) in agreement. None is also returned if the given poses fit already (FITS).

    `rows` holds the index of the gripper pose of each of the m camera poses; None: both arrays have the same order and
    length. `by_name` holds the gripper poses that the images have if they are sorted by name, as numbers (key True) or
    as text (key False). `solved` is a fit of the given poses to the camera poses alone; None: it is computed.
    """
    rows = np.arange(len(base_from_gripper)) if rows is None else rows
    n = len(rows)
    given, *others = _candidates(base_from_gripper, by_name or {}, rows)
    as_given = _reading(given, recon_from_camera, solved)
    if as_given.misfit < FITS and as_given.used >= MIN_SHARE * n:
        return None
    worth = _congruent(others, recon_from_camera)
    rough = [_rough_error(candidate, recon_from_camera) for candidate in worth]
    # Candidates whose closed form fits too badly are not fitted; shuffled poses fit no candidate.
    enough = 1e-3 * ROUGHLY / BETTER * as_given.misfit
    if not min(rough) <= min(enough, _rough_error(given, recon_from_camera) / ROUGHLY):
        return None
    near = min(ROUGHLY * min(rough), enough)
    readings = [
        _reading(one, recon_from_camera) for one, error in zip(worth, rough, strict=True) if error <= near
    ]
    least = min(reading.misfit for reading in readings)
    best = next(reading for reading in readings if reading.misfit < 1.05 * least + 0.01)
    is_better = best.agrees and best.used >= MIN_SHARE * (n - 2) and best.misfit * BETTER < as_given.misfit
    return (best, as_given) if is_better else None


def _better_adjusted(
    case: Case, by_name: Mapping[bool, Poses]
) -> tuple[PoseConvention, PoseConvention] | None:
    """Return the pose convention whose calibration from adjusted images is accepted, then the given one; None if none.

    The result is also None with given intrinsics. Without given intrinsics, camera poses are too poor to select a
    convention before the images are adjusted. Only the ADJUSTED candidates with the smallest closed-form error are
    adjusted, if it is below that of the given poses. `by_name` is that of `better_reading`.
    """
    rows = case.reconstruction.image_index
    given, *others = _candidates(case.capture.base_from_gripper, by_name, rows)
    if case.capture.intrinsics is not None or not case.is_adjustable or case.tracks.from_pointmaps:
        return None
    if poses_agree(case.hand_eye.robot_noise):
        return None
    camera = case.recon_from_camera
    worth = _congruent(others, camera)
    rough, limit = [_rough_error(candidate, camera) for candidate in worth], _rough_error(given, camera)
    for k in np.argsort(rough, kind="stable")[:ADJUSTED]:
        _, _, poses, image = worth[k]
        if rough[k] >= limit:
            break
        reported, every = case.base_from_gripper.copy(), case.capture.base_from_gripper.copy()
        reported[image] = poses
        every[rows] = reported
        robot = errors_of(reported)
        known = {"systematic": robot.systematic, "names": case.names}
        fit = solve_hand_eye(reported, camera, camera_errors="none", **known)
        tried = replace(
            case,
            capture=replace(case.capture, base_from_gripper=every),
            robot=robot,
            hand_eye=replace(fit, intrinsics=case.pose_fit.intrinsics),
            fit=None,
            chosen_tracks=None,
            adjusted=None,
        )
        found = with_adjusted_images(tried).hand_eye
        if found.converged and found.inliers.sum() >= MIN_SHARE * (len(reported) - 2):
            readings = _reading(worth[k], camera, found), _reading(given, camera, case.hand_eye)
            return readings if readings[0].misfit * BETTER < readings[1].misfit else None
    return None


def convention_finding(
    found: tuple[PoseConvention, PoseConvention], severity: Severity = "rejects"
) -> Finding:
    """Return the finding that the poses fit in another convention; `found` holds the better and the given one."""
    fits, given = (
        f"{reading.translation_mm:.1f} mm and {reading.rotation_deg:.2f}° per axis over {reading.used} images"
        for reading in found
    )
    details = {"reading": found[0].name, "fits": fits, "given": given, "remedy": found[0].remedy}
    size = 1e-3 * found[0].translation_mm
    return Finding.of(FindingKind.POSE_CONVENTION, severity, "poses", value=size, **details)


def _reading(
    candidate: _Candidate, recon_from_camera: Poses, fit: Calibration | None = None
) -> PoseConvention:
    """Return the record of a candidate convention, with the robot errors and the image count of its calibration `fit`.

    `recon_from_camera` are the camera poses of all registered images. `fit` None: the hand-eye fit to them is computed.
    """
    name, remedy, base_from_gripper, image = candidate
    fit = fit or solve_hand_eye(base_from_gripper, recon_from_camera[image], camera_errors="none")
    metres, radians = fit.robot_noise.together
    return PoseConvention(name, remedy, 1e3 * metres, float(np.degrees(radians)), int(fit.inliers.sum()))


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
