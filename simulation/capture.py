"""Simulated captures: images of a wrist camera on its way over a scene, of further cameras, and the ground truth."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from numpy import ndarray

from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.estimation.arms import arm_named
from jcr.files import write_bytes, write_text
from jcr.progress import Progress, silent, steps
from jcr.records import Capture, CellCamera, Mount
from simulation.arms import EFFECTIVE_POSES, BentArm, ErrorSizes, bend, table_center
from simulation.motion import (
    Motion,
    base_across_table,
    base_from_other_base,
    carried_motion,
    fixed_camera,
    motion_over_table,
    second_on_wrist,
)
from simulation.objects import carried_package
from simulation.options import SimulateOptions
from simulation.render import render
from simulation.scenes import Scene, make_scene, moved
from simulation.taken import image_suffix, pinhole, stated_intrinsics, with_robot_noise, write_image
from simulation.truth import Truth, write_pixels, write_robot, write_truth

AHEAD, AWAY = 0.06, 0.55
"""m: from the gripper's frame to the bottom of a carried package, and from the camera that watches it."""


def simulate(out: Path, options: SimulateOptions | None = None, progress: Progress = silent) -> Path:
    """Write a capture folder with reference.json and truth/ to `out`, and return `out`.

    The same options give the same capture.json and truth/scene.json, and on one machine the same images.
    Raises InputError for options that mean nothing, where `out` holds something already, and where MuJoCo or
    an OpenGL library is missing.
    """
    _check(out, options := options or SimulateOptions())
    if options.eye_to_hand:
        return _simulate_eye_to_hand(out, options, progress)
    scene = make_scene(options.scene, options.seed, options.table)
    # One stream of random numbers a matter: a change in one must not disturb the others.
    errors, path, elsewhere, camera, noise, intrinsics = (
        np.random.default_rng([options.seed, stream]) for stream in (8, 4, 9, 5, 6, 10)
    )
    bent = _bent_arm(options, errors)
    motion = motion_over_table(
        bent, options.pattern, options.images, scene.table_center_in_base, (path, elsewhere)
    )
    scene = moved(scene, motion.target_in_base) if bent else scene
    truth = _truth(out, scene, options, motion, camera)
    depths = _write_images(scene, truth, options, progress)
    write_truth(truth)
    if bent is not None and motion.joints is not None:
        write_robot(truth, bent, motion.joints)
    others, of_others = _add_cameras(out, options, scene, motion)
    write_text(out / "reference.json", json.dumps(_reference(motion) | of_others, indent=1) + "\n")
    capture = Capture(
        folder=out,
        images=truth.images,
        base_from_gripper=with_robot_noise(motion.reported, *options.robot_noise, noise),
        image_size=(truth.intrinsics.width, truth.intrinsics.height),
        intrinsics=stated_intrinsics(truth.intrinsics, options, intrinsics),
        joints=motion.joints,
        robot=options.robot,
        depths=depths,
        others=others,
    )
    # Last: a folder with a capture.json is a complete capture.
    capture_json.write(out, capture, source={"program": "python -m simulation", "options": asdict(options)})
    return out


def _bent_arm(options: SimulateOptions, rng: np.random.Generator) -> BentArm | None:
    """Draw the arm with systematic errors of the sizes that the options give; None without an arm."""
    if options.robot is None:
        return None
    sizes = ErrorSizes(
        joint_offset=np.radians(options.joint_offsets),
        link=1e-3 * options.link_errors,
        sag=np.radians(options.sag),
        gear=np.radians(options.gear_errors),
    )
    return bend(arm_named(options.robot), sizes, rng)


def _truth(
    out: Path, scene: Scene, options: SimulateOptions, motion: Motion, rng: np.random.Generator
) -> Truth:
    suffix = image_suffix(options)
    return Truth(
        folder=out,
        scene=scene.name,
        seed=options.seed,
        images=tuple(f"images/{k:02d}.{suffix}" for k in range(len(motion.reported))),
        gripper_from_camera=motion.physical,
        base_from_gripper=motion.base_from_gripper,
        base_from_camera=motion.base_from_gripper @ motion.physical,
        intrinsics=pinhole(rng),
        labels=scene.labels,
        table_height=scene.table_height,
        workspace_in_base=scene.workspace_in_base,
        objects=scene.true_objects,
    )


