"""Further cameras of a simulated capture: beside the table, on the wrist, on a second arm; or one that watches.

Written in capture.json's "cameras", with the truth in reference.json.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.lens_json import lens_as_json
from jcr.files import write_bytes, write_text
from jcr.geometry import inverse, rotation_exp, transform
from jcr.handeye.arms import arm_named
from jcr.progress import Progress, steps
from jcr.records import Intrinsics
from jcr.simulate.bent_arm import ErrorSizes, bend
from jcr.simulate.objects import held_package
from jcr.simulate.options import SimulateOptions
from jcr.simulate.poses import gripper_poses, looking_at, random_hand_eye
from jcr.simulate.render import render
from jcr.simulate.robots import (
    EFFECTIVE_POSES,
    about_posture,
    effective_about,
    effective_exchanged,
    hand_eye_on,
    patterned,
    table_center,
)
from jcr.simulate.scenes import Scene, make_scene, moved
from jcr.simulate.taken import degraded, encoded, pinhole, with_lens_error, with_robot_noise
from jcr.simulate.truth import Truth

AHEAD = 0.06
"""m from the gripper's frame to the bottom of what it carries."""
AWAY = 0.55
"""m from the camera that watches the gripper to what that carries."""
TURNS, SHIFTS = np.array([0.55, 0.55, 1.0]), 0.07
"""rad and m to either side: how a gripper without an arm moves before it."""


@dataclass(frozen=True)
class Further:
    """What capture.json and reference.json say of them."""

    content: dict[str, Any]
    reference: dict[str, Any]


def sizes_of(options: SimulateOptions) -> ErrorSizes:
    """Of the systematic errors of an arm."""
    return ErrorSizes(
        joint_offset=np.radians(options.joint_offsets),
        link=1e-3 * options.link_errors,
        sag=np.radians(options.sag),
        gear=np.radians(options.gear_errors),
    )


def add_cameras(
    out: Path,
    options: SimulateOptions,
    scene: Scene,
    truth: Truth,
    effective: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]],
    suffix: str,
) -> Further:
    """Images of the further cameras that the options ask for; `effective` is X, and the base from the true one."""
    rng = np.random.default_rng([options.seed, 14])
    x, base_from_true = effective
    cameras: dict[str, Any] = {"wrist": {"mount": "gripper"}}
    true: dict[str, Any] = {}
    other_arms: dict[str, Any] = {}
    for k in range(options.fixed_cameras):
        name, lens = f"fixed{k}", pinhole(rng)
        azimuth = rng.uniform(-2.6, 2.6)
        away = np.array([0.55 * np.cos(azimuth), 0.55 * np.sin(azimuth), rng.uniform(0.6, 0.8)])
        middle = scene.table_center_in_base
        place = looking_at(middle + away, middle, rng)
        images = _taken(out, options, scene, lens, place[None], name, suffix)
        cameras[name] = {"mount": "base", "images": images, "intrinsics": _stated(lens, options, rng)}
        true[name] = {"base_from_camera": (base_from_true @ place).tolist()}
    if options.wrist_cameras > 1:
        name, lens = "second", pinhole(rng)
        beside = transform(rotation_exp(0.05 * rng.normal(size=3)), np.array([0.06, 0.0, 0.0]))
        images = _taken(out, options, scene, lens, truth.base_from_camera @ beside, name, suffix)
        cameras[name] = {"mount": "gripper", "images": images, "intrinsics": _stated(lens, options, rng)}
        true[name] = {"gripper_from_camera": (x @ beside).tolist()}
    if options.arms > 1:
        name, lens = "other_wrist", pinhole(rng)
        other_from_base, grippers, reported, physical, (x_other, other_from_true) = _second_arm(
            options, scene, rng
        )
        places = inverse(other_from_base) @ grippers @ physical
        images = _taken(out, options, scene, lens, places, name, suffix)
        frames = [
            {"image": image, "base_from_gripper": pose.tolist()}
            for image, pose in zip(images, with_robot_noise(reported, *options.robot_noise, rng), strict=True)
        ]
        cameras[name] = {
            "mount": "gripper",
            "arm": "other",
            "frames": frames,
            "intrinsics": _stated(lens, options, rng),
        }
        true[name] = {"gripper_from_camera": x_other.tolist()}
        base_from_other = base_from_true @ inverse(other_from_base) @ inverse(other_from_true)
        other_arms["other"] = {"base_from_other_base": base_from_other.tolist()}
    return Further({"cameras": cameras}, {"cameras": true, "arms": other_arms})


