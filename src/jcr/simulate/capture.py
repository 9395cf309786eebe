"""A simulated capture: what a wrist camera sees on its way over a scene, written with the truth beside it."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import tyro
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.geometry import retract
from jcr.handeye.arms import RobotName, arm_named
from jcr.handeye.robots import ErrorSizes
from jcr.progress import Progress, silent, steps
from jcr.records import Intrinsics
from jcr.simulate.poses import Pattern, gripper_poses, random_hand_eye
from jcr.simulate.render import render
from jcr.simulate.robots import (
    EFFECTIVE_POSES,
    BentArm,
    bend,
    effective_hand_eye_about,
    hand_eye_on,
    patterned,
    table_center,
)
from jcr.simulate.scenes import SceneName, TableName, make_scene, moved
from jcr.simulate.truth import Truth, write_depth, write_labels, write_robot, write_truth

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
    robot: RobotName | None = None
    """Arm that carries the camera, the table before it. capture.json then has its joint angles, and gripper poses by
    its nominal kinematics (unset: a gripper without an arm)."""
    joint_offsets: float = 0.0
    """Sigma of the offsets of the robot's joints, in degrees. With this and the next three, reference.json has the
    effective hand-eye transform, and the physical one beside it."""
    link_errors: float = 0.0
    """Sigma of the translations of the robot's joint axes, in mm; of their rotations, 0.19 degrees per mm."""
    gear_errors: float = 0.0
    """Sigma of eccentric gears or encoders, in degrees: amplitudes of sine and cosine of each joint's angle."""
    sag: float = 0.0
    """Sigma of the deflection of each joint under gravity, in degrees with the arm stretched out."""
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
    lens_error: float = 0.0
    """Sigma of the errors of the intrinsics in capture.json, in percent: of the focal length (fx and fy alike), and of
    the image's width for each coordinate of the principal point. The images show the true ones."""
    noise: float = 0.0
    """Sigma of the pixel noise, in grey levels of 255."""
    blur: float = 0.0
    """Sigma of the blur, in pixels."""
    depth: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="PERCENT MM")] = None
    """Depth images as a depth camera takes them: lengths too long by so much, and the sigma of a depth at 1 m, which
    grows with the square of the distance; none at edges."""
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
    if options.robot is None:
        arm = None
        gripper_from_camera = random_hand_eye(motion)
        base_from_gripper = reported = gripper_poses(
            options.pattern, options.images, scene.table_center_in_base, gripper_from_camera, motion
        )
    else:
        arm = _arm(options, options.robot, motion)
        scene = moved(scene, table_center(arm.bent.arm))
        gripper_from_camera = arm.physical
        base_from_gripper, reported = arm.bent.true(arm.joints), arm.bent.reported(arm.joints)
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
        scene,
        truth.intrinsics,
        truth.base_from_camera,
        options.texture,
        with_truth=options.truth == "full" or options.depth is not None,
    )
    for k, view in zip(steps(progress, "render", range(len(truth.images))), views, strict=True):
        image = _degraded(view.image, options, np.random.default_rng([options.seed, 7, k]))
        write_bytes(out / truth.images[k], _encoded(image, options.jpeg_quality))
        if options.truth == "full" and view.depth is not None and view.label is not None:
            write_depth(truth, k, view.depth)
            write_labels(truth, k, view.label)
        if view.depth is not None and options.depth is not None:
            measured = _measured(view.depth, options.depth, np.random.default_rng([options.seed, 8, k]))
            write_bytes(out / _depth_name(k), encode_png(measured))
    write_truth(truth)
    if arm is None:
        reference = {"gripper_from_camera": gripper_from_camera.tolist(), "how": "simulated, exact"}
    else:
        write_robot(truth, arm.bent, arm.joints)
        reference = {
            "gripper_from_camera": arm.effective.tolist(),
            "physical_gripper_from_camera": arm.physical.tolist(),
            "how": f"simulated: best for {EFFECTIVE_POSES} or more other reported poses of these views, exact cameras",
        }
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    frames: list[dict[str, object]] = [
        {"image": image, "base_from_gripper": matrix.tolist()}
        for image, matrix in zip(
            truth.images, with_robot_noise(reported, *options.robot_noise, robot), strict=True
        )
    ]
    if options.depth is not None:
        for k, frame in enumerate(frames):
            frame["depth"] = _depth_name(k)
    if arm is not None:
        for frame, row in zip(frames, arm.joints.tolist(), strict=True):
            frame["joints"] = row
    # Last: a folder with a capture.json is a complete capture.
    write_text(out / "capture.json", json.dumps(_capture_json(truth, options, frames), indent=1) + "\n")
    return out


def _depth_name(image: int) -> str:
    return f"depth/{image:02d}.png"


