"""Likely causes of a difference between two hand-eye transforms: other intrinsics, or another frame of either side."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.record import Calibration
from jcr.camera import parameters
from jcr.distributions import chi2
from jcr.geometry import ROOT_FROM_OPTICAL, Transform, inverse, motion_length, step_between, transform
from jcr.records import Intrinsics

UNLIKELY = 1e-3
"""p-value below which the reported errors do not explain a difference."""
MOST_DIFFERENT = 0.03
"""Largest difference of intrinsics that is taken for a cause: of the focal length, and of the principal point in image
widths. Makers' intrinsics differ by up to 1 to 2 % from measured ones; with 0.015 such causes are missed, with 0.045 the
unknown intrinsics explain more differences that have other causes."""
REMAINING = 0.1
"""Largest length (jcr.geometry.motion_length) that a change of the frame may leave of the difference."""
LATERAL_M = 5e-3
"""Largest lateral distance (m) between two gripper frames that are apart along their z axis, as flange and tool."""
ANGLE = np.radians(2.0)
"""Largest rotation (rad) between two frames beside a multiple of 45° about their z axis."""
FROM_OPENGL = transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


def likely_cause(
    ours: Transform,
    theirs: Transform,
    covariance: Float[ndarray, "6 6"] | None,
    calibrations: tuple[Calibration | None, Calibration | None],
) -> str | None:
    """Return a sentence with the cause that explains the difference of two gripper_from_camera; None without one.

    `covariance` is that of the step (translation, m; rotation vector, rad) by all reported errors, None if it is
    unknown. `calibrations` are the calibrations of both, None for one that is a bare transform.
    """
    step = step_between(ours, theirs)
    for own, others, along in ((*calibrations, step), (*calibrations[::-1], -step)):
        if own is None or own.intrinsics is None or covariance is None:
            continue
        known = None if others is None else others.intrinsics
        if (found := _other_intrinsics(own, known, along, covariance)) is not None:
            fx, cx, cy = found
            return (
                f"the intrinsics: those of the other (fx {fx:.1f} cx {cx:.1f} cy {cy:.1f}) instead of "
                f"{own.intrinsics.fx:.1f} {own.intrinsics.cx:.1f} {own.intrinsics.cy:.1f} explain the difference; "
                "compare calibrations with the same ones (jcr export --intrinsics given)"
            )
    whole = float(motion_length(inverse(ours) @ theirs))
    for words, other in _in_other_frames(theirs):
        if float(motion_length(inverse(ours) @ other)) < REMAINING * whole:
            return f"the frames: {words}"
    return _other_gripper_frame(ours @ inverse(theirs))


def _other_intrinsics(
    own: Calibration,
    known: Intrinsics | None,
    step: Float[ndarray, "6"],
    covariance: Float[ndarray, "6 6"],
) -> tuple[float, float, float] | None:
    """Return fx, cx and cy (px) of intrinsics of the other transform that explain the step; None without any.

    `known` are the intrinsics of the other; None: those that the capture gave are tried, then any whose focal length and
    principal point differ plausibly. The joint covariance states how the transform changes with the intrinsics.
    """
    joint, camera = own.uncertainty.joint, own.intrinsics
    if joint is None or camera is None:
        return None
    at = parameters(camera)
    by = joint.covariance[:6, 7:] @ np.linalg.pinv(joint.covariance[7:, 7:], rcond=1e-12, hermitian=True)
    weight = np.linalg.inv(covariance)
    given = None if own.with_given_intrinsics is None else own.with_given_intrinsics.intrinsics
    stated = [one for one in ([known] if known is not None else [given]) if one is not None]
    differences = [(parameters(one) - at, 6) for one in stated if one.model == camera.model]
    if known is None:
        basis = np.zeros((len(at), 3))
        basis[:2, 0], basis[2, 1], basis[3, 2] = at[:2], camera.width, camera.width
        along = by @ basis
        fitted = np.linalg.lstsq(along.T @ weight @ along, along.T @ weight @ step, rcond=None)[0]
        if (np.abs(fitted) < MOST_DIFFERENT).all():
            differences.append((basis @ fitted, 3))
    for difference, freedom in differences:
        left = step - by @ difference
        if np.any(difference) and chi2.sf(float(left @ weight @ left), freedom) >= UNLIKELY:
            fx, _, cx, cy = (at + difference)[:4].tolist()
            return fx, cx, cy
    return None


def _in_other_frames(theirs: Transform) -> Iterator[tuple[str, Transform]]:
    """Yield readings of a transform in other frames: words, and gripper_from_camera by this reading."""
    yield "the other is the inverse, camera_from_gripper", inverse(theirs)
    yield (
        "the other is the pose of the camera's root link (x forward), not of its optical frame (z forward)",
        theirs @ ROOT_FROM_OPTICAL,
    )
    yield (
        "the other has a camera with y up and z backward (OpenGL), not an optical frame",
        theirs @ FROM_OPENGL,
    )
    for words, factor in (("millimetres", 1e-3), ("a thousandth of metres", 1e3)):
        other = theirs.copy()
        other[:3, 3] *= factor
        yield f"the other's lengths are {words}", other


def _other_gripper_frame(one_from_other: Transform) -> str | None:
    """Return a sentence if two gripper frames differ as two frames of one tool do: along z, and by turns about it."""
    x, y, z = one_from_other[:3, 3]
    rotation = Rotation.from_matrix(one_from_other[:3, :3])
    turn = 45 * round(float(rotation.as_euler("zyx", degrees=True)[0]) / 45)
    beside = (Rotation.from_euler("z", -turn, degrees=True) * rotation).magnitude()
    if beside > ANGLE or np.hypot(x, y) > LATERAL_M or (abs(z) < 2 * LATERAL_M and not turn):
        return None
    turned = f" and rotated by {abs(turn)}° about it" if turn % 360 else ""
    return (
        f"the frames: both transforms agree if the other's gripper frame is {1e3 * z:.0f} mm along z of this "
        f"one's{turned}, as flange and tool are"
    )
