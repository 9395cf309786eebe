"""A simulated capture: what a wrist camera sees on its way over a scene, written with the truth beside it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16
from numpy import ndarray

from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.handeye.arms import RobotName, arm_named
from jcr.progress import Progress, silent, steps
from jcr.simulate.bent_arm import BentArm, bend
from jcr.simulate.cell_capture import Further, add_cameras, simulate_eye_to_hand, sizes_of
from jcr.simulate.options import SimulateOptions
from jcr.simulate.poses import gripper_poses, random_hand_eye
from jcr.simulate.render import render
from jcr.simulate.robots import (
    EFFECTIVE_POSES,
    effective_about,
    hand_eye_on,
    patterned,
    table_center,
)
from jcr.simulate.scenes import Scene, make_scene, moved
from jcr.simulate.taken import degraded, encoded, pinhole, with_lens_error, with_robot_noise
from jcr.simulate.truth import Truth, write_depth, write_labels, write_robot, write_truth


def simulate(out: Path, options: SimulateOptions | None = None, progress: Progress = silent) -> Path:
    """Write a capture folder with reference.json and truth/ to `out`, and return `out`.

    The same options give the same capture.json and truth/scene.json, and on one machine the same images.
    Raises InputError for options that mean nothing, where `out` holds something already, and where MuJoCo or
    an OpenGL library is missing.
    """
    _check(out, options := options or SimulateOptions())
    if options.eye_to_hand:
        return simulate_eye_to_hand(out, options, progress)
    scene = make_scene(options.scene, options.seed, options.table)
    motion = _random(options, 4)
    arm = None if options.robot is None else _arm(options, options.robot, motion)
    if arm is None:
        path = _without_arm(scene, options, motion)
    else:
        scene = moved(scene, table_center(arm.bent.arm))
        path = _Path(arm.physical, arm.bent.true(arm.joints), arm.bent.reported(arm.joints))
    truth = _truth(out, scene, options, path)
    _write_images(scene, truth, options, progress)
    write_truth(truth)
    if arm is not None:
        write_robot(truth, arm.bent, arm.joints)
    further = _further(scene, truth, options, arm)
    reference = _reference(truth, arm) | further.reference
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    frames = _frames(truth, options, path, arm)
    # Last: a folder with a capture.json is a complete capture.
    content = _capture_json(truth, options, frames) | further.content
    write_text(out / "capture.json", json.dumps(content, indent=1) + "\n")
    return out


@dataclass(frozen=True)
class _Path:
    """Where the gripper goes."""

    gripper_from_camera: Float[ndarray, "4 4"]
    """Where the camera is bolted."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    reported: Float[ndarray, "n 4 4"]
    """As the robot's nominal kinematics has it."""


def _random(options: SimulateOptions, *stream: int) -> np.random.Generator:
    """One stream of random numbers a matter: a change in one must not disturb the others."""
    return np.random.default_rng([options.seed, *stream])


def _without_arm(scene: Scene, options: SimulateOptions, motion: np.random.Generator) -> _Path:
    x = random_hand_eye(motion)
    poses = gripper_poses(options.pattern, options.images, scene.table_center_in_base, x, motion)
    return _Path(x, poses, poses)


def _truth(out: Path, scene: Scene, options: SimulateOptions, path: _Path) -> Truth:
    suffix = _suffix(options)
    return Truth(
        folder=out,
        scene=scene.name,
        seed=options.seed,
        images=tuple(f"images/{k:02d}.{suffix}" for k in range(len(path.base_from_gripper))),
        gripper_from_camera=path.gripper_from_camera,
        base_from_gripper=path.base_from_gripper,
        base_from_camera=path.base_from_gripper @ path.gripper_from_camera,
        intrinsics=pinhole(_random(options, 5)),
        labels=scene.labels,
        table_height=scene.table_height,
        workspace_in_base=scene.workspace_in_base,
        objects=scene.true_objects,
    )


def _suffix(options: SimulateOptions) -> str:
    return "png" if options.jpeg_quality == "lossless" else "jpg"