def _measured(
    depth: Float[ndarray, "h w"], wrong: tuple[float, float], draw: np.random.Generator
) -> UInt16[ndarray, "h w"]:
    """Depth (mm) as a depth camera of that scale error and noise measures it; 0 where it sees none."""
    percent, noise_mm = wrong
    edge = np.ptp([np.roll(depth, step, axis) for step in (-1, 1) for axis in (0, 1)], axis=0) > 0.03 * depth
    noisy = (1 + percent / 100) * depth + 1e-3 * noise_mm * depth**2 * draw.normal(size=depth.shape)
    return np.where(edge | (depth <= 0), 0, 1e3 * noisy).round().clip(0, 65535).astype(np.uint16)


@dataclass(frozen=True)
class _Arm:
    """The robot of a capture."""

    bent: BentArm
    joints: Float[ndarray, "n dof"]
    physical: Float[ndarray, "4 4"]
    """gripper_from_camera where the camera is bolted."""
    effective: Float[ndarray, "4 4"]


def _arm(options: SimulateOptions, robot: RobotName, motion: np.random.Generator) -> _Arm:
    errors, elsewhere = (np.random.default_rng([options.seed, stream]) for stream in (8, 9))
    sizes = ErrorSizes(
        joint_offset=np.radians(options.joint_offsets),
        link=1e-3 * options.link_errors,
        sag=np.radians(options.sag),
        gear=np.radians(options.gear_errors),
    )
    bent = bend(arm_named(robot), sizes, errors)
    target = table_center(bent.arm)
    physical = hand_eye_on(bent.arm, motion)
    joints = patterned(bent.arm, options.pattern, options.images, target, physical, motion)
    effective = effective_hand_eye_about(bent, physical, options.images, elsewhere, target)
    return _Arm(bent, joints, physical, effective)


def _check(out: Path, options: SimulateOptions) -> None:
    if not 1 <= options.images <= 1000:
        raise InputError(f"--images {options.images}: give 1 to 1000")
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: give 0 or more")
    bends = {
        "--joint-offsets": options.joint_offsets,
        "--link-errors": options.link_errors,
        "--gear-errors": options.gear_errors,
        "--sag": options.sag,
    }
    for option, size in bends.items():
        if size and options.robot is None:
            raise InputError(f"{option} {size:g}: errors of an arm; name it with --robot")
    if options.depth is not None and (options.depth[0] <= -100 or options.depth[1] < 0):
        percent, mm = options.depth
        raise InputError(f"--depth {percent:g} {mm:g}: give percent over -100, and a sigma of 0 mm or more")
    if options.lens_error and options.unknown_intrinsics:
        raise InputError(
            f"--lens-error {options.lens_error:g}: no intrinsics are given; leave one of both out"
        )
    if options.jpeg_quality != "lossless" and not 1 <= options.jpeg_quality <= 100:
        raise InputError(f"--jpeg-quality {options.jpeg_quality}: give 1 to 100, or lossless for PNG")
    if min(*options.robot_noise, options.noise, options.blur, options.lens_error, *bends.values()) < 0:
        raise InputError(
            f"--robot-noise, --noise, --blur, --lens-error, {', '.join(bends)}: sigmas; give 0 or more"
        )
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


def with_lens_error(camera: Intrinsics, percent: float, rng: np.random.Generator) -> Intrinsics:
    """Intrinsics that are off by Gaussian errors: fx and fy by one of `percent`, cx and cy each of that of the width."""
    focal, x, y = 0.01 * percent * rng.normal(size=3)
    return replace(
        camera,
        fx=camera.fx * (1 + focal),
        fy=camera.fy * (1 + focal),
        cx=camera.cx + x * camera.width,
        cy=camera.cy + y * camera.width,
    )


def _capture_json(
    truth: Truth, options: SimulateOptions, frames: list[dict[str, object]]
) -> dict[str, object]:
    camera = with_lens_error(truth.intrinsics, options.lens_error, np.random.default_rng([options.seed, 10]))
    known = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
    return {
        "frames": frames,
        "intrinsics": None if options.unknown_intrinsics else known | {"distortion": list(camera.distortion)},
        **({} if options.robot is None else {"robot": options.robot}),
        "source": {"program": "jcr simulate", "options": asdict(options)},
    }


def with_robot_noise(
    base_from_gripper: Float[ndarray, "n 4 4"],
    translation_mm: float,
    rotation_deg: float,
    rng: np.random.Generator,
) -> Float[ndarray, "n 4 4"]:
    """What a robot of that accuracy reports: each pose after a step of independent Gaussians in every axis."""
    sizes = np.repeat([1e-3 * translation_mm, np.radians(rotation_deg)], 3)
    return retract(base_from_gripper, sizes * rng.normal(size=(len(base_from_gripper), 6)))


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
