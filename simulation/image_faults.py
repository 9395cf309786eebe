"""Captures of rendered images with faults: of camera and robot (simulation.faults), of stored images, of single poses.

A capture is drawn from a scene that was rendered once, wider than a camera sees, so that any camera's images are a
warp of them: some of its views in their order, each warped as its camera has it, and poses with random errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.capture.formats import capture_json
from jcr.estimation.arms import RobotName, arm_named
from jcr.files import write_bytes
from jcr.geometry import inverse, rotation_exp, transform
from jcr.records import Capture, Intrinsics
from simulation.arms import PRESETS, bend
from simulation.capture import encode_jpeg
from simulation.faults import Faults, effective_transform, moved_parts, optics_of, reported_poses
from simulation.motion import motion_over_table
from simulation.problems import disturbed
from simulation.render import render
from simulation.scene_faults import SceneChange
from simulation.scenes import Scene, make_scene, moved

Poses = Float[ndarray, "n 4 4"]
Images = list[UInt8[ndarray, "h w 3"]]
IMAGES = 8
"""Images of a capture."""
FIRST_NUMBER = 5
"""First number in the images' names; the later ones have two digits."""
NOISE_GREY, JPEG_QUALITY = 2.0, 92
SIZE, WIDE = (640, 480), (960, 720)
"""Sizes (px) of a camera's images and of those rendered, of one focal length."""
FOCAL_PX = (600.0, 660.0)
POSES = 14
ARMS: tuple[RobotName | None, ...] = (None, "ur5e", None, "panda", None)
"""Arms of the scenes in turn; None is a gripper whose poses have no systematic errors."""

