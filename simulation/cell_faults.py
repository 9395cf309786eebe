"""Rendered images of a further camera of a cell with one fault, beside a rendered capture, and the true placements."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.files import write_bytes
from jcr.geometry import inverse, rotation_exp, transform
from jcr.records import CellCamera
from simulation.capture import encode_jpeg
from simulation.faults import Faults, moved_parts, reported_poses
from simulation.image_faults import IMAGES, JPEG_QUALITY, SIZE, Rendered, rows_of, with_noise
from simulation.motion import fixed_camera, motion_over_table
from simulation.problems import disturbed
from simulation.render import render

CellKind = Literal["fixed", "wrist", "arm"]
"""Mount of the further camera: beside the table, on the same gripper, or on a second arm."""
FIXED_IMAGES, FIXED_AWAY = 2, 0.4
"""Images of a fixed camera, and its horizontal distance (m) from the middle of the table."""
ARM_IMAGES = 12
"""Images of the camera of a second arm."""
BASE_FROM_OTHER = transform(rotation_exp(np.array([0.05, -0.03, 2.5])), np.array([0.9, 0.2, 0.01]))
"""Base of the second arm in that of the first."""


def further_camera(
    kind: CellKind, faults: Faults, scene: Rendered, seed: int, folder: Path
) -> tuple[CellCamera, list[Float[ndarray, "4 4"]]]:
    """Draw a further camera beside the capture of `scene` with the same seed, and write its images to `folder`.

    Of `faults`, `slip` moves the camera midway (a fixed camera between its two images), and `delay_s` delays the poses
    of a second arm. The scene has an arm without systematic errors. Returned with the camera are the true transforms
    (base_from_camera or gripper_from_camera): one, or two where the camera moved.
    """
    motion, elsewhere, of_faults, noise, pixels = (np.random.default_rng([seed, 50 + k]) for k in range(5))
    target, base_from_gripper, frame = scene.scene.table_center_in_base, None, None
    if kind == "fixed":
        mounts, _ = moved_parts(fixed_camera(target, FIXED_AWAY, motion), FIXED_IMAGES, faults, of_faults)
        cameras = mounts
    elif kind == "wrist":
        frame = np.arange(IMAGES)
        beside = transform(rotation_exp(0.1 * motion.normal(size=3)), 0.04 * motion.normal(size=3))
        mounts, _ = moved_parts(scene.gripper_from_camera @ beside, IMAGES, faults, of_faults)
        cameras = scene.base_from_gripper[rows_of(scene, seed)] @ mounts
    else:
        path = motion_over_table(None, ARM_IMAGES, target, (motion, elsewhere))
        mounts, _ = moved_parts(path.physical, ARM_IMAGES, faults, of_faults)
        cameras = path.base_from_gripper @ mounts
        reported = reported_poses(inverse(BASE_FROM_OTHER) @ path.base_from_gripper, faults)
        base_from_gripper = disturbed(reported, scene.white, noise)
    names = tuple(f"further_{k}.jpg" for k in range(len(cameras)))
    views = render(scene.scene, scene.camera, cameras, with_truth=False)
    for name, view in zip(names, views, strict=True):
        write_bytes(folder / name, encode_jpeg(with_noise(view.image, pixels), JPEG_QUALITY))
    camera = CellCamera(
        name=kind,
        mount="base" if kind == "fixed" else "gripper",
        images=names,
        image_size=SIZE,
        intrinsics=scene.camera,
        folder=folder,
        frame=frame,
        arm="second" if kind == "arm" else None,
        base_from_gripper=base_from_gripper,
    )
    truths = [mounts[0]] if np.allclose(mounts[0], mounts[-1]) else [mounts[0], mounts[-1]]
    return camera, truths