def _second_arm(
    options: SimulateOptions, scene: Scene, rng: np.random.Generator
) -> tuple[
    Float[ndarray, "4 4"],
    Float[ndarray, "n 4 4"],
    Float[ndarray, "n 4 4"],
    Float[ndarray, "4 4"],
    tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]],
]:
    """An arm across the table: its base from the first's, its true and reported poses, X, and the effective pair."""
    middle = scene.table_center_in_base
    turn = rotation_exp(np.array([0.0, 0.0, np.pi + rng.uniform(-0.4, 0.4)]))
    if options.robot is None:
        own_middle = middle + np.append(0.03 * rng.normal(size=2), 0.0)
        x = random_hand_eye(rng)
        true = gripper_poses("varied", options.images, own_middle, x, rng)
        other_from_base = transform(turn, own_middle - turn @ middle)
        return other_from_base, true, true, x, (x, np.eye(4))
    bent = bend(arm_named(options.robot), sizes_of(options), rng)
    own_middle = table_center(bent.arm)
    x = hand_eye_on(bent.arm, rng)
    joints = patterned(bent.arm, "varied", options.images, own_middle, x, rng)
    fit = effective_about(bent, x, options.images, rng, own_middle)
    other_from_base = transform(turn, own_middle - turn @ middle)
    effective = fit.gripper_from_camera, fit.base_from_recon
    return other_from_base, bent.true(joints), bent.reported(joints), x, effective


def _stated(lens: Intrinsics, options: SimulateOptions, rng: np.random.Generator) -> dict[str, Any] | None:
    return (
        None if options.unknown_intrinsics else lens_as_json(with_lens_error(lens, options.lens_error, rng))
    )


def _taken(
    out: Path,
    options: SimulateOptions,
    scene: Scene,
    lens: Intrinsics,
    places: Float[ndarray, "n 4 4"],
    name: str,
    suffix: str,
) -> list[str]:
    images = [f"{name}/{k:02d}.{suffix}" for k in range(len(places))]
    for k, view in enumerate(render(scene, lens, places, options.texture, with_truth=False)):
        noise = np.random.default_rng([options.seed, 15, k, *name.encode()])
        write_bytes(out / images[k], encoded(degraded(view.image, options, noise), options.jpeg_quality))
    return images


def simulate_eye_to_hand(out: Path, options: SimulateOptions, progress: Progress) -> Path:
    """Write a capture whose camera stands fixed and watches a package in the gripper, before the scene."""
    rng = np.random.default_rng([options.seed, 16])
    scene = make_scene(options.scene, options.seed, options.table)
    gripper_from_object = random_hand_eye(rng)
    if options.robot is None:
        middle = scene.table_center_in_base + [0.0, 0.0, 0.4]
        turns = rotation_exp(TURNS * rng.uniform(-1, 1, (options.images, 3)))
        reported = true = transform(
            turns @ rotation_exp(rng.normal(size=3)),
            middle + SHIFTS * rng.uniform(-1, 1, (options.images, 3)),
        )
        gripper_from_object[:3, 3] = [0.0, 0.0, AHEAD]
        joints, bent = None, None
    else:
        bent = bend(arm_named(options.robot), sizes_of(options), rng)
        scene = moved(scene, table_center(bent.arm))
        joints = about_posture(bent.arm, bent.arm.rest, options.images, rng)
        true, reported = bent.true(joints), bent.reported(joints)
        gripper_from_object[:3, 3] = AHEAD * bent.arm.forward
    middle = (true @ gripper_from_object)[:, :3, 3].mean(0)
    side = rng.uniform(0.3, 1.2) * rng.choice([-1, 1])
    away = AWAY * np.array([np.cos(side), np.sin(side), 0.5]) / np.hypot(1, 0.5)
    base_from_camera = looking_at(middle + away, middle, rng)
    found = base_from_camera, gripper_from_object
    if bent is not None:
        found = effective_exchanged(
            bent, about_posture(bent.arm, bent.arm.rest, EFFECTIVE_POSES, rng), *found
        )
    lens = pinhole(rng)
    thing = held_package(rng)
    images = []
    suffix = "png" if options.jpeg_quality == "lossless" else "jpg"
    for k, gripper in steps(progress, "render", list(enumerate(true))):
        carried = replace(thing, base_from_object=gripper @ gripper_from_object)
        shown = replace(scene, objects=(*scene.objects, carried))
        (view,) = render(shown, lens, base_from_camera[None], options.texture, with_truth=False)
        images.append(f"images/{k:02d}.{suffix}")
        noise = np.random.default_rng([options.seed, 7, k])
        write_bytes(out / images[-1], encoded(degraded(view.image, options, noise), options.jpeg_quality))
    frames: list[dict[str, Any]] = [
        {"image": image, "base_from_gripper": pose.tolist()}
        for image, pose in zip(images, with_robot_noise(reported, *options.robot_noise, rng), strict=True)
    ]
    if joints is not None:
        for frame, row in zip(frames, joints.tolist(), strict=True):
            frame["joints"] = row
    reference = {
        "base_from_camera": found[0].tolist(),
        "gripper_from_object": found[1].tolist(),
        "how": "simulated; of a bent arm the pair by which reported poses best predict what the camera sees",
    }
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    content = {
        "frames": frames,
        "intrinsics": _stated(lens, options, rng),
        "cameras": {"front": {"mount": "base", "watches": "gripper"}},
        **({} if options.robot is None else {"robot": options.robot}),
    }
    write_text(out / "capture.json", json.dumps(content, indent=1) + "\n")
    return out
