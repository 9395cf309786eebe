"""Observability of the hand-eye transform and the scale by the motions of a capture.

The excitation of a direction of (translation, rotation, scale) is the rms change (m) of the predicted gripper poses per
metre along that direction, after base_from_recon is fitted again. Angles are multiplied by geometry.ARM, the scale by
the spread of the camera centres. The excitation is about 0.4 for general motion; for a motion near a degenerate one it
is the sine of the deviation.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.estimation.pose_equations import pose_residuals
from jcr.estimation.problem import BASE_ROTATION, ROTATION, SCALE, LinearPrior
from jcr.findings import Finding, FindingKind
from jcr.geometry import ARM, Poses, Transform, transform
from jcr.records import Observability

MIN_SPREAD = 0.1
"""Smallest assumed spread of camera centres (m), for a capture with nearly equal centres."""
WEAK = 0.06
"""Excitation below which a direction is weakly observable; motion 3° off a degenerate one gives 0.03 to 0.05."""
EXACT = 0.005
"""Excitation below which a direction is unobservable, whatever the measurement errors."""
Excitation = tuple[Float[ndarray, "7"], Float[ndarray, "7 7"]]
"""Excitation of each direction, weakest first, and the directions as rows: unit vectors of translation (m), rotation
times ARM, and log scale times the rms distance (m) of the camera centres from their mean."""


def excitation(
    base_from_gripper: Poses, gripper_from_camera: Transform | None, priors: Sequence[LinearPrior] = ()
) -> Excitation:
    """Return how strongly n gripper poses determine each direction of X (gripper_from_camera) and the scale.

    `priors` add information on X and scale. `gripper_from_camera` None: the camera is assumed at the gripper's origin.
    Excitation is the rms change of the predicted gripper poses (m; 0.3 m per rad) by a unit step along the direction,
    after base_from_recon is fitted again.
    """
    n = len(base_from_gripper)
    offset = np.zeros(3) if gripper_from_camera is None else gripper_from_camera[:3, 3]
    # The offset is limited, because an unobservable one may have any value; the excitation hardly depends on it.
    offset = offset * min(1.0, ARM / max(float(np.linalg.norm(offset)), 1e-9))
    x = transform(np.eye(3), offset)
    camera = base_from_gripper @ x
    base_from_centers = transform(np.eye(3), camera[:, :3, 3].mean(0))
    camera[:, :3, 3] -= base_from_centers[:3, 3]
    spread = max(float(np.sqrt((camera[:, :3, 3] ** 2).sum(1).mean())), MIN_SPREAD)
    _, j = pose_residuals(x, 1.0, base_from_centers, base_from_gripper, camera)
    unit = np.ones(13)
    unit[ROTATION], unit[SCALE], unit[BASE_ROTATION] = ARM, spread, ARM
    j *= np.repeat([1.0, ARM], 3)[:, None] / unit
    hessian = np.einsum("nij,nik->jk", j, j) / n
    seen = hessian[:7, :7] - hessian[:7, 7:] @ np.linalg.pinv(hessian[7:, 7:], rcond=1e-12) @ hessian[7:, :7]
    for one in priors:
        seen += np.outer(one.row[:7], one.row[:7])
    squared, vectors = np.linalg.eigh(seen)
    return np.sqrt(np.maximum(squared, 0.0)), vectors.T


def observability(
    base_from_gripper: Poses,
    gripper_from_camera: Transform | None = None,
    recon_from_camera: Poses | None = None,
    priors: Sequence[LinearPrior] = (),
) -> Observability:
    """Return findings for the unobservable or weakly observable directions of X (gripper_from_camera) and scale.

    Findings reject if the smallest excitation is below EXACT, and warn if it is only below WEAK (both lower for few
    images). Else there are none. Two poses always give a finding. `recon_from_camera`, if given, distinguishes an orbit
    about the scene from rotations about a tool point. Without `gripper_from_camera` the camera is assumed at the
    gripper's origin.
    """
    n = len(base_from_gripper)
    if n == 2:
        return Observability((_unseen("two images"),))
    value, direction = excitation(base_from_gripper, gripper_from_camera, priors)
    # Few images have low excitation by chance: three general ones as low as twenty with 3° of deviation.
    few = min(1.0, (n - 2) / 4)
    unseen = value < WEAK * few
    if not unseen.any():
        return Observability()
    findings = _explained(base_from_gripper, recon_from_camera, direction, unseen)
    if value[0] >= EXACT * few:
        # A weak direction has a standard deviation, by which hand_eye.judged decides; the finding only explains it.
        findings = [
            replace(one, severity="warns", details={**one.details, "nearly": 1.0}) for one in findings
        ]
    return Observability(tuple(replace(one, value=float(value[0])) for one in findings))


def _unseen(motion: str, at: Float[ndarray, "3"] | None = None, frame: str = "") -> Finding:
    """Return the finding that a kind of motion leaves a direction unobservable; `at` is an axis or point (m) in `frame`.

    `frame` is "base" or "gripper".
    """
    where: dict[str, Any] = (
        {} if at is None else {**dict(zip("xyz", at.tolist(), strict=True)), "frame": frame}
    )
    return Finding.of(FindingKind.UNOBSERVABLE, "rejects", "motion", motion=motion, **where)


def _explained(
    base_from_gripper: Poses,
    recon_from_camera: Poses | None,
    direction: Float[ndarray, "7 7"],
    unseen: Bool[ndarray, "7"],
) -> list[Finding]:
    """Return findings that name the degenerate motion; `unseen` masks the weak rows of `direction`.

    Without `recon_from_camera`, an orbit about the scene is not distinguished from rotations about a tool point.
    """
    # The mean of the rotation matrices preserves the length of a common axis and shortens all other directions.
    u, length, _ = np.linalg.svd(base_from_gripper[:, :3, :3].mean(0))
    still = np.sqrt(np.maximum(1 - length**2, 0.0)) < WEAK
    if still.all():
        return [_unseen("no rotation")]
    loses_scale = np.abs(direction[unseen][:, 6]).max() > 0.2
    if still.any():
        if unseen.sum() == 1 and not loses_scale:
            return [_unseen("planar", u[:, 0], "base")]
        parts = ("translation", "scale", "rotation")[: max(int(unseen.sum()), 2)]
        return [_unseen(f"one axis, {part}", u[:, 0], "base") for part in parts]
    if not loses_scale:
        translation, rotation = direction[0][:3], direction[0][3:6]
        is_translation = np.linalg.norm(translation) >= np.linalg.norm(rotation)
        axis = translation if is_translation else rotation
        what = "translation" if is_translation else "rotation"
        return [_unseen(f"weak {what}", axis / np.linalg.norm(axis), "gripper")]
    # A point of the gripper that does not move in the base makes the scale unobservable.
    tool = still_point(base_from_gripper)[0]
    if recon_from_camera is None:
        return [_unseen("one point", tool, "gripper")]
    # Camera poses determine this point better than X, which is correlated with the unobservable scale.
    in_camera, moves, spread = still_point(recon_from_camera)
    if moves > 0.5 * spread:
        return [_unseen("own centre")]
    if in_camera[2] > np.cos(np.radians(8)) * np.linalg.norm(in_camera):
        return [_unseen("look-at")]
    return [_unseen("tool point", tool, "gripper")]


def still_point(a_from_b: Poses) -> tuple[Float[ndarray, "3"], float, float]:
    """Return the point in frame b that moves least in frame a, and rms motions of it and of b's origin.

    An rms motion is the rms distance from the mean position over the poses; all lengths are in the unit of the poses.
    """
    rotation, position = a_from_b[:, :3, :3], a_from_b[:, :3, 3]
    rows, right = (rotation - rotation.mean(0)).reshape(-1, 3), (position - position.mean(0)).ravel()
    point = np.linalg.lstsq(rows, -right, rcond=1e-9)[0]
    n = len(a_from_b)
    return point, float(np.linalg.norm(rows @ point + right)) / n**0.5, float(np.linalg.norm(right)) / n**0.5
