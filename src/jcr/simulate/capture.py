"""A simulated capture: what a wrist camera sees on its way over a scene, written with the truth beside it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.geometry import rotation_exp
from jcr.progress import Progress, silent, steps
from jcr.records import Intrinsics
from jcr.simulate.poses import Pattern, gripper_poses, random_hand_eye
from jcr.simulate.render import render
from jcr.simulate.scenes import SceneName, TableName, make_scene
from jcr.simulate.truth import Truth, write_depth, write_labels, write_truth

_WIDTH, _HEIGHT = 640, 480


@dataclass(frozen=True)
class SimulateOptions:
    """What to simulate."""

    scene: SceneName = "tabletop"
    """Objects and table: a mix on wood; 8 or 7 items on a plain light table; 7 on a plain dark one; tape,
    box, mug and toolbox for measuring."""
    images: int = 12
    """How many images; of the pattern `varied` fewer are the first ones of more (`two` has 2)."""
    pattern: Pattern = "varied"
    """Path of the wrist. All but `varied` leave part of the calibration unobservable: an orbit at one radius,
    pure translation, a turntable, xyz + yaw (SCARA), turning about a tool point or about the camera's centre,
    two images."""
    seed: int = 0
    """Objects, layout, textures, lamp, lens, hand-eye and poses all follow from it."""
    texture: bool = True
    """Print and grain on the surfaces; without, each has one uniform colour, with nothing for features."""
    table: TableName | None = None
    """Light or dark table top (unset: as the scene has it)."""
    robot_noise: tuple[float, float] = (0.0, 0.0)
    """Sigma per axis, in mm and degrees, of Gaussian errors of the gripper poses in capture.json; the images
    show the true ones."""
    unknown_intrinsics: bool = False
    """Leave the intrinsics out of capture.json. (Known or not, the lens is a pinhole without distortion.)"""
    noise: float = 0.0
    """Sigma of the pixel noise, in grey levels of 255."""
    blur: float = 0.0
    """Sigma of the blur, in pixels."""
    vignetting: float = 0.0
    """Share of light lost in the corners, 0 to 1."""
    jpeg_quality: int | Literal["lossless"] = 90
    """1 to 100, or lossless: PNG."""
    truth: Literal["full", "scene"] = "full"
    """Write truth/ with depth and labels of every image, or with scene.json alone."""


def simulate(out: Path, options: SimulateOptions = SimulateOptions(), progress: Progress = silent) -> Path:
    """Write a capture folder with reference.json and truth/ to `out`, and return `out`.

    The same options give the same capture.json and truth/scene.json, and on one machine the same images.
    Raises InputError for options that mean nothing, where `out` holds something already, and where MuJoCo or
    an OpenGL library is missing.
    """
    _check(out, options)
    # One stream of random numbers a matter: a change in one must not disturb the others.
    motion, lens, robot = (np.random.default_rng([options.seed, stream]) for stream in (4, 5, 6))
    scene = make_scene(options.scene, options.seed, options.table)
    gripper_from_camera = random_hand_eye(motion)
    base_from_gripper = gripper_poses(
        options.pattern, options.images, scene.table_center_in_base, gripper_from_camera, motion
    )
    suffix = "png" if options.jpeg_quality == "lossless" else "jpg"
    truth = Truth(
        folder=out,
        scene=scene.name,
        seed=options.seed,
        images=tuple(f"images/{k:02d}.{suffix}" for k in range(len(base_from_gripper))),
        gripper_from_camera=gripper_from_camera,
        base_from_gripper=base_from_gripper,
        base_from_camera=base_from_gripper @ gripper_from_camera,
        intrinsics=_pinhole(lens),
        labels=scene.labels,
        table_height=scene.table_height,
        workspace_in_base=scene.workspace_in_base,
        objects=scene.true_objects,
    )
    views = render(
        scene, truth.intrinsics, truth.base_from_camera, options.texture, with_truth=options.truth == "full"
    )
    for k, view in zip(steps(progress, "render", range(len(truth.images))), views, strict=True):
        image = _degraded(view.image, options, np.random.default_rng([options.seed, 7, k]))
        write_bytes(out / truth.images[k], _encoded(image, options.jpeg_quality))
        if view.depth is not None and view.label is not None:
            write_depth(truth, k, view.depth)
            write_labels(truth, k, view.label)
    write_truth(truth)
    reference = {"gripper_from_camera": gripper_from_camera.tolist(), "how": "simulated, exact"}
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    # Last: a folder with a capture.json is a complete capture.
    write_text(out / "capture.json", json.dumps(_capture_json(truth, options, robot), indent=1) + "\n")
    return out


def _check(out: Path, options: SimulateOptions) -> None:
    if not 1 <= options.images <= 1000:
        raise InputError(f"--images {options.images}: give 1 to 1000")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: give 0 or more")
    if options.jpeg_quality != "lossless" and not 1 <= options.jpeg_quality <= 100:
        raise InputError(f"--jpeg-quality {options.jpeg_quality}: give 1 to 100, or lossless for PNG")
    if min(*options.robot_noise, options.noise, options.blur) < 0:
        raise InputError("--robot-noise, --noise and --blur are sigmas: give 0 or more")
    if not 0 <= options.vignetting <= 1:
        raise InputError(f"--vignetting {options.vignetting}: give 0 to 1")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: exists already and is no empty folder; name a new one, or remove it first")


def _pinhole(rng: np.random.Generator) -> Intrinsics:
    """A lens of 40° to 48° vertical field of view, as webcams and the colour side of depth cameras have.

    MuJoCo's image spans [-½, W-½] when pixel (0, 0) is the centre of a pixel, so its middle is (W-1)/2.
    """
    focal_px = float(0.5 * _HEIGHT / np.tan(0.5 * np.radians(rng.uniform(40, 48))))
    return Intrinsics(focal_px, focal_px, (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2, _WIDTH, _HEIGHT)


def _capture_json(truth: Truth, options: SimulateOptions, rng: np.random.Generator) -> dict[str, object]:
    camera = truth.intrinsics
    known = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
    reported = with_robot_noise(truth.base_from_gripper, *options.robot_noise, rng)
    return {
        "frames": [
            {"image": image, "base_from_gripper": matrix.tolist()}
            for image, matrix in zip(truth.images, reported, strict=True)
        ],
        "intrinsics": None if options.unknown_intrinsics else known | {"distortion": list(camera.distortion)},
        "source": {"program": "jcr simulate", "options": asdict(options)},
    }


def with_robot_noise(
    base_from_gripper: Float[ndarray, "n 4 4"],
    translation_mm: float,
    rotation_deg: float,
    rng: np.random.Generator,
) -> Float[ndarray, "n 4 4"]:
    """What a robot of that accuracy reports: x + dx and exp(dr)·R, independent Gaussians in every axis."""
    reported = base_from_gripper.copy()
    shift, turn = rng.normal(size=(len(reported), 2, 3)).swapaxes(0, 1)
    reported[:, :3, 3] += 1e-3 * translation_mm * shift
    reported[:, :3, :3] = rotation_exp(np.radians(rotation_deg) * turn) @ reported[:, :3, :3]
    return reported


def _degraded(
    image: UInt8[ndarray, "h w 3"], options: SimulateOptions, rng: np.random.Generator
) -> UInt8[ndarray, "h w 3"]:
    """The image of a cheaper camera: blurred, darker towards the corners, noisy."""
    light = image.astype(np.float32)
    if options.blur:
        light = cv2.GaussianBlur(light, (0, 0), options.blur)
    if options.vignetting:
        height, width = image.shape[:2]
        x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
        light *= (1 - options.vignetting * 0.5 * (x * x + y * y))[..., None]
    if options.noise:
        light += rng.normal(0, options.noise, image.shape)
    return np.clip(light + 0.5, 0, 255).astype(np.uint8)


def _encoded(image: UInt8[ndarray, "h w 3"], jpeg_quality: int | Literal["lossless"]) -> bytes:
    """RGB as JPEG of that quality, or as PNG."""
    if jpeg_quality == "lossless":
        return encode_png(image)
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
