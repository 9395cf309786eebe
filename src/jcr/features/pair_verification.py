"""Verification of image pairs by the gripper poses, and estimation of the hand-eye rotation from confirmed pairs.

X is gripper_from_camera, and R_X its rotation. The angle between two cameras equals the angle between the two gripper
poses for every X (Chen 1991). Once enough pairs agree, R_X is known and the whole relative rotation is checked, R_A R_X
= R_X R_B, where A is the gripper's motion and B the camera's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.features.two_view import CameraMotion
from jcr.geometry import nearest_rotation, rotation_angle, rotation_exp, rotation_log, sine_axis
from jcr.least_squares import minimise

REPORTED_STD = math.radians(0.3)
"""Standard deviation of a reported gripper rotation, rad; an industrial arm has 0.05°, a servo arm 1°."""
SYSTEMATIC = 0.015
"""Systematic difference of camera and gripper angle, as a share of the angle; real captures show 0.001 to 0.021."""
SYSTEMATIC_OF_GUESS = 0.04
"""Value of SYSTEMATIC where the focal length is estimated from the gripper's angles."""
GATE_SIGMAS = 3.0
LARGEST_STD = math.radians(3)
"""Largest standard deviation (rad) of a pair's rotation angle; a less certain pair neither confirms nor contradicts."""
SURE_STD = math.radians(2.5)
"""Largest standard deviation (rad, along any axis) at which R_X counts as known."""
LEAST_PAIRS = 4
"""Least number of pairs that must agree on R_X; three wrong ones can agree by chance."""
MAX_HYPOTHESES = 3000
LEAST_INFORMATION = 6.25e-3
"""Least information of the pairs on R_X along any axis, in units of one residual; with less, R_X is not determined."""
MOST_ROTATION_ROUNDS = 20
"""Largest number of least-squares estimates of R_X, each with new weights (Cauchy) of the pairs that agree."""


Key = tuple[int, int]
"""Rows of two images, the smaller first."""
Motions = Float[ndarray, "n n 4 4"]
"""Gripper's motion of each pair of images: the element [i, j] is i_from_j."""


@dataclass(frozen=True)
class Pair:
    """Matched keypoints of two images that fit one two-view geometry, and the camera motions that may explain them."""

    key: Key
    rows: Int[ndarray, "m 2"]
    """Rows of the matched keypoints among those of the first and of the second image."""
    motions: tuple[CameraMotion, ...]
    """Possible relative motions of the two cameras, best first; empty where none could be found."""
    geometry: pycolmap.TwoViewGeometry


@dataclass(frozen=True, kw_only=True)
class RotationOfX:
    """Estimate of the rotation R_X of gripper_from_camera, with its covariance and the image pairs that agree on it."""

    rotation: Float[ndarray, "3 3"]
    covariance: Float[ndarray, "3 3"]
    """Covariance of a rotation vector in gripper axes, rad²."""
    agreeing: Bool[ndarray, " p"]
    """True for each pair, or motion of a pair, that agrees with R_X."""
    sigma: float
    """Robust standard deviation of the residuals of the agreeing pairs, rad per axis."""


@dataclass(frozen=True)
class Gate:
    """Image pairs that the gripper's rotation confirms, leaves undecided or contradicts; and the hand-eye rotation."""

    confirmed: tuple[Pair, ...]
    """Pairs that agree with the gripper's motion; the first of their `motions` is the motion that agrees best."""
    undecided: tuple[Pair, ...]
    """Pairs whose rotation is too uncertain to be judged."""
    contradicted: tuple[Pair, ...]
    of_x: RotationOfX | None
    """Hand-eye rotation R_X from the confirmed pairs; None while too few pairs agree."""


def agreeing_motions(pair: Pair, angle: float, systematic: float) -> list[tuple[CameraMotion, float]]:
    """Return the motions of an image pair that rotate by about `angle` (rad), each with its tolerance (rad).

    `angle` is that of the gripper's motion. The tolerance is GATE_SIGMAS standard deviations of the difference of both
    angles. `systematic` is the share of the angle by which camera and gripper may differ systematically.
    """
    found = []
    for one in pair.motions:
        tolerance = GATE_SIGMAS * math.sqrt(
            one.angle_std() ** 2 + 2 * REPORTED_STD**2 + (systematic * angle) ** 2
        )
        if abs(float(rotation_angle(one.rotation)) - angle) < tolerance:
            found.append((one, tolerance))
    return found


