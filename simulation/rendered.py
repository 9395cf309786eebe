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
from simulation.arms import PRESETS, bend, effective_about, hand_eye_on, patterned, table_center
from simulation.poses import gripper_poses, random_hand_eye
from simulation.render import render
from simulation.scenes import Scene, make_scene, moved

SIZE, WIDE = (640, 480), (960, 720)
"""px: of a camera's images, and of those rendered, of the same focal length."""
FOCAL_PX = (600.0, 660.0)
POSES = 14
PUSHED, BY_M = 3, (0.04, 0.045, 0.0)
"""Number of pushed objects, and their displacement (m)."""
ARMS: tuple[RobotName | None, ...] = (None, "ur5e", None, "panda", None)
"""Arm of each scene; None: a gripper whose poses have no systematic errors."""

PxFromPx = Callable[[Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]
"""Map from the pixels of the real camera to those of the assumed pinhole camera."""


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """A scene as it is seen from POSES places, and what is true there."""

    images: tuple[UInt8[ndarray, "h w 3"], ...]
    """RGB, of size WIDE."""
    images_pushed: tuple[UInt8[ndarray, "h w 3"], ...]
    """Images after somebody pushed objects aside."""
    camera: Intrinsics
    """Intrinsics of an image of size SIZE."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Gripper poses of nominal kinematics, without random errors."""
    distance: Float[ndarray, " n"]
    """m, from the camera to the middle of the objects."""
    gripper_from_camera: Float[ndarray, "4 4"]
    """The effective one, where the arm has systematic errors."""
    white: tuple[float, float]
    """m, rad per axis: random errors of that arm's poses."""

    def seen(self, row: int, believed_from_px: PxFromPx, pushed: bool = False) -> UInt8[ndarray, "h w 3"]:
        """The image that a camera takes at a place."""
        margin = (np.array(WIDE) - SIZE) / 2
        px = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
        x, y = np.moveaxis(believed_from_px(px) + margin, -1, 0).astype(np.float32)
        wide = (self.images_pushed if pushed else self.images)[row]
        return np.asarray(cv2.remap(wide, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)


def rendered(seed: int) -> Rendered:
    """The table top scene of that seed."""
    hand_eye, motion, errors, elsewhere, intrinsics = (
        np.random.default_rng([seed, 20 + k]) for k in range(5)
    )
    scene = make_scene("tabletop", seed)
    name = ARMS[seed % len(ARMS)]
    if name is None:
        x = effective = random_hand_eye(hand_eye)
        true = reported = gripper_poses("varied", POSES, scene.table_center_in_base, x, motion)
        white = 3e-4, 1e-3
    else:
        arm, preset = arm_named(name), PRESETS["typical"]
        bent = bend(arm, preset.sizes, errors)
        target = table_center(arm)
        scene = moved(scene, target)
        x = hand_eye_on(arm, hand_eye)
        joints = patterned(arm, "varied", POSES, target, x, motion)
        effective = effective_about(bent, x, POSES, elsewhere, target).gripper_from_camera
        true, reported, white = bent.true(joints), bent.reported(joints), preset.white
    focal_px = float(intrinsics.uniform(*FOCAL_PX))
    (width, height), (wide, high) = SIZE, WIDE
    wide_camera = Intrinsics(focal_px, focal_px, (wide - 1) / 2, (high - 1) / 2, wide, high)
    first, second = (
        tuple(view.image for view in render(one, wide_camera, true @ x, with_truth=False))
        for one in (scene, pushed(scene))
    )
    return Rendered(
        images=first,
        images_pushed=second,
        camera=Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height),
        base_from_gripper=reported,
        distance=np.linalg.norm((true @ x)[:, :3, 3] - scene.table_center_in_base, axis=1),
        gripper_from_camera=effective,
        white=white,
    )


def pushed(scene: Scene) -> Scene:
    """The scene with its first objects elsewhere on the table."""
    by = transform(np.eye(3), np.array(BY_M))
    others = [replace(one, base_from_object=by @ one.base_from_object) for one in scene.objects[:PUSHED]]
    return replace(scene, objects=(*others, *scene.objects[PUSHED:]))
