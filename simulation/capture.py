"""Simulated captures: images of a wrist camera on its way over a scene, of fixed cameras, and the ground truth."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.formats import capture_json
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.geometry import retract
from jcr.progress import Progress, silent, steps
from jcr.records import Capture, CellCamera, FrameNames, Intrinsics
from simulation.motion import fixed_camera
from simulation.poses import gripper_poses, random_hand_eye
from simulation.render import render
from simulation.scenes import SceneName, make_scene
from simulation.truth import Truth, write_pixels, write_truth

_WIDTH, _HEIGHT = 640, 480
_RANGES = {
    "images": (1, 1000),
    "vignetting": (0, 1),
    "fixed_cameras": (0, 20),
    "jpeg_quality": (1, 100),
} | dict.fromkeys(("seed", "noise", "blur"), (0, np.inf))
"""Least and largest value of the options."""


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Scene, motion, camera and errors of a simulated capture."""

    scene: SceneName = "tabletop"
    """Objects and table: a mix on wood; 8 or 7 items on a plain light table; 7 on a plain dark one; tape,
    box, mug and toolbox for measuring."""
    images: int = 12
    """Number of images; fewer images are the first ones of more."""
    seed: int = 0
    """Objects, layout, textures, lamp, intrinsics, hand-eye and poses all follow from it."""
    texture: bool = True
    """Print and grain on the surfaces; without, each has one uniform colour, with nothing for features."""
    robot_noise: tuple[float, float] = (0.0, 0.0)
    """Sigma per axis, in mm and degrees, of Gaussian errors of the gripper poses in capture.json; the images
    show the true ones."""
    unknown_intrinsics: bool = False
    """Leave the intrinsics out of capture.json. (Known or not, the camera is a pinhole without distortion.)"""
    noise: float = 0.0
    """Sigma of the pixel noise, in grey levels of 255."""
    blur: float = 0.0
    """Sigma of the blur, in pixels."""
    vignetting: float = 0.0
    """Share of light lost in the corners, 0 to 1."""
    jpeg_quality: int = 90
    """1 to 100."""
    fixed_cameras: int = 0
    """Number of cameras that stand beside the table and see the scene, an image each."""
    truth: Literal["full", "scene"] = "full"
    """Write truth/ with depth and labels of every image, or with scene.json alone."""


FRAME_NAMES = FrameNames(base="base_link", gripper="tool0", camera="camera_color_optical_frame")
"""Names of the frames of the simulated arm."""


def simulate(out: Path, options: SimulateOptions | None = None, progress: Progress = silent) -> Path:
    """Write a capture folder with reference.json and truth/ to `out`, and return `out`.

    The same options give the same capture.json and truth/scene.json, and on one machine the same images.
    Raises InputError for options that mean nothing, where `out` holds something already, and where MuJoCo or
    an OpenGL library is missing.
    """
    _check(out, options := options or SimulateOptions())
    scene = make_scene(options.scene, options.seed)
    # One stream of random numbers a matter: a change in one must not disturb the others.
    path, camera, noise, further = (np.random.default_rng([options.seed, stream]) for stream in (4, 5, 6, 14))
    x = random_hand_eye(path)
    poses = gripper_poses("varied", options.images, scene.table_center_in_base, x, path)
    truth = Truth(
        folder=out,
        scene=scene.name,
        seed=options.seed,
        images=tuple(f"images/{k:02d}.jpg" for k in range(options.images)),
        gripper_from_camera=x,
        base_from_gripper=poses,
        base_from_camera=poses @ x,
        intrinsics=pinhole(camera),
        labels=scene.labels,
        table_height=scene.table_height,
        workspace_in_base=scene.workspace_in_base,
        objects=scene.true_objects,
    )
    is_full = options.truth == "full"
    shown = render(scene, truth.intrinsics, truth.base_from_camera, options.texture, with_truth=is_full)
    for k, view in zip(steps(progress, "render", range(len(truth.images))), shown, strict=True):
        _write_image(out / truth.images[k], view.image, options, [7, k])
        if view.depth is not None and view.label is not None:
            write_pixels(truth, k, view.depth, view.label)
    write_truth(truth)
    reference: dict[str, object] = {"gripper_from_camera": x.tolist(), "how": "simulated, exact"}
    others = []
    for k in range(options.fixed_cameras):
        name, place, own = (
            f"fixed{k}",
            fixed_camera(scene.table_center_in_base, 0.55, further),
            pinhole(further),
        )
        image = f"{name}/00.jpg"
        (view,) = render(scene, own, place[None], options.texture, with_truth=False)
        _write_image(out / image, view.image, options, [15, 0, *name.encode()])
        size, stated = (own.width, own.height), None if options.unknown_intrinsics else own
        others.append(
            CellCamera(name=name, mount="base", images=(image,), image_size=size, intrinsics=stated)
        )
        true = {name: {"base_from_camera": place.tolist()}}
        reference = {"cameras": {}, "arms": {}} | reference
        reference["cameras"] |= true  # type: ignore[operator]
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    capture = Capture(
        folder=out,
        images=truth.images,
        base_from_gripper=with_robot_noise(poses, *options.robot_noise, noise),
        image_size=(truth.intrinsics.width, truth.intrinsics.height),
        intrinsics=None if options.unknown_intrinsics else truth.intrinsics,
        others=tuple(others),
        frame_names=FRAME_NAMES,
    )
    # Last: a folder with a capture.json is a complete capture.
    capture_json.write(out, capture, source={"program": "python -m simulation", "options": asdict(options)})
    return out


