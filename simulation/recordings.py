"""Recordings of a wrist camera: images, gripper poses, and camera poses with noise; nothing is rendered."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from unicodedata import normalize

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.geometry import inverse, retract, rotation_exp, rotation_log, transform
from simulation.poses import Pattern, gripper_poses, random_hand_eye

SIZE = (64, 48)
"""Width and height (px) of the images, which only differ from each other."""
CAMERA_NOISE = (3e-4, float(np.radians(0.03)))
"""Standard deviation of the camera poses on an axis (m, rad), typical of structure from motion over a table."""
STEMS = ("img_{:04d}", "{}", "color_{:02d}", "Ansicht_Tür_{}", "pose-{:03d}", "image{}", "20240503_{:06d}")
"""Names of the images by their number. Files have them in the decomposed form, as on macOS."""
SMALL = 0.12
"""Share of the rotations of a varied motion that remains in a motion with little rotation: 5° to 10°."""
AROUND = 0.07
"""Largest change (m) of the radius of an orbit; at a constant radius the scale is not observed."""
MOTIONS: tuple[Pattern | Literal["small"], ...] = (
    *("varied", "orbit", "varied", "planar", "varied", "orbit", "varied", "one-axis", "varied", "small"),
    *("varied", "orbit", "varied", "translation", "varied", "orbit", "varied", "pivot", "varied", "small"),
    *("varied", "orbit", "varied", "planar", "varied", "orbit", "varied", "camera-centre", "varied", "small"),
)
"""Motion of each of the thirty recordings."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Images and gripper poses of one scene, and the poses of a camera that structure from motion gives."""

    name: str
    files: tuple[Path, ...]
    """Image files in the order in which the images were taken, which is that of their numbers."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Poses that the robot reports."""
    camera_from_board: Float[ndarray, "n 4 4"]
    """Pose of a board that the camera sees at each image."""
    joints: Float[ndarray, "n 6"]
    """Angles (rad) of six joints at each image; they belong to no real arm."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    """Camera poses in an arbitrary frame and unit; empty where the images cannot be reconstructed."""
    image_index: Int[ndarray, " m"]
    """Index of the image of each camera pose."""
    motion: str
    """Pattern of a simulated motion; "real" for a capture of a real robot."""

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.files)


def board_seen(
    base_from_gripper: Float[ndarray, "n 4 4"], gripper_from_camera: Float[ndarray, "4 4"]
) -> Float[ndarray, "n 4 4"]:
    """Return camera_from_board (n,4,4) of a board in front of the middle camera."""
    base_from_camera = base_from_gripper @ gripper_from_camera
    board = base_from_camera[len(base_from_camera) // 2] @ transform(
        np.diag([1.0, -1.0, -1.0]), np.array([-0.05, 0.04, 0.45])
    )
    return inverse(base_from_camera) @ board


def angles_of_joints(count: int, rng: np.random.Generator) -> Float[ndarray, "n 6"]:
    """Draw angles (rad) of six joints about a usual posture."""
    return np.array([0.2, -1.9, 1.8, -1.5, -1.57, 0.4]) + rng.uniform(-0.5, 0.5, (count, 6))


def simulated_recordings(folder: Path, numbers: Sequence[int]) -> list[Recording]:
    """Draw the recordings with these numbers (0 to 29), and write their images below `folder`."""
    return [_simulated(folder / f"simulated_{number:02d}", number) for number in numbers]


def _simulated(folder: Path, number: int) -> Recording:
    """Draw one recording; `number` is its seed and gives its motion and the names of its images."""
    rng, motion = np.random.default_rng([32, number]), MOTIONS[number]
    count = int(rng.integers(8, 21))
    gripper_from_camera = random_hand_eye(rng)
    target = np.array([rng.uniform(0.4, 0.6), rng.uniform(-0.15, 0.15), rng.uniform(-0.05, 0.1)])
    pattern = "varied" if motion == "small" else motion
    true = gripper_poses(pattern, count, target, gripper_from_camera, rng)
    if motion == "orbit":
        nearer = transform(np.eye(3), rng.uniform(-AROUND, AROUND, (count, 1)) * [0.0, 0.0, 1.0])
        true = true @ gripper_from_camera @ nearer @ inverse(gripper_from_camera)
    if motion == "small":
        turned = rotation_exp(SMALL * rotation_log(true[:, :3, :3] @ true[0, :3, :3].T)) @ true[0, :3, :3]
        true = transform(turned, true[:, :3, 3])
    turned_base = transform(rotation_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])), np.zeros(3))
    true = turned_base @ true
    spread = np.exp(rng.uniform(np.log([1e-4, np.radians(0.02)]), np.log([1e-3, np.radians(0.2)])))
    reported = retract(true, rng.normal(size=(count, 6)) * np.repeat(spread, 3))
    seen = retract(true @ gripper_from_camera, rng.normal(size=(count, 6)) * np.repeat(CAMERA_NOISE, 3))
    frame = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    camera = frame @ seen
    camera[:, :3, 3] *= rng.uniform(0.5, 20.0)
    registered = np.sort(rng.permutation(count)[: count - number % 3 // 2])
    return Recording(
        name=folder.name,
        files=_write_images(folder, STEMS[number % len(STEMS)], count, rng),
        base_from_gripper=reported,
        camera_from_board=board_seen(reported, gripper_from_camera),
        joints=angles_of_joints(count, rng),
        recon_from_camera=camera[registered],
        image_index=registered,
        motion=motion,
    )


def _write_images(folder: Path, stem: str, count: int, rng: np.random.Generator) -> tuple[Path, ...]:
    """Write images of different random textures, and return their paths."""
    folder.mkdir(parents=True)
    names = [normalize("NFD", stem.format(number)) for number in range(1, count + 1)]
    files = tuple(folder / f"{name}.png" for name in names)
    for file in files:
        coarse = rng.integers(0, 256, (SIZE[1] // 8, SIZE[0] // 8, 3), dtype=np.uint8)
        _, content = cv2.imencode(".png", cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC))
        file.write_bytes(content.tobytes())
    return files
