"""Diagnosis of pose conventions: gripper poses that contradict the images, read by other conventions and orders.

Readings are ranked by screw congruence (gripper and camera rotate by the same angle between two images), and the best
are solved. A reading that fits is named, and never applied.
"""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.case import Case
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.capture.pairing import paired_by_name
from jcr.estimation.closed_form import closed_form
from jcr.estimation.robust import least_trimmed
from jcr.findings import Finding, FindingKind, Severity
from jcr.geometry import Poses, inverse, transform

SOLVED = 24
"""Largest number of readings that are solved in full, the most congruent ones."""
SAME_ANGLE = np.radians(0.1)
"""Difference of angles (rad) within which readings rank alike, so that usual mistakes are solved first."""
FITS = 3.0
"""Misfit (mm) up to which poses need no other reading."""
BETTER = 3.0
"""Factor by which a reading must fit better than the poses as given."""
ROUGHLY = 2.0
"""Factor to which a closed form shows the misfit of a reading."""
MIN_SHARE = 0.8
"""Smallest share of the images that agree under a reading."""
INVERSES = "their inverses (gripper_from_base was given)"
WXYZ = "quaternions w, x, y, z that were taken as x, y, z, w"
XYZW = "quaternions x, y, z, w that were taken as w, x, y, z"
TRANSPOSED = "transposed rotations"
MIRRORED = "mirrored ones (the images are mirrored, or the base's axes are left-handed)"
BY_NUMBER = "those of the images in order of their names as numbers (1, 2, … 10)"
BY_TEXT = "those of the images in order of their names as text (1, 10, 11, … 2)"
OPTIONS = {
    BY_NUMBER: "add a column image with the images' names",
    BY_TEXT: "add a column image with the images' names",
    MIRRORED: "switch off the driver's mirroring or flip the images back, or correct the sign of one axis of the poses",
    INVERSES: "add --pose-inverted",
    WXYZ: "in a table add --pose-convention quat-wxyz",
    XYZW: "in a table add --pose-convention quat-xyzw",
    TRANSPOSED: "in a table of matrices add --pose-convention franka",
}
"""Remedy of each reading."""
EULER_ORDERS = (
    *("xyz", "ZYX", "zyx", "XYZ", "ZYZ", "zyz", "xzy", "yxz", "yzx", "zxy", "XZY", "YXZ", "YZX", "ZXY"),
    *("xyx", "xzx", "yxy", "yzy", "zxz", "XYX", "XZX", "YXY", "YZY", "ZXZ"),
)
"""SciPy's names, lower case about fixed axes, upper case about moving ones; the usual ones first."""


def _euler_mistakes() -> list[tuple[str, str]]:
    """Return pairs of the order that angles were taken in and the intended one, usual mistakes first.

    Angles about fixed axes are angles about moving axes in reverse order, so that each mistake has two names.
    """
    rank = {order: k for k, order in enumerate(EULER_ORDERS)}
    found: dict[frozenset[tuple[str, str]], tuple[str, str]] = {}
    for mistake in sorted(permutations(EULER_ORDERS, 2), key=lambda pair: rank[pair[0]] + rank[pair[1]]):
        taken, meant = mistake
        other = taken[::-1].swapcase(), meant[::-1].swapcase()
        found.setdefault(frozenset({mistake, other}), mistake)
    return list(found.values())


EULER_MISTAKES = _euler_mistakes()


@dataclass(frozen=True)
class PoseConvention:
    """Convention or order of the poses, and its misfit."""

    name: str
    translation_mm: float
    """Errors per axis that the fit leaves, random and systematic."""
    rotation_deg: float
    used: int
    """Number of images that agree."""

    @property
    def misfit(self) -> float:
        """Size of the noise, a degree counted as 5 mm."""
        return self.translation_mm + 5 * self.rotation_deg

    @classmethod
    def of(cls, name: str, solved: Calibration) -> "PoseConvention":
        """Return a reading with the misfit of its calibration."""
        metres, radians = solved.robot_noise.together
        return cls(name, 1e3 * metres, float(np.degrees(radians)), int(solved.inliers.sum()))