def _write_images(
    scene: Scene, truth: Truth, options: SimulateOptions, progress: Progress
) -> tuple[str, ...] | None:
    """Write what the camera sees, and with the full truth its depth and labels; the names of the depth images that a
    depth camera measures, or None without one."""
    with_truth = options.truth == "full" or options.depth is not None
    views = render(scene, truth.intrinsics, truth.base_from_camera, options.texture, with_truth=with_truth)
    depths = tuple(f"depth/{k:02d}.png" for k in range(len(truth.images)))
    for k, view in zip(steps(progress, "render", range(len(truth.images))), views, strict=True):
        write_image(truth.folder / truth.images[k], view.image, options, [7, k])
        if options.truth == "full" and view.depth is not None and view.label is not None:
            write_pixels(truth, k, view.depth, view.label)
        if view.depth is not None and options.depth is not None:
            measured = _measured(view.depth, options.depth, np.random.default_rng([options.seed, 8, k]))
            write_bytes(truth.folder / depths[k], encode_png(measured))
    return None if options.depth is None else depths


def _reference(motion: Motion) -> dict[str, object]:
    """Return the hand-eye transform of reference.json, and how it was found."""
    if motion.bent is None:
        return {"gripper_from_camera": motion.physical.tolist(), "how": "simulated, exact"}
    return {
        "gripper_from_camera": motion.effective.tolist(),
        "physical_gripper_from_camera": motion.physical.tolist(),
        "how": f"simulated: best for {EFFECTIVE_POSES} or more other reported poses of these views, exact cameras",
    }


def _measured(
    depth: Float[ndarray, "h w"], wrong: tuple[float, float], draw: np.random.Generator
) -> UInt16[ndarray, "h w"]:
    """Return depth (mm) as a depth camera of that scale error and noise measures it; 0 where it sees none."""
    percent, noise_mm = wrong
    edge = np.ptp([np.roll(depth, step, axis) for step in (-1, 1) for axis in (0, 1)], axis=0) > 0.03 * depth
    noisy = (1 + percent / 100) * depth + 1e-3 * noise_mm * depth**2 * draw.normal(size=depth.shape)
    return np.where(edge | (depth <= 0), 0, 1e3 * noisy).round().clip(0, 65535).astype(np.uint16)


def _add_cameras(
    out: Path, options: SimulateOptions, scene: Scene, own: Motion
) -> tuple[tuple[CellCamera, ...], dict[str, Any]]:
    """Write images of the further cameras that the options ask for; return them and their part of reference.json.

    Both are empty without further cameras. `own` is the motion of the capture's own camera.
    """
    rng = np.random.default_rng([options.seed, 14])
    cameras: list[CellCamera] = []
    true: dict[str, Any] = {}
    arms: dict[str, Any] = {}

    def add(name: str, mount: Mount, places: Float[ndarray, "n 4 4"], **of_mount: Any) -> None:
        camera = pinhole(rng)
        images = tuple(f"{name}/{k:02d}.{image_suffix(options)}" for k in range(len(places)))
        for k, view in enumerate(render(scene, camera, places, options.texture, with_truth=False)):
            write_image(out / images[k], view.image, options, [15, k, *name.encode()])
        size, stated = (camera.width, camera.height), stated_intrinsics(camera, options, rng)
        cameras.append(
            CellCamera(name=name, mount=mount, images=images, image_size=size, intrinsics=stated, **of_mount)
        )

    middle = scene.table_center_in_base
    for k in range(options.fixed_cameras):
        place = fixed_camera(middle, 0.55, rng)
        add(f"fixed{k}", "base", place[None])
        true[f"fixed{k}"] = {"base_from_camera": (own.base_from_true_base @ place).tolist()}
    if options.wrist_cameras > 1:
        beside = second_on_wrist(rng)
        places = own.base_from_gripper @ own.physical @ beside
        add("second", "gripper", places, frame=np.arange(len(places)))
        true["second"] = {"gripper_from_camera": (own.effective @ beside).tolist()}
    if options.arms > 1:
        other = motion_over_table(_bent_arm(options, rng), "varied", options.images, middle, (rng, rng))
        base_from_other = base_across_table(middle, other.target_in_base, rng)
        reported = with_robot_noise(other.reported, *options.robot_noise, rng)
        places = base_from_other @ other.base_from_gripper @ other.physical
        add("other_wrist", "gripper", places, arm="other", base_from_gripper=reported)
        true["other_wrist"] = {"gripper_from_camera": other.effective.tolist()}
        between = base_from_other_base(own, other, base_from_other)
        arms["other"] = {"base_from_other_base": between.tolist()}
    return tuple(cameras), {"cameras": true, "arms": arms} if cameras else {}