def classify_pairs(
    pairs: Sequence[Pair],
    motion: Motions,
    systematic: float = SYSTEMATIC,
    known: RotationOfX | None = None,
) -> Gate:
    """Classify image pairs by whether their camera rotation agrees with the gripper's motion.

    Pairs pass first by rotation angle alone, which may differ by the share `systematic`. The hand-eye rotation R_X is
    estimated from these. Every possible motion of every pair is then judged by its whole rotation. `known` is an R_X
    from a larger set of pairs, used where these pairs do not determine it.
    """
    angle = np.asarray(rotation_angle(motion[..., :3, :3]))
    undecided, passing, judged = [], [], []
    for pair in pairs:
        if not any(one.angle_std() < LARGEST_STD for one in pair.motions):
            undecided.append(pair)
            continue
        found = agreeing_motions(pair, float(angle[pair.key]), systematic)
        sure = [(one, allowed) for one, allowed in found if one.angle_std() < LARGEST_STD]
        passing += [(pair.key, *one) for one in sure]
        judged.append((pair, sure[0][0] if sure else None))
    of_x = _common_rotation(passing, motion) or known
    confirmed, contradicted = [], []
    for pair, best in judged:
        if of_x is not None:
            camera = np.stack([one.rotation for one in pair.motions])
            gaps = _gap(of_x.rotation, motion[pair.key][None, :3, :3], camera)
            nearest, by_gripper = pair.motions[int(np.argmin(gaps))], float(angle[pair.key])
            # Variances (rad²) of the pair's rotation, of its prediction by R_X, and of the gripper's motion.
            own, robot = np.trace(nearest.covariance[:3, :3]), 3 * max(2 * REPORTED_STD**2, of_x.sigma**2)
            of_mean = 4 * math.sin(min(by_gripper, math.pi) / 2) ** 2 * np.trace(of_x.covariance)
            variance = own + of_mean + robot + (systematic * by_gripper) ** 2
            best = nearest if gaps.min() < GATE_SIGMAS * math.sqrt(variance) else None
        if best is None:
            contradicted.append(pair)
        else:
            others = (one for one in pair.motions if one is not best)
            confirmed.append(replace(pair, motions=(best, *others)))
    return Gate(tuple(confirmed), tuple(undecided), tuple(contradicted), of_x)


def _common_rotation(
    passing: Sequence[tuple[Key, CameraMotion, float]], motion: Motions
) -> RotationOfX | None:
    """Return the hand-eye rotation R_X; None if fewer than LEAST_PAIRS image pairs agree on it or it is uncertain.

    Uncertain means a standard deviation above SURE_STD along any axis. `passing` lists image pairs, each with a camera
    motion and its tolerance (rad); `motion[i, j]` is the gripper's i_from_j.
    """
    keys = [key for key, _, _ in passing]
    if len(set(keys)) < LEAST_PAIRS:
        return None
    gripper = np.stack([motion[key][:3, :3] for key in keys])
    camera = np.stack([one.rotation for _, one, _ in passing])
    # A wrong motion that passed by chance has another axis. Motions of one pair count as one agreeing pair.
    found = rotation_of_x(gripper, camera, np.array([1.5 * tolerance for _, _, tolerance in passing]))
    if found is None or np.linalg.eigvalsh(found.covariance)[-1] > SURE_STD**2:
        return None
    agreeing = {key for key, agrees in zip(keys, found.agreeing, strict=True) if agrees}
    return found if len(agreeing) >= LEAST_PAIRS else None


