"""A simulated capture: what a wrist camera sees on its way over a scene, written with the truth beside it."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt16
from numpy import ndarray

from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.progress import Progress, silent, steps
from jcr.records import Capture
from simulation.cell_capture import add_cameras, simulate_eye_to_hand
from simulation.motion import Motion, motion_of
from simulation.options import SimulateOptions
from simulation.render import render
from simulation.robots import EFFECTIVE_POSES
from simulation.scenes import Scene, make_scene, moved
from simulation.taken import image_suffix, pinhole, stated_intrinsics, with_robot_noise, write_image
from simulation.truth import Truth, write_pixels, write_robot, write_truth


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
    # One stream of random numbers a matter: a change in one must not disturb the others.
    errors, path, elsewhere, camera, noise, intrinsics = (
        np.random.default_rng([options.seed, stream]) for stream in (8, 4, 9, 5, 6, 10)
    )
    motion = motion_of(options, scene.table_center_in_base, (errors, path, elsewhere))
    if motion.bent is not None:
        scene = moved(scene, motion.target_in_base)
    truth = _truth(out, scene, options, motion, camera)
    depths = _write_images(scene, truth, options, progress)
    write_truth(truth)
    if motion.bent is not None and motion.joints is not None:
        write_robot(truth, motion.bent, motion.joints)
    others, of_others = add_cameras(out, options, scene, motion)
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
    """The hand-eye transform of reference.json, and how it was found."""
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
    """Depth (mm) as a depth camera of that scale error and noise measures it; 0 where it sees none."""
    percent, noise_mm = wrong
    edge = np.ptp([np.roll(depth, step, axis) for step in (-1, 1) for axis in (0, 1)], axis=0) > 0.03 * depth
    noisy = (1 + percent / 100) * depth + 1e-3 * noise_mm * depth**2 * draw.normal(size=depth.shape)
    return np.where(edge | (depth <= 0), 0, 1e3 * noisy).round().clip(0, 65535).astype(np.uint16)


def _check(out: Path, options: SimulateOptions) -> None:
    """InputError for options out of range or that exclude each other, and for a folder that is not new."""
    bends = {
        "--joint-offsets": options.joint_offsets,
        "--link-errors": options.link_errors,
        "--gear-errors": options.gear_errors,
        "--sag": options.sag,
    }
    sigmas = (*options.robot_noise, options.noise, options.blur, options.intrinsics_error, *bends.values())
    bent = next(
        (f"{option} {size:g}" for option, size in bends.items() if size and options.robot is None), ""
    )
    percent, depth_mm = options.depth or (0.0, 0.0)
    lossless, quality = options.jpeg_quality == "lossless", options.jpeg_quality
    further = options.fixed_cameras or options.wrist_cameras > 1 or options.arms > 1
    in_cell = 0 <= options.fixed_cameras <= 20 and {options.wrist_cameras, options.arms} <= {1, 2}
    refused = (
        (not 1 <= options.images <= 1000, f"--images {options.images}: give 1 to 1000"),
        (options.seed < 0, f"--seed {options.seed}: give 0 or more"),
        (bool(bent), f"{bent}: errors of an arm; name it with --robot"),
        (
            percent <= -100 or depth_mm < 0,
            f"--depth {percent:g} {depth_mm:g}: give percent over -100, and a sigma of 0 mm or more",
        ),
        (
            bool(options.intrinsics_error) and options.unknown_intrinsics,
            f"--intrinsics-error {options.intrinsics_error:g}: no intrinsics are given; leave one of both out",
        ),
        (
            not lossless and not 1 <= int(quality) <= 100,
            f"--jpeg-quality {quality}: give 1 to 100, or lossless for PNG",
        ),
        (
            min(sigmas) < 0,
            f"--robot-noise, --noise, --blur, --intrinsics-error, {', '.join(bends)}: sigmas; give 0 or more",
        ),
        (not in_cell, "--fixed-cameras 0 to 20, --wrist-cameras 1 or 2, --arms 1 or 2: give one of these"),
        (
            options.eye_to_hand and bool(further),
            "--eye-to-hand: has one camera, which watches the gripper; leave the further ones out",
        ),
        (not 0 <= options.vignetting <= 1, f"--vignetting {options.vignetting}: give 0 to 1"),
        (
            out.exists() and not (out.is_dir() and not any(out.iterdir())),
            f"{out}: exists already and is no empty folder; name a new one, or remove it first",
        ),
    )
    for wrong, message in refused:
        if wrong:
            raise InputError(message)