def pinhole(rng: np.random.Generator) -> Intrinsics:
    """Draw intrinsics of 40° to 48° vertical field of view, as webcams and the colour side of depth cameras have.

    MuJoCo's image spans [-½, W-½] when pixel (0, 0) is the centre of a pixel, so its middle is (W-1)/2.
    """
    focal_px = float(0.5 * _HEIGHT / np.tan(0.5 * np.radians(rng.uniform(40, 48))))
    return Intrinsics(focal_px, focal_px, (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2, _WIDTH, _HEIGHT)


def with_robot_noise(
    base_from_gripper: Float[ndarray, "n 4 4"],
    translation_mm: float,
    rotation_deg: float,
    rng: np.random.Generator,
) -> Float[ndarray, "n 4 4"]:
    """Return the reported poses: each pose after a step of independent Gaussians in every axis."""
    sizes = np.repeat([1e-3 * translation_mm, np.radians(rotation_deg)], 3)
    return retract(base_from_gripper, sizes * rng.normal(size=(len(base_from_gripper), 6)))


def _write_image(
    path: Path, pixels: UInt8[ndarray, "h w 3"], options: SimulateOptions, stream: Sequence[int]
) -> None:
    """Write the image of a cheaper camera: blurred, darker towards the corners, with noise drawn from `stream`."""
    light = pixels.astype(np.float32)
    if options.blur:
        light = cv2.GaussianBlur(light, (0, 0), options.blur)
    if options.vignetting:
        height, width = pixels.shape[:2]
        x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
        light *= (1 - options.vignetting * 0.5 * (x * x + y * y))[..., None]
    if options.noise:
        light += np.random.default_rng([options.seed, *stream]).normal(0, options.noise, pixels.shape)
    image = np.clip(light + 0.5, 0, 255).astype(np.uint8)
    write_bytes(path, encode_jpeg(image, options.jpeg_quality))


def encode_jpeg(image: UInt8[ndarray, "h w 3"], quality: int) -> bytes:
    """Encode RGB as JPEG of a quality from 1 to 100."""
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _check(out: Path, options: SimulateOptions) -> None:
    """Raise InputError for options out of range, and for a folder that is not new."""
    values = {name: (getattr(options, name), *limits) for name, limits in _RANGES.items()}
    values["robot_noise"] = min(options.robot_noise), 0, np.inf
    for name, (value, low, high) in values.items():
        if not low <= value <= high:
            upper = "or more" if np.isinf(high) else f"to {high}"
            raise InputError(f"--{name.replace('_', '-')} {value}: give {low} {upper}")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: exists already and is no empty folder; name a new one, or remove it first")