_Candidate = tuple[str, Float[ndarray, "k 4 4"], Int[ndarray, " k"]]
"""Name of a reading, its gripper poses, and the rows of the cameras that they belong to."""


def check_convention(case: Case) -> Case:
    """Report the convention by which the gripper poses fit, where these are rejected with and without the images.

    Degenerate motions fit another convention by chance, and are reported first. A board may be the cause instead.
    """
    by_board = any(one.kind is FindingKind.BOARD_SIZE for one in case.hand_eye.findings)
    if case.hand_eye.converged or case.pose_fit.converged or by_board:
        return case
    rows, capture = case.reconstruction.image_index, case.capture
    by_name = paired_by_name(capture.images, capture.base_from_gripper)
    by_name = {by_number: poses[rows] for by_number, poses in by_name.items()}
    # Of other readings neither noise nor cues are known, nor are their camera poses weighed.
    alone = not case.priors and case.reconstruction.evidence is None
    fit = case.pose_fit
    solved = fit if alone and fit.robot_noise.given is None else None
    found = better_reading(case.base_from_gripper, case.recon_from_camera, by_name, solved)
    if found is None:
        return case
    observable = case.hand_eye.observability.observable
    return case.after((convention_finding(found, "rejects" if observable else "warns"),))


def better_reading(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    by_name: Mapping[bool, Poses] | None = None,
    solved: Calibration | None = None,
) -> tuple[PoseConvention, PoseConvention] | None:
    """Return the pose convention that fits far better than the given one, and the given one; None where none does.

    `by_name` holds the poses by other orders of the images' names: as numbers (True), as text (False). `solved` is the
    calibration of the poses as given, where there is one from the camera poses alone.
    """
    n = len(base_from_gripper)
    given, *others = _candidates(base_from_gripper)
    for by_number, poses in (by_name or {}).items():
        others.append((BY_NUMBER if by_number else BY_TEXT, poses, np.arange(n)))
    as_given = _solved(given, recon_from_camera) if solved is None else PoseConvention.of(given[0], solved)
    if as_given.misfit < FITS and as_given.used >= MIN_SHARE * n:
        return None
    camera_angle = _angles(recon_from_camera)
    gaps = np.array([_incongruence(candidate, camera_angle) for candidate in others])
    order = np.argsort(np.round(gaps / SAME_ANGLE), kind="stable")[:SOLVED]
    worth = [others[k] for k in order if gaps[k] < 2 * gaps.min() + SAME_ANGLE]
    rough = np.array([_rough_error(candidate, recon_from_camera) for candidate in worth])
    # Of a reading that may be named: shuffled poses fit no reading, and each would be solved in vain.
    enough = 1e-3 * ROUGHLY / BETTER * as_given.misfit
    least = float(rough.min())
    if not least <= min(enough, _rough_error(given, recon_from_camera) / ROUGHLY):
        return None
    readings = [
        _solved(candidate, recon_from_camera)
        for candidate, error in zip(worth, rough, strict=True)
        if error <= min(ROUGHLY * least, enough)
    ]
    least = min(reading.misfit for reading in readings)
    best = next(reading for reading in readings if reading.misfit < 1.05 * least + 0.01)
    is_better = best.used >= MIN_SHARE * (n - 2) and best.misfit * BETTER < as_given.misfit
    return (best, as_given) if is_better else None


def convention_finding(
    found: tuple[PoseConvention, PoseConvention], severity: Severity = "rejects"
) -> Finding:
    """Return the finding that the poses fit under another reading, with the remedy."""
    best, given = (
        f"{reading.translation_mm:.1f} mm and {reading.rotation_deg:.2f}° per axis over {reading.used} images"
        for reading in found
    )
    remedy = OPTIONS.get(found[0].name, "correct them at their source")
    details = {"reading": found[0].name, "fits": best, "given": given, "remedy": remedy}
    finding = Finding.of(FindingKind.POSE_CONVENTION, severity, "poses", value=1e-3 * found[0].translation_mm)
    return replace(finding, details=details)


