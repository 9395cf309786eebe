"""A simulated capture: what a wrist camera sees on its way over a scene, written with the truth beside it."""

import ctypes.util
import json
import os
import platform
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.geometry import rotation_exp
from jcr.records import Intrinsics
from jcr.simulate.mjcf import CAMERA, LABEL_PREFIX, to_mjcf
from jcr.simulate.poses import Pattern, gripper_poses, random_hand_eye
from jcr.simulate.scenes import Scene, SceneName, TableName, make_scene
from jcr.simulate.truth import DEPTH_UNIT_M, write_truth

_WIDTH, _HEIGHT = 640, 480
_SUPERSAMPLING = 2


@dataclass(frozen=True)
class SimulateOptions:
    """What to simulate."""

    scene: SceneName = "tabletop"
    """Objects and table: a mix on wood; 8 or 7 items on a plain light table; 7 on a plain dark one; the four
    things whose heights are measured."""
    images: int = 12
    """How many images (the pattern `two` has 2)."""
    pattern: Pattern = "varied"
    """Path of the wrist. All but `varied` leave part of the calibration unobservable: an orbit at one radius,
    pure translation, a turntable, xyz + yaw (SCARA), turning about a tool point or the camera's centre, two images."""
    seed: int = 0
    """Objects, layout, textures, lamp, lens, hand-eye and poses all follow from it."""
    texture: bool = True
    """Off: every surface has one uniform colour, so that no image feature can be found."""
    table: TableName | None = None
    """Light or dark table top (None: as the scene has it)."""
    robot_noise: tuple[float, float] = (0.0, 0.0)
    """MM DEG: sigma per axis of Gaussian errors of the reported gripper poses; the images show the true ones."""
    unknown_intrinsics: bool = False
    """Leave the intrinsics out of capture.json. (The lens is a pinhole either way: no distortion.)"""
    noise: float = 0.0
    """Sigma of the pixel noise, in grey levels of 255."""
    blur: float = 0.0
    """Sigma of the blur, in pixels."""
    vignetting: float = 0.0
    """Loss of light in the corners, 0 to 1."""
    jpeg_quality: int | None = 90
    """1 to 100 (None: lossless PNG)."""
    truth: Literal["full", "scene"] = "full"
    """Write depth and segmentation of every image, or scene.json alone."""


def simulate(out: Path, options: SimulateOptions = SimulateOptions()) -> Path:
    """Write a capture folder with reference.json and truth/ to `out`, and return `out`.

    The same options give the same capture.json and truth anywhere, and the same images on the same machine.
    Raises InputError where MuJoCo or an OpenGL library is missing, for options that mean nothing, and when
    `out` holds something else already.
    """
    _check(out, options)
    scene = make_scene(options.scene, options.seed, options.table)
    motion, lens, robot = (np.random.default_rng([options.seed, stream]) for stream in (4, 5, 6))
    gripper_from_camera = random_hand_eye(motion)
    base_from_gripper = gripper_poses(
        options.pattern, options.images, scene.table_center_in_base, gripper_from_camera, motion
    )
    base_from_camera = base_from_gripper @ gripper_from_camera
    intrinsics = _lens(lens)
    suffix = "png" if options.jpeg_quality is None else "jpg"
    names = [f"images/{k:02d}.{suffix}" for k in range(len(base_from_gripper))]
    for name, view in zip(names, _views(scene, options, intrinsics, base_from_camera), strict=True):
        pixels = np.random.default_rng([options.seed, 7, int(Path(name).stem)])
        write_bytes(out / name, _encode(_degrade(view.image, options, pixels), options.jpeg_quality))
        if view.depth is not None and view.label is not None:
            depth = np.round(view.depth / DEPTH_UNIT_M).astype(np.uint16)
            write_bytes(out / "truth" / "depth" / f"{Path(name).stem}.png", _encode(depth, None))
            write_bytes(out / "truth" / "labels" / f"{Path(name).stem}.png", _encode(view.label, None))
    write_truth(out, scene, names, intrinsics, gripper_from_camera, base_from_gripper)
    reference = {"gripper_from_camera": gripper_from_camera.tolist(), "how": "simulated: exact"}
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    reported = _with_noise(base_from_gripper, *options.robot_noise, robot)
    frames = [
        {"image": name, "base_from_gripper": matrix.tolist()}
        for name, matrix in zip(names, reported, strict=True)
    ]
    camera = {key: getattr(intrinsics, key) for key in ("fx", "fy", "cx", "cy")}
    capture = {
        "frames": frames,
        "intrinsics": None
        if options.unknown_intrinsics
        else camera | {"distortion": list(intrinsics.distortion)},
        "source": {"program": "jcr simulate", "options": asdict(options)},
    }
    # Last: a folder with a capture.json is a complete capture.
    write_text(out / "capture.json", json.dumps(capture, indent=1) + "\n")
    return out


