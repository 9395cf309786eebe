"""Scenes rendered once for many captures: wider than a camera sees, so that any camera's images are a warp of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.estimation.arms import RobotName, arm_named
from jcr.geometry import transform
from jcr.records import Intrinsics
from simulation.arms import PRESETS, bend
from simulation.motion import motion_over_table
from simulation.render import render
from simulation.scenes import Scene, make_scene, moved

SIZE, WIDE = (640, 480), (960, 720)
"""Sizes (px) of a camera's images and of those rendered, of one focal length."""
FOCAL_PX = (600.0, 660.0)
POSES = 14
PUSHED, BY_M = 3, (0.04, 0.045, 0.0)
"""Number of objects that are pushed, and their motion."""
ARMS: tuple[RobotName | None, ...] = (None, "ur5e", None, "panda", None)
"""Arms of the scenes in turn; None is a gripper whose poses have no systematic errors."""

PxFromPx = Callable[[Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]
"""Pixels of the believed camera that have the content of pixels of the real one."""


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """Views of a scene from POSES places, with the truth."""

    images: tuple[UInt8[ndarray, "h w 3"], ...]
    """Images (RGB) of size WIDE."""
    images_pushed: tuple[UInt8[ndarray, "h w 3"], ...]
    """Images after somebody pushed objects aside."""
    camera: Intrinsics
    """Intrinsics of images of size SIZE."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Poses by nominal kinematics, without random errors."""
    distance: Float[ndarray, " n"]
    """Distance (m) from the camera to the middle of the objects."""
    gripper_from_camera: Float[ndarray, "4 4"]
    """Effective transform where the arm has systematic errors."""
    white: tuple[float, float]
    """Standard deviations (m, rad per axis) of random errors of the poses."""

    def seen(self, row: int, believed_from_px: PxFromPx, pushed: bool = False) -> UInt8[ndarray, "h w 3"]:
        """Return the image that a camera takes at a place."""
        margin = (np.array(WIDE) - SIZE) / 2
        px = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
        x, y = np.moveaxis(believed_from_px(px) + margin, -1, 0).astype(np.float32)
        wide = (self.images_pushed if pushed else self.images)[row]
        return np.asarray(cv2.remap(wide, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)


def rendered(seed: int) -> Rendered:
    """Render the table top scene of that seed."""
    errors, motion, elsewhere, intrinsics = (np.random.default_rng([seed, 20 + k]) for k in range(4))
    scene, name = make_scene("tabletop", seed), ARMS[seed % len(ARMS)]
    preset = PRESETS["typical"]
    bent = None if name is None else bend(arm_named(name), preset.sizes, errors)
    path = motion_over_table(bent, "varied", POSES, scene.table_center_in_base, (motion, elsewhere))
    scene, cameras = moved(scene, path.target_in_base), path.base_from_gripper @ path.physical
    focal_px = float(intrinsics.uniform(*FOCAL_PX))
    (width, height), (wide, high) = SIZE, WIDE
    wide_camera = Intrinsics(focal_px, focal_px, (wide - 1) / 2, (high - 1) / 2, wide, high)
    first, second = (
        tuple(view.image for view in render(one, wide_camera, cameras, with_truth=False))
        for one in (scene, pushed(scene))
    )
    return Rendered(
        images=first,
        images_pushed=second,
        camera=Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height),
        base_from_gripper=path.reported,
        distance=np.linalg.norm(cameras[:, :3, 3] - scene.table_center_in_base, axis=1),
        gripper_from_camera=path.effective,
        white=(3e-4, 1e-3) if bent is None else preset.white,
    )


def pushed(scene: Scene) -> Scene:
    """Return the scene with its first objects elsewhere on the table."""
    by = transform(np.eye(3), np.array(BY_M))
    others = [replace(one, base_from_object=by @ one.base_from_object) for one in scene.objects[:PUSHED]]
    return replace(scene, objects=(*others, *scene.objects[PUSHED:]))