def _solved(candidate: _Candidate, recon_from_camera: Poses) -> PoseConvention:
    name, base_from_gripper, image = candidate
    return PoseConvention.of(
        name, solve_hand_eye(base_from_gripper, recon_from_camera[image], in_sequence=False)
    )


def _rough_error(candidate: _Candidate, recon_from_camera: Poses) -> float:
    """Return the error (m) of a closed form in the images that agree best, in a hundredth of the time of a fit.

    It is infinite where the scale is negative, as of mirrored poses.
    """
    _, base_from_gripper, image = candidate
    camera = recon_from_camera[image]
    agree, error = least_trimmed(base_from_gripper, camera)
    return error if closed_form(base_from_gripper, camera, agree.astype(float))[1] > 0 else np.inf


def _incongruence(candidate: _Candidate, camera_angle: Float[ndarray, "n n"]) -> float:
    """Return the typical difference (rad) between the angles of gripper and camera motions."""
    _, base_from_gripper, image = candidate
    gap = np.abs(_angles(base_from_gripper) - camera_angle[np.ix_(image, image)])
    return float(np.quantile(gap[np.triu_indices(len(gap), 1)], 0.6))


def _angles(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n n"]:
    """Return the angles (rad) of all relative rotations by their traces, which are imprecise near 0 and π."""
    flat = a_from_b[:, :3, :3].reshape(-1, 9)
    return np.arccos(np.clip((flat @ flat.T - 1) / 2, -1, 1))


def _candidates(base_from_gripper: Poses) -> Iterator[_Candidate]:
    """Yield the poses as given, then with one mistake each."""
    n = len(base_from_gripper)
    every = np.arange(n)
    yield ("they are given", base_from_gripper, every)
    yield (INVERSES, inverse(base_from_gripper), every)
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    yield (MIRRORED, mirror @ base_from_gripper @ mirror, every)
    yield ("listed in reverse order of the images", base_from_gripper[::-1], every)
    for shift in range(1, min(2, n - 5) + 1):
        later, earlier = slice(shift, None), slice(n - shift)
        ahead = f"{shift} ahead of the images (image k has pose k + {shift})"
        behind = f"{shift} behind the images (image k has pose k − {shift})"
        yield (ahead, base_from_gripper[later], every[earlier])
        yield (behind, base_from_gripper[earlier], every[later])
    rotation = Rotation.from_matrix(base_from_gripper[:, :3, :3])

    def with_rotation(name: str, read: Rotation) -> _Candidate:
        return (name, transform(read.as_matrix(), base_from_gripper[:, :3, 3]), every)

    x, y, z, w = rotation.as_quat().T
    yield with_rotation(WXYZ, Rotation.from_quat(np.stack([y, z, w, x], 1)))
    yield with_rotation(XYZW, Rotation.from_quat(np.stack([w, x, y, z], 1)))
    in_radians = "in radians that were taken as degrees"
    yield with_rotation(
        f"rotation vectors {in_radians}", Rotation.from_rotvec(np.degrees(rotation.as_rotvec()))
    )
    yield with_rotation(TRANSPOSED, rotation.inv())
    angles = {order: _euler(rotation, order) for order in EULER_ORDERS}
    for order in EULER_ORDERS:
        read = Rotation.from_euler(order, np.degrees(angles[order]))
        yield with_rotation(f"Euler angles ({order}) {in_radians}", read)
    for taken, meant in EULER_MISTAKES:
        read = Rotation.from_euler(meant, angles[taken])
        yield with_rotation(f"Euler angles {meant} that were taken as {taken}", read)


def _euler(rotation: Rotation, order: str) -> Float[ndarray, "*batch 3"]:
    """Return Euler angles (rad), without the warning of SciPy at gimbal lock."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rotation.as_euler(order)