def _check(out: Path, options: SimulateOptions) -> None:
    if not 1 <= options.images <= 1000:
        raise InputError(f"--images {options.images}: it must be 1 to 1000")
    if options.jpeg_quality is not None and not 1 <= options.jpeg_quality <= 100:
        raise InputError(f"--jpeg-quality {options.jpeg_quality}: it must be 1 to 100, or None for PNG")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: it must not be negative")
    if (
        min(options.robot_noise) < 0
        or min(options.noise, options.blur) < 0
        or not 0 <= options.vignetting <= 1
    ):
        raise InputError(
            "--robot-noise, --noise and --blur must not be negative, and --vignetting is within 0 to 1"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: exists and is not an empty folder; name a new one, or remove it first")


def _lens(rng: np.random.Generator) -> Intrinsics:
    """A pinhole of 40° to 48° vertical field of view, as a webcam or depth camera's colour image has."""
    focal_px = 0.5 * _HEIGHT / np.tan(0.5 * np.radians(rng.uniform(40, 48)))
    return Intrinsics(focal_px, focal_px, (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2, _WIDTH, _HEIGHT)


def _with_noise(
    base_from_gripper: Float[ndarray, "n 4 4"],
    translation_mm: float,
    rotation_deg: float,
    rng: np.random.Generator,
) -> Float[ndarray, "n 4 4"]:
    """What a robot of that repeatability reports: x + dx, exp(dr)·R with independent Gaussian axes."""
    reported = base_from_gripper.copy()
    count = len(reported)
    reported[:, :3, 3] += rng.normal(0, 1e-3, (count, 3)) * translation_mm
    turn = np.radians(rng.normal(0, 1, (count, 3)) * rotation_deg)
    reported[:, :3, :3] = rotation_exp(turn) @ reported[:, :3, :3]
    return reported


@dataclass(frozen=True)
class _View:
    """One rendering."""

    image: UInt8[ndarray, "h w 3"]
    depth: Float[ndarray, "h w"] | None
    """Along the optical axis in metres; 0 where nothing is. None when not asked for."""
    label: UInt8[ndarray, "h w"] | None


def _views(
    scene: Scene, options: SimulateOptions, intrinsics: Intrinsics, base_from_camera: Float[ndarray, "n 4 4"]
) -> Iterator[_View]:
    """Render the scene from every camera."""
    size = intrinsics.width, intrinsics.height
    fine = _SUPERSAMPLING * intrinsics.width, _SUPERSAMPLING * intrinsics.height
    fovy = 2 * np.arctan(0.5 * intrinsics.height / intrinsics.fy)
    with _renderers(*to_mjcf(scene, options.texture, fovy, fine), fine, size) as (model, data, picture, truth):
        label_of_geom = np.zeros(model.ngeom + 1, np.uint8)
        for k in range(model.ngeom):
            if model.geom(k).name.startswith(LABEL_PREFIX):
                label_of_geom[k] = int(model.geom(k).name.split("-")[1])
        for matrix in base_from_camera:
            # MuJoCo's cameras look along -z with y up; ours along z with y down.
            data.cam_xpos[0], data.cam_xmat[0] = matrix[:3, 3], (matrix[:3, :3] * [1, -1, -1]).ravel()
            picture.update_scene(data, CAMERA)
            image = cv2.resize(picture.render(), size, interpolation=cv2.INTER_AREA)
            if options.truth == "scene":
                yield _View(image, None, None)
                continue
            truth.update_scene(data, CAMERA)
            truth.enable_segmentation_rendering()
            geom = truth.render()[..., 0]
            truth.enable_depth_rendering()
            yield _View(image, np.where(geom < 0, 0.0, truth.render()), label_of_geom[geom])


@contextmanager
def _renderers(
    mjcf: str, files: dict[str, bytes], *sizes: tuple[int, int]
) -> Iterator[Any]:
    """MuJoCo's model, data and a renderer for each size (width, height), closed at the end."""
    # The variable is read when mujoco is imported; its default on Linux needs a display.
    if platform.system() == "Linux":
        library = "osmesa" if ctypes.util.find_library("EGL") is None and ctypes.util.find_library("OSMesa") else "egl"
        os.environ.setdefault("MUJOCO_GL", library)
    try:
        import mujoco
    except ImportError as error:
        raise InputError(
            f"jcr simulate renders with MuJoCo, which is missing: pip install 'jcr[sim]' ({error})"
        ) from error
    model = mujoco.MjModel.from_xml_string(mjcf, files)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with ExitStack() as stack:
        try:
            renderers = [stack.enter_context(mujoco.Renderer(model, height, width)) for width, height in sizes]
        except Exception as error:
            raise InputError(
                f"no off-screen OpenGL (MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}): install libegl1 or libosmesa6,"
                f" e.g. apt-get install libosmesa6, and set MUJOCO_GL to egl or osmesa ({error})"
            ) from error
        yield model, data, *renderers


def _degrade(
    image: UInt8[ndarray, "h w 3"], options: SimulateOptions, rng: np.random.Generator
) -> UInt8[ndarray, "h w 3"]:
    """The image of a cheaper camera: blurred, darker in the corners, noisy."""
    if not (options.blur or options.vignetting or options.noise):
        return image
    light = image.astype(np.float32)
    if options.blur:
        light = cv2.GaussianBlur(light, (0, 0), options.blur)
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    light *= 1 - options.vignetting * (0.5 * (x * x + y * y))[..., None]
    light += rng.normal(0, options.noise, image.shape)
    return np.clip(light.round(), 0, 255).astype(np.uint8)


def _encode(image: ndarray, jpeg_quality: int | None) -> bytes:
    """JPEG of that quality, or PNG; colours are RGB."""
    pixels = image[..., ::-1] if image.ndim == 3 else image
    if jpeg_quality is None:
        return cv2.imencode(".png", pixels)[1].tobytes()
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