PxFromPx = Callable[[Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]
"""Pixels of the believed camera that have the content of pixels of the real one."""


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """Views of a scene from POSES places, with the truth."""

    images: tuple[UInt8[ndarray, "h w 3"], ...]
    """Images (RGB) of size WIDE."""
    scene: Scene
    base_from_camera: Float[ndarray, "n 4 4"]
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

    def changed(self, rows: Int[ndarray, " k"], change: SceneChange) -> list[UInt8[ndarray, "h w 3"]]:
        """Render images of size WIDE from places, each of the scene as it is when that image is taken."""
        return [
            next(render(change(self.scene, k, pose), _wide(self.camera), [pose], with_truth=False)).image
            for k, pose in enumerate(self.base_from_camera[rows])
        ]


def taken(wide: UInt8[ndarray, "h w 3"], believed_from_px: PxFromPx) -> UInt8[ndarray, "h w 3"]:
    """Return the image of size SIZE that a camera takes, from the rendered one of size WIDE."""
    margin = (np.array(WIDE) - SIZE) / 2
    px = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
    x, y = np.moveaxis(believed_from_px(px) + margin, -1, 0).astype(np.float32)
    return np.asarray(cv2.remap(wide, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), np.uint8)


def _wide(camera: Intrinsics) -> Intrinsics:
    """Return the camera of images of size WIDE."""
    return replace(camera, cx=(WIDE[0] - 1) / 2, cy=(WIDE[1] - 1) / 2, width=WIDE[0], height=WIDE[1])


@cache
def rendered(seed: int) -> Rendered:
    """Render the table top scene of that seed, once."""
    errors, motion, elsewhere, intrinsics = (np.random.default_rng([seed, 20 + k]) for k in range(4))
    scene, name = make_scene("tabletop", seed), ARMS[seed % len(ARMS)]
    preset = PRESETS["typical"]
    bent = None if name is None else bend(arm_named(name), preset, errors)
    path = motion_over_table(bent, POSES, scene.table_center_in_base, (motion, elsewhere))
    scene, cameras = moved(scene, path.target_in_base), path.base_from_gripper @ path.physical
    focal_px = float(intrinsics.uniform(*FOCAL_PX))
    camera = Intrinsics(focal_px, focal_px, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, *SIZE)
    return Rendered(
        images=tuple(view.image for view in render(scene, _wide(camera), cameras, with_truth=False)),
        scene=scene,
        base_from_camera=cameras,
        camera=camera,
        base_from_gripper=path.reported,
        distance=np.linalg.norm(cameras[:, :3, 3] - scene.table_center_in_base, axis=1),
        gripper_from_camera=path.effective,
        white=(3e-4, 1e-3) if bent is None else preset.white,
    )


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Capture in the making."""

    images: Images
    base_from_gripper: Poses
    """Reported poses."""
    camera: Intrinsics | None
    """Given intrinsics."""
    gripper_from_camera: Float[ndarray, "k 4 4"]
    """True transforms: one, or before and after a motion of the camera on the gripper."""
    names: tuple[str, ...]


Change = Callable[[Drawn, np.random.Generator], Drawn]


@dataclass(frozen=True, kw_only=True)
class ImageFault:
    """One fault of a capture of images; none by default."""

    faults: Faults = Faults()
    change: Change | None = None
    """Fault of stored images or single poses."""
    scene: SceneChange | None = None
    """Change of the scene while the images are taken."""
    board: str | None = None
    """Board that the user states."""
    wrong: tuple[int, ...] = ()
    """Rows of the images whose poses or content are wrong, so that no result may rest on them."""


def rows_of(scene: Rendered, seed: int) -> Int[ndarray, " n"]:
    """Draw the rows of the scene's views that are the images of a capture."""
    return np.sort(np.random.default_rng([seed, 30]).permutation(len(scene.images))[:IMAGES])


def draw(scene: Rendered, seed: int, fault: ImageFault, given: bool = True) -> Drawn:
    """Draw a capture of a scene with or without `given` intrinsics; views and random errors follow from the seed."""
    noise, pixels, of_faults, of_change = (np.random.default_rng([seed, 31 + k]) for k in range(4))
    rows, faults, x = rows_of(scene, seed), fault.faults, scene.gripper_from_camera
    mounts, pushes = moved_parts(x, IMAGES, faults, of_faults)
    # The images are those of the scene, so the gripper is where they would be of the moved camera and base.
    cameras = scene.base_from_gripper[rows] @ x
    true = inverse(pushes) @ cameras @ inverse(mounts)
    optics = optics_of(faults, scene.camera, scene.distance[rows], of_faults)
    wide = [scene.images[row] for row in rows] if fault.scene is None else scene.changed(rows, fault.scene)
    images = [
        with_noise(taken(one, by.believed_from_px), pixels) for one, by in zip(wide, optics, strict=True)
    ]
    truths = [x] if np.allclose(mounts[0], mounts[-1]) else [mounts[0], mounts[-1]]
    if faults.is_bent:
        truths = [effective_transform(scene.base_from_gripper, x, faults)]
    drawn = Drawn(
        images=images,
        base_from_gripper=reported_poses(true, faults),
        camera=scene.camera if given else None,
        gripper_from_camera=np.stack(truths),
        # The order of taking is not that of the names as text.
        names=tuple(f"view_{k + FIRST_NUMBER}.jpg" for k in range(IMAGES)),
    )
    if fault.change is not None:
        drawn = fault.change(drawn, of_change)
    return replace(drawn, base_from_gripper=disturbed(drawn.base_from_gripper, scene.white, noise))


def write(drawn: Drawn, folder: Path) -> Path:
    """Write a capture folder with images and capture.json, and return it."""
    for name, image in zip(drawn.names, drawn.images, strict=True):
        write_bytes(folder / name, encode_jpeg(image, JPEG_QUALITY))
    height, width = drawn.images[0].shape[:2]
    capture = Capture(
        folder=folder,
        images=drawn.names,
        base_from_gripper=drawn.base_from_gripper,
        image_size=(width, height),
        intrinsics=drawn.camera,
    )
    capture_json.write(folder, capture)
    return folder


def with_noise(image: UInt8[ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
    """Return an image with the noise of a sensor."""
    noise = rng.normal(0, NOISE_GREY, image.shape)
    return np.clip(image + noise + 0.5, 0, 255).astype(np.uint8)


# Stored images.


def _of_each(change: Callable[[int, UInt8[ndarray, "h w 3"], np.random.Generator], ndarray]) -> Change:
    """Return the change of a capture by that of each of its images, given its row."""
    return lambda drawn, rng: replace(
        drawn, images=[change(k, image, rng).astype(np.uint8) for k, image in enumerate(drawn.images)]
    )


def exposed(std: float) -> Change:
    """Choose exposure and white balance anew for each image: log-normal gains of the channels, common and separate."""
    return _of_each(
        lambda k, image, rng: np.clip(
            image * np.exp(std * (rng.normal() + 0.2 * rng.normal(size=3))) + 0.5, 0, 255
        )
    )


def blurred(length_px: int, rows: Sequence[int]) -> Change:
    """Blur some images by motion in random directions."""

    def change(k: int, image: UInt8[ndarray, "h w 3"], rng: np.random.Generator) -> ndarray:
        if k not in rows:
            return image
        line, middle = np.zeros((length_px, length_px), np.float32), length_px // 2
        angle = rng.uniform(0, np.pi)
        reach = middle * np.array([np.cos(angle), np.sin(angle)])
        ends = np.rint([middle - reach, middle + reach]).astype(int)
        cv2.line(line, ends[0].tolist(), ends[1].tolist(), 1.0)
        return np.asarray(cv2.filter2D(image, -1, line / line.sum()))

    return _of_each(change)


mirrored: Change = _of_each(lambda k, image, rng: image[:, ::-1])
"""Mirror the images, as some drivers do."""
halved: Change = _of_each(
    lambda k, image, rng: np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
)
"""Store images of half the resolution beside the intrinsics of the whole one."""


def repeated(first: int, rows: Sequence[int]) -> Change:
    """Deliver a frame again while the arm has moved on."""
    return lambda drawn, rng: replace(
        drawn, images=[drawn.images[first] if k in rows else image for k, image in enumerate(drawn.images)]
    )


def sorted_as_text(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Store images in the order of their names as text, poses in that of taking."""
    order = sorted(range(len(drawn.names)), key=lambda k: drawn.names[k])
    images, names = [drawn.images[k] for k in order], tuple(drawn.names[k] for k in order)
    return replace(drawn, images=images, names=names)


def inverted(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Report gripper_from_base as the gripper poses."""
    return replace(drawn, base_from_gripper=inverse(drawn.base_from_gripper))


def reversed_poses(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Report the poses in the reverse order of the images."""
    return replace(drawn, base_from_gripper=drawn.base_from_gripper[::-1])


# Single poses.


def one_off(mm: float, deg: float, row: int) -> Change:
    """Report one gripper pose wrong by a step about and along random axes."""

    def change(drawn: Drawn, rng: np.random.Generator) -> Drawn:
        poses, axes = drawn.base_from_gripper.copy(), rng.normal(size=(2, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        poses[row] = poses[row] @ transform(rotation_exp(np.radians(deg) * axes[0]), 1e-3 * mm * axes[1])
        return replace(drawn, base_from_gripper=poses)

    return change


def reordered(order: Int[ndarray, " n"]) -> Change:
    """Report poses in another order than the images."""
    return lambda drawn, rng: replace(drawn, base_from_gripper=drawn.base_from_gripper[order])