def _simulate_eye_to_hand(out: Path, options: SimulateOptions, progress: Progress) -> Path:
    """Write a capture whose camera stands fixed and watches a package in the gripper, before the scene."""
    rng = np.random.default_rng([options.seed, 16])
    scene = make_scene(options.scene, options.seed, options.table)
    bent = _bent_arm(options, rng)
    scene = scene if bent is None else moved(scene, table_center(bent.arm))
    above = scene.table_center_in_base + [0.0, 0.0, 0.4]
    motion = carried_motion(bent, options.images, above, AHEAD, AWAY, rng)
    camera, package = pinhole(rng), carried_package(rng)
    images = tuple(f"images/{k:02d}.{image_suffix(options)}" for k in range(options.images))
    for k, gripper in steps(progress, "render", list(enumerate(motion.base_from_gripper))):
        carried = replace(package, base_from_object=gripper @ motion.gripper_from_object)
        shown = replace(scene, objects=(*scene.objects, carried))
        (view,) = render(shown, camera, motion.base_from_camera[None], options.texture, with_truth=False)
        write_image(out / images[k], view.image, options, [7, k])
    reference = {
        "base_from_camera": motion.effective[0].tolist(),
        "gripper_from_object": motion.effective[1].tolist(),
        "how": "simulated: the pair by which reported poses best predict what the camera sees",
    }
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    capture = Capture(
        folder=out,
        images=images,
        base_from_gripper=with_robot_noise(motion.reported, *options.robot_noise, rng),
        image_size=(camera.width, camera.height),
        intrinsics=stated_intrinsics(camera, options, rng),
        joints=motion.joints,
        robot=options.robot,
        camera_name="front",
        mount="base",
    )
    capture_json.write(out, capture)
    return out


def _check(out: Path, options: SimulateOptions) -> None:
    """Raise InputError for options out of range or that exclude each other, and for a folder that is not new."""
    errors = {name: getattr(options, name) for name in ("joint_offsets", "link_errors", "gear_errors", "sag")}
    not_negative = errors | {
        name: getattr(options, name) for name in ("seed", "noise", "blur", "intrinsics_error")
    }
    not_negative["robot_noise"] = min(options.robot_noise)
    ranges = {name: (0, np.inf) for name in not_negative} | {
        "images": (1, 1000),
        "vignetting": (0, 1),
        "fixed_cameras": (0, 20),
        "wrist_cameras": (1, 2),
        "arms": (1, 2),
    }
    if options.jpeg_quality != "lossless":
        ranges["jpeg_quality"] = (1, 100)
    for name, (low, high) in ranges.items():
        value = not_negative.get(name, getattr(options, name))
        if not low <= value <= high:
            upper = "or more" if np.isinf(high) else f"to {high}"
            raise InputError(f"--{name.replace('_', '-')} {value}: give {low} {upper}")
    bent = next((f"--{name.replace('_', '-')} {size:g}" for name, size in errors.items() if size), None)
    if bent and options.robot is None:
        raise InputError(f"{bent}: errors of an arm; name it with --robot")
    if options.intrinsics_error and options.unknown_intrinsics:
        raise InputError("--intrinsics-error and --unknown-intrinsics exclude each other; leave one out")
    if options.eye_to_hand and (options.fixed_cameras or options.wrist_cameras > 1 or options.arms > 1):
        raise InputError("--eye-to-hand has one camera; leave the further ones out")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: exists already and is no empty folder; name a new one, or remove it first")
