"""What goes wrong with a capture of images: the camera, the images as they are stored, gripper poses, intrinsics.

A capture is drawn from a scene that was rendered once (rendered.py): some of its views in their order, a warp of each
as its camera has it, poses with random errors, and one fault.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.capture.formats import capture_json
from jcr.files import write_bytes
from jcr.geometry import inverse, rotation_exp, transform
from jcr.records import Capture, Intrinsics
from simulation.faults import late
from simulation.problems import disturbed
from simulation.rendered import Rendered
from simulation.taken import encoded

Poses = Float[ndarray, "n 4 4"]
Images = list[UInt8[ndarray, "h w 3"]]
IMAGES = 8
"""Of a capture."""
FIRST_NUMBER = 5
"""In the images' names; the later ones have two digits."""
NOISE_GREY, JPEG_QUALITY = 2.0, 92
GRAVITY = np.array([0.0, 0.0, -1.0])
"""In the base frame."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One image of a capture, as the camera took it."""

    number: int
    count: int
    """Images of the capture."""
    camera: Intrinsics
    far: float
    """-0.5 for the nearest view of the capture to 0.5 for the farthest, about their mean."""
    random: Float[ndarray, "2"]
    """Normal numbers of this image."""


Optics = Callable[[View, Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]
"""Where the pinhole camera that the user believes in has what the real one shows at a pixel."""


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A capture in the making: images, poses as reported, intrinsics as given."""

    images: Images
    base_from_gripper: Poses
    camera: Intrinsics | None
    gripper_from_camera: Float[ndarray, "k 4 4"]
    """All that the camera had; one where it did not move."""
    names: tuple[str, ...]


Change = Callable[[Drawn, np.random.Generator], Drawn]


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong; nothing, by default."""

    optics: Optics | None = None
    change: Change | None = None
    pushed: bool = False
    """Somebody pushed objects aside midway."""
    wrong: tuple[int, ...] = ()
    """Rows of the images whose poses, or whose content, are wrong and that no result may rest on."""


def draw(scene: Rendered, seed: int, fault: Fault, size: float = 1.0, given: bool = True) -> Drawn:
    """A capture of a scene: which views and random errors of its poses follow from the seed alone.

    `size` is that of the poses' random errors, in those of the scene's arm; `given`: the intrinsics are.
    """
    choice, noise, pixels, scatter, of_fault = (np.random.default_rng([seed, 30 + k]) for k in range(5))
    rows = np.sort(choice.permutation(len(scene.images))[:IMAGES])
    spread = scene.distance[rows] - scene.distance[rows].mean()
    far = spread / np.ptp(spread)
    random = scatter.normal(size=(IMAGES, 2))
    images = []
    for k, row in enumerate(rows.tolist()):
        view = View(number=k, count=IMAGES, camera=scene.camera, far=float(far[k]), random=random[k])
        clean = scene.seen(row, _optics(fault, view), fault.pushed and k >= IMAGES // 2)
        images.append(_noisy(clean, pixels))
    white = size * scene.white[0], size * scene.white[1]
    drawn = Drawn(
        images=images,
        base_from_gripper=scene.base_from_gripper[rows],
        camera=scene.camera if given else None,
        gripper_from_camera=scene.gripper_from_camera[None],
        names=names_of_images(),
    )
    if fault.change is not None:
        drawn = fault.change(drawn, of_fault)
    return replace(drawn, base_from_gripper=disturbed(drawn.base_from_gripper, white, noise))


def names_of_images() -> tuple[str, ...]:
    """In the order of taking, which is that of their numbers and not that of their names as text."""
    return tuple(f"view_{k + FIRST_NUMBER}.jpg" for k in range(IMAGES))


def write(drawn: Drawn, folder: Path) -> Path:
    """A capture folder with images and capture.json."""
    for name, image in zip(drawn.names, drawn.images, strict=True):
        write_bytes(folder / name, encoded(image, JPEG_QUALITY))
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


def _optics(fault: Fault, view: View) -> Callable[[Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]:
    optics = fault.optics
    return (lambda px: px) if optics is None else lambda px: optics(view, px)


def _noisy(image: UInt8[ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
    noise = rng.normal(0, NOISE_GREY, image.shape)
    return np.clip(image + noise + 0.5, 0, 255).astype(np.uint8)


# Of the camera.


def _magnified(view: View, px: Float[ndarray, "h w 2"], factor: float) -> Float[ndarray, "h w 2"]:
    centre = np.array([view.camera.cx, view.camera.cy])
    return centre + (px - centre) / factor


def breathing(share: float) -> Optics:
    """A focal length that grows by a share from the nearest view to the farthest."""
    return lambda view, px: _magnified(view, px, 1 + share * view.far)


def zoomed_midway(share: float) -> Optics:
    """A focal length that is longer by a share from midway on."""
    return lambda view, px: _magnified(view, px, 1 + share * (view.number >= view.count // 2))


def zoomed(factor: float) -> Optics:
    """A digital zoom in all images."""
    return lambda view, px: _magnified(view, px, factor)


def distorted(*coefficients: float) -> Optics:
    """A distortion (k1, k2, p1, p2, k3) that nobody gave."""

    def optics(view: View, px: Float[ndarray, "h w 2"]) -> Float[ndarray, "h w 2"]:
        k1, k2, p1, p2, k3 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:5]
        real = replace(view.camera, distortion=(k1, k2, p1, p2, k3))
        return project(view.camera, unproject(real, px))

    return optics


def thin_prism(s1: float) -> Optics:
    """An image that is bent to one side towards its edges, by s1 times the square of the radius."""

    def optics(view: View, px: Float[ndarray, "h w 2"]) -> Float[ndarray, "h w 2"]:
        at = (px - [view.camera.cx, view.camera.cy]) / view.camera.fx
        return px + view.camera.fx * s1 * (at**2).sum(-1, keepdims=True) * [1.0, 0.5]

    return optics


def off_centre(x_px: float, y_px: float) -> Optics:
    """A principal point that is elsewhere than given."""
    return lambda view, px: px - [x_px, y_px]


def stabilised(std_px: float) -> Optics:
    """An image stabiliser that moves the principal point from image to image."""
    return lambda view, px: px - std_px * view.random


def rolling(shift_px: float) -> Optics:
    """A rolling shutter while the wrist moves: the last row is shifted against the first in x, alike in all images."""

    def optics(view: View, px: Float[ndarray, "h w 2"]) -> Float[ndarray, "h w 2"]:
        shift = shift_px * (px[..., 1] / view.camera.height - 0.5)
        return px - np.stack([shift, np.zeros_like(shift)], axis=-1)

    return optics


def mirrored(view: View, px: Float[ndarray, "h w 2"]) -> Float[ndarray, "h w 2"]:
    """A driver that mirrors its images."""
    return np.stack([view.camera.width - 1 - px[..., 0], px[..., 1]], axis=-1)


# Of the images.


def _of_images(change: Callable[[Images, np.random.Generator], Images]) -> Change:
    return lambda drawn, rng: replace(drawn, images=change(drawn.images, rng))


def exposed(std: float) -> Change:
    """Exposure and white balance chosen again for each image: gains of the channels, log-normal, in common and apart."""

    def change(images: Images, rng: np.random.Generator) -> Images:
        gains = np.exp(
            std * rng.normal(size=(len(images), 1)) + 0.2 * std * rng.normal(size=(len(images), 3))
        )
        return [
            np.clip(image * gain + 0.5, 0, 255).astype(np.uint8)
            for image, gain in zip(images, gains, strict=True)
        ]

    return _of_images(change)


def blurred(length_px: int, rows: Sequence[int]) -> Change:
    """Motion blur of some images, in any direction."""

    def change(images: Images, rng: np.random.Generator) -> Images:
        made = list(images)
        for row in rows:
            line = np.zeros((length_px, length_px), np.float32)
            angle, middle = rng.uniform(0, np.pi), length_px // 2
            reach = middle * np.array([np.cos(angle), np.sin(angle)])
            ends = np.rint([middle - reach, middle + reach]).astype(int)
            cv2.line(line, ends[0].tolist(), ends[1].tolist(), 1.0)
            made[row] = np.asarray(cv2.filter2D(images[row], -1, line / line.sum()), np.uint8)
        return made

    return _of_images(change)


def repeated(first: int, rows: Sequence[int]) -> Change:
    """A frame that is delivered again while the arm has moved on."""

    def change(images: Images, rng: np.random.Generator) -> Images:
        return [images[first] if k in rows else image for k, image in enumerate(images)]

    return _of_images(change)


def halved(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Images of half the resolution, intrinsics of the whole one."""
    images = [
        np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        for image in drawn.images
    ]
    return replace(drawn, images=images)


# Of the intrinsics.


def given(**changes: float) -> Change:
    """Factors on numbers of the intrinsics that are given."""

    def change(drawn: Drawn, rng: np.random.Generator) -> Drawn:
        camera = drawn.camera
        assert camera is not None
        return replace(
            drawn,
            camera=replace(
                camera, **{name: factor * getattr(camera, name) for name, factor in changes.items()}
            ),
        )

    return change


# Of the gripper poses.


def _step(metres: float, radians: float, rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    """A step of that size about and along random axes."""
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return transform(rotation_exp(radians * axes[0]), metres * axes[1])


def slipped(mm: float, deg: float) -> Change:
    """The camera moves on the gripper midway, or, by the same equations, another TCP is chosen."""

    def change(drawn: Drawn, rng: np.random.Generator) -> Drawn:
        (x,) = drawn.gripper_from_camera
        after = x @ _step(1e-3 * mm, np.radians(deg), rng)
        poses = drawn.base_from_gripper.copy()
        half = len(poses) // 2
        # The images are those of the camera's old place, so the gripper is where they would be of the new one.
        poses[half:] = poses[half:] @ x @ inverse(after)
        return replace(drawn, base_from_gripper=poses, gripper_from_camera=np.stack([x, after]))

    return change


def _of_poses(change: Callable[[Poses, np.random.Generator], Poses]) -> Change:
    return lambda drawn, rng: replace(drawn, base_from_gripper=change(drawn.base_from_gripper, rng))


def bumped(mm: float, deg: float) -> Change:
    """The robot's base, or the table, is pushed midway."""

    def change(poses: Poses, rng: np.random.Generator) -> Poses:
        half = len(poses) // 2
        return np.concatenate([poses[:half], _step(1e-3 * mm, np.radians(deg), rng) @ poses[half:]])

    return _of_poses(change)


def delayed(delay_s: float, view_s: float) -> Change:
    """Poses that are read late while the arm moves through the views."""
    return _of_poses(lambda poses, rng: late(poses, delay_s, view_s))


def one_off(mm: float, deg: float, row: int) -> Change:
    """One gripper pose that is wrong."""

    def change(poses: Poses, rng: np.random.Generator) -> Poses:
        made = poses.copy()
        made[row] = made[row] @ _step(1e-3 * mm, np.radians(deg), rng)
        return made

    return _of_poses(change)


def reordered(order: Int[ndarray, " n"]) -> Change:
    """Poses in another order than the images."""
    return _of_poses(lambda poses, rng: poses[order])


def sorted_as_text(drawn: Drawn, rng: np.random.Generator) -> Drawn:
    """Images in the order of their names as text, poses in that of taking."""
    order = sorted(range(len(drawn.names)), key=lambda k: drawn.names[k])
    images, names = [drawn.images[k] for k in order], tuple(drawn.names[k] for k in order)
    return replace(drawn, images=images, names=names)


def stretched(x: float, y: float, z: float) -> Change:
    """Positions that are too long along axes of the base."""

    def change(poses: Poses, rng: np.random.Generator) -> Poses:
        made = poses.copy()
        made[:, :3, 3] *= [x, y, z]
        return made

    return _of_poses(change)


def sagging(mm: float, deg: float) -> Change:
    """A tool that its weight bends: aside by so much, and rotated, where gravity pulls it across."""

    def change(drawn: Drawn, rng: np.random.Generator) -> Drawn:
        (x,) = drawn.gripper_from_camera
        poses = drawn.base_from_gripper
        pull = np.einsum("nji,j->ni", poses[:, :3, :3], GRAVITY)
        pull[:, 2] = 0.0
        about = np.cross([0.0, 0.0, 1.0], pull)
        bent = transform(rotation_exp(np.radians(deg) * about), 1e-3 * mm * pull)
        # Seen from the camera, the gripper is elsewhere than a straight tool would have it.
        return replace(
            drawn,
            base_from_gripper=poses @ inverse(bent),
            gripper_from_camera=(
                transform(rotation_exp(np.radians(deg) * about.mean(0)), 1e-3 * mm * pull.mean(0)) @ x
            )[None],
        )

    return change