def rotation_of_x(
    gripper: Float[ndarray, "p 3 3"], camera: Float[ndarray, "p 3 3"], tolerance: Float[ndarray, " p"]
) -> RotationOfX | None:
    """Return the hand-eye rotation R_X from relative rotations i_from_j of gripper and camera, p of each.

    Each hypothesis comes from two image pairs, as in RANSAC; the best one is refined on all pairs that agree with it.
    `tolerance` (rad) is the largest disagreement of a correct pair. Returns None if no three pairs about two axes
    agree, or if they have less than LEAST_INFORMATION about R_X.
    """
    axis_a, axis_b = sine_axis(gripper), sine_axis(camera)
    first, second = np.triu_indices(len(gripper), 1)
    across = np.linalg.norm(np.cross(axis_a[first], axis_a[second]), axis=1)
    order = np.argsort(-across, kind="stable")
    order = order[across[order] > 0.02]
    if not len(order):
        return None
    if len(order) > MAX_HYPOTHESES:  # evenly over the ranking: the best ones may all contain one wrong pair
        order = order[np.linspace(0, len(order) - 1, MAX_HYPOTHESES).astype(int)]
    a, b = (np.stack([of[first[order]], of[second[order]]], 2) for of in (axis_a, axis_b))
    a, b = (np.concatenate([of, np.cross(of[..., 0], of[..., 1])[..., None]], 2) for of in (a, b))
    hypotheses = nearest_rotation(a @ np.swapaxes(b, 1, 2))
    parts = np.array_split(hypotheses, len(hypotheses) // 256 + 1)
    gaps = (_gap(few[:, None], gripper, camera) for few in parts)
    score = np.concatenate([np.maximum(1 - (gap / tolerance) ** 2, 0).sum(1) for gap in gaps])
    x = hypotheses[int(score.argmax())]
    information, agreeing = np.zeros((3, 3)), np.zeros(len(gripper), dtype=bool)
    for _ in range(MOST_ROTATION_ROUNDS):
        gap = _gap(x, gripper, camera)
        agreeing = gap < tolerance
        if agreeing.sum() < 3:
            return None
        root = agreeing / np.sqrt(1 + (2 * gap / tolerance) ** 2)
        found = minimise(
            lambda x, root=root: _residuals(x, gripper, camera, root),
            x,
            lambda x, step: nearest_rotation(rotation_exp(step) @ x),
        )
        before, x, information = x, found.unknowns, found.normal
        if np.abs(x - before).max() < 1e-9:
            break
    if np.linalg.eigvalsh(information)[0] < LEAST_INFORMATION:
        return None
    gap = _gap(x, gripper, camera)
    sigma = max(1.48 * float(np.median(gap[agreeing])) / np.sqrt(3), np.radians(0.02))
    covariance = sigma**2 * np.linalg.inv(information)
    return RotationOfX(rotation=x, covariance=covariance, agreeing=agreeing, sigma=sigma)


def _residuals(
    x: Float[ndarray, "3 3"],
    gripper: Float[ndarray, "p 3 3"],
    camera: Float[ndarray, "p 3 3"],
    scale: Float[ndarray, " p"],
) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p 3 3"]]:
    """Return for each of p pairs the rotation vector (rad) from X B Xᵀ to A, and its derivative by a step of X.

    A and B are the rotations of `gripper` and `camera`, and X is `x`. A step w changes X to exp(w) X. Both results are
    multiplied by the `scale` of each pair, the root of its weight.
    """
    # A step w of X changes X camera Xᵀ to exp(w) X camera Xᵀ exp(-w).
    back = np.swapaxes(x @ camera @ x.T, 1, 2)
    return scale[:, None] * rotation_log(back @ gripper), scale[:, None, None] * (np.eye(3) - back)


def _gap(
    x: Float[ndarray, "*batch 3 3"], gripper: Float[ndarray, "p 3 3"], camera: Float[ndarray, "p 3 3"]
) -> Float[ndarray, "..."]:
    """Return the angle (rad) between gripper · X and X · camera, for each rotation X in `x` and each of p pairs.

    The shape is (p,) for one X (3,3), and (h,p) for X of shape (h,1,3,3).
    """
    return np.arccos(np.clip((np.einsum("...ij,...ij->...", gripper @ x, x @ camera) - 1) / 2, -1, 1))