def _write_images(scene: Scene, truth: Truth, options: SimulateOptions, progress: Progress) -> None:
    """What the camera sees, and the depth that a depth camera measures; with the full truth, that of each image too."""
    with_truth = options.truth == "full" or options.depth is not None
    views = render(scene, truth.intrinsics, truth.base_from_camera, options.texture, with_truth=with_truth)
    for k, view in zip(steps(progress, "render", range(len(truth.images))), views, strict=True):
        image = degraded(view.image, options, _random(options, 7, k))
        write_bytes(truth.folder / truth.images[k], encoded(image, options.jpeg_quality))
        if options.truth == "full" and view.depth is not None and view.label is not None:
            write_depth(truth, k, view.depth)
            write_labels(truth, k, view.label)
        if view.depth is not None and options.depth is not None:
            measured = _measured(view.depth, options.depth, _random(options, 8, k))
            write_bytes(truth.folder / _depth_name(k), encode_png(measured))


def _reference(truth: Truth, arm: "_Arm | None") -> dict[str, object]:
    """What reference.json says of the hand-eye transform."""
    if arm is None:
        return {"gripper_from_camera": truth.gripper_from_camera.tolist(), "how": "simulated, exact"}
    return {
        "gripper_from_camera": arm.effective.tolist(),
        "physical_gripper_from_camera": arm.physical.tolist(),
        "how": f"simulated: best for {EFFECTIVE_POSES} or more other reported poses of these views, exact cameras",
    }


def _further(scene: Scene, truth: Truth, options: SimulateOptions, arm: "_Arm | None") -> Further:
    """The cell's other cameras and arm, where it has some."""
    if not options.fixed_cameras and options.wrist_cameras <= 1 and options.arms <= 1:
        return Further({}, {})
    x, base = (
        (truth.gripper_from_camera, np.eye(4))
        if arm is None
        else (arm.effective, arm.effective_from_true_base)
    )
    return add_cameras(truth.folder, options, scene, truth, (x, base), _suffix(options))


def _frames(
    truth: Truth, options: SimulateOptions, path: _Path, arm: "_Arm | None"
) -> list[dict[str, object]]:
    """What capture.json says of each image."""
    reported = with_robot_noise(path.reported, *options.robot_noise, _random(options, 6))
    frames: list[dict[str, object]] = [
        {"image": image, "base_from_gripper": matrix.tolist()}
        for image, matrix in zip(truth.images, reported, strict=True)
    ]
    for k, frame in enumerate(frames):
        if options.depth is not None:
            frame["depth"] = _depth_name(k)
        if arm is not None:
            frame["joints"] = arm.joints[k].tolist()
    return frames


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
    effective_from_true_base: Float[ndarray, "4 4"]


def _arm(options: SimulateOptions, robot: RobotName, motion: np.random.Generator) -> _Arm:
    errors, elsewhere = (np.random.default_rng([options.seed, stream]) for stream in (8, 9))
    bent = bend(arm_named(robot), sizes_of(options), errors)
    target = table_center(bent.arm)
    physical = hand_eye_on(bent.arm, motion)
    joints = patterned(bent.arm, options.pattern, options.images, target, physical, motion)
    fit = effective_about(bent, physical, options.images, elsewhere, target)
    return _Arm(bent, joints, physical, fit.gripper_from_camera, fit.base_from_recon)


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
    if not (0 <= options.fixed_cameras <= 20 and options.wrist_cameras in (1, 2) and options.arms in (1, 2)):
        raise InputError("--fixed-cameras 0 to 20, --wrist-cameras 1 or 2, --arms 1 or 2: give one of these")
    if options.eye_to_hand and (options.fixed_cameras or options.wrist_cameras > 1 or options.arms > 1):
        raise InputError(
            "--eye-to-hand: has one camera, which watches the gripper; leave the further ones out"
        )
    if not 0 <= options.vignetting <= 1:
        raise InputError(f"--vignetting {options.vignetting}: give 0 to 1")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: exists already and is no empty folder; name a new one, or remove it first")


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
