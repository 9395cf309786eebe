"""Initial estimate of the hand-eye transform for photometric alignment, by a search over all viewing directions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.geometry import inverse, rotation_between_deg, rotation_exp, transform
from jcr.photometric.coarse_to_fine import (
    PyramidLevel,
    align_photometrically,
    axes_intersection,
    cost_of,
    tied_directions,
)
from jcr.photometric.residuals import Cameras, Level, strong_edges
from jcr.progress import Progress

ROTATIONS, TILTS, TILT_DEG = 24, 6, 15.0
"""Initial estimates around the viewing direction given by the robot's poses: rotations about it, tilts, and their
angle. The direction was off by 4 to 22° in five captures."""
SCREENED_POINTS = 40
"""Number of points per image by which the initial estimates are ranked before any is refined."""
KEPT, KEPT_BASINS = 24, 6
"""Number of initial estimates kept after ranking, and number of different results that are refined further."""
SAME_M, SAME_DEG = 0.03, 5.0
"""Largest distance (m) and angle (degrees) between two results that count as equal."""
CLEARLY_BETTER = 0.9
"""Largest accepted ratio of the best result's cost to that of the next different one. Correct results had 0.60 to 0.81
where there was another result; wrong ones 0.96 to 1.00 (nine captures, eight of them with gripper poses of other
images)."""
COARSEST = PyramidLevel(15, 150, 3, 0.2)
COARSE = PyramidLevel(30, 100, 8, 0.15)
JUDGE = PyramidLevel(60, 100, 1, 0.12)
HEIGHTS = (COARSEST.height, COARSE.height, JUDGE.height)


def search(
    levels: dict[int, Level],
    base_from_gripper: Float[ndarray, "n 4 4"],
    intrinsics_known: bool,
    report: Progress,
) -> Cameras:
    """Return the cameras (gripper poses times one hand-eye transform) for which the images agree best in colour.

    `levels` are the images by their height in pixels (those of HEIGHTS); the focal length changes unless the intrinsics
    are known. Raises RejectedError where a different hand-eye transform fits as well, or where the images have no
    edges.
    """
    if not len(strong_edges(levels[COARSEST.height], COARSEST.per_image)[0]):
        raise RejectedError(
            "direct alignment: the images show one colour and no edges", "put different objects in view"
        )
    directions = tied_directions(intrinsics_known)

    def refined(
        found: list[tuple[float, Cameras]],
        stage: PyramidLevel,
        judge: PyramidLevel,
        begin: float,
        share: float,
    ) -> list[tuple[float, Cameras]]:
        """Align each of the cameras `found` at the level `stage`; return them with their costs at the level `judge`.

        The progress goes from `begin` to `begin` + `share`.
        """
        made = []
        for k, (_, cameras) in enumerate(found):
            report("direct alignment", begin + share * k / len(found))
            cameras, _ = align_photometrically(levels[stage.height], cameras, stage, directions)
            made.append((cost_of(levels[judge.height], cameras, judge), cameras))
        return made

    screen = replace(COARSEST, per_image=SCREENED_POINTS)
    starts = [Cameras(base_from_gripper @ x) for x in starting_hand_eyes(base_from_gripper)]
    ranked = [(cost_of(levels[screen.height], cameras, screen), cameras) for cameras in starts]
    ranked = sorted(ranked, key=lambda each: each[0])[:KEPT]
    coarse = refined(ranked, COARSEST, COARSE, 0.1, 0.4)
    (cost, best), *rivals = _distinct(refined(_distinct(coarse)[:KEPT_BASINS], COARSE, JUDGE, 0.5, 0.2))
    if rivals and cost > CLEARLY_BETTER * rivals[0][0]:
        raise RejectedError(
            f"direct alignment: cameras at different places explain the images alike (cost {cost:.3f} and "
            f"{rivals[0][0]:.3f})",
            "take more images, from more sides, of more and different objects",
        )
    return best


def starting_hand_eyes(base_from_gripper: Float[ndarray, "n 4 4"]) -> Float[ndarray, "t 4 4"]:
    """Return t initial gripper_from_camera, without translation, by which all cameras look at one place.

    They have the common viewing direction or one of TILTS directions that are tilted from it by TILT_DEG. Each
    direction has ROTATIONS rotations about it.
    """
    # Directions distributed evenly over the sphere (Fibonacci spiral).
    k = np.arange(600) + 0.5
    height, around = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    z = np.column_stack([flat * np.cos(around), flat * np.sin(around), height])
    x = np.cross(z, np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    facing = np.stack([x, np.cross(z, x), z], -1)
    cameras = base_from_gripper @ transform(facing, np.zeros(3))[:, None]
    towards = axes_intersection(cameras)[:, None] - cameras[..., :3, 3]
    cosine = (towards * cameras[..., :3, 2]).sum(-1) / np.maximum(np.linalg.norm(towards, axis=-1), 1e-9)
    best = facing[cosine.mean(1).argmax()]
    rotation = 2 * np.pi * np.arange(ROTATIONS) / ROTATIONS
    toward = 2 * np.pi * np.arange(TILTS) / TILTS
    tilt = np.radians(TILT_DEG) * np.column_stack([np.cos(toward), np.sin(toward), 0 * toward])
    tilts = rotation_exp(np.concatenate([np.zeros((1, 3)), tilt]))
    rotations = best @ tilts[:, None] @ rotation_exp(rotation[:, None] * [0.0, 0.0, 1.0])
    return transform(rotations.reshape(-1, 3, 3), np.zeros(3))


def _distinct(found: Sequence[tuple[float, Cameras]]) -> list[tuple[float, Cameras]]:
    """Return (cost, cameras) of the best of each group of nearly equal results, best first.

    Two results are nearly equal if the poses of their first cameras differ by less than SAME_M and SAME_DEG.
    """
    kept: list[tuple[float, Cameras]] = []
    for cost, cameras in sorted(found, key=lambda each: each[0]):
        gaps = [inverse(cameras.base_from_camera[0]) @ other.base_from_camera[0] for _, other in kept]
        if not any(
            np.linalg.norm(gap[:3, 3]) < SAME_M and rotation_between_deg(np.eye(3), gap[:3, :3]) < SAME_DEG
            for gap in gaps
        ):
            kept.append((cost, cameras))
    return kept
