"""Further cameras of a simulated capture: beside the table, on the wrist, on a second arm; or one that watches."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.formats import capture_json
from jcr.files import write_text
from jcr.geometry import inverse, rotation_exp, transform
from jcr.progress import Progress, steps
from jcr.records import Capture, CellCamera, Intrinsics, Mount
from simulation.motion import Motion, bent_arm, motion_of
from simulation.objects import carried_package
from simulation.options import SimulateOptions
from simulation.poses import looking_at, random_hand_eye
from simulation.render import render
from simulation.robots import EFFECTIVE_POSES, about_posture, effective_exchanged, table_center
from simulation.scenes import Scene, make_scene, moved
from simulation.taken import image_suffix, pinhole, stated_intrinsics, with_robot_noise, write_image

AHEAD = 0.06
"""m from the gripper's frame to the bottom of what it carries."""
AWAY = 0.55
"""m from the camera that watches the gripper to what that carries."""
ROTATIONS, SHIFTS = np.array([0.55, 0.55, 1.0]), 0.07
"""rad and m to either side: how a gripper without an arm moves before it."""


def add_cameras(
    out: Path, options: SimulateOptions, scene: Scene, own: Motion
) -> tuple[tuple[CellCamera, ...], dict[str, Any]]:
    """Write images of the further cameras that the options ask for; the cameras, and their part of reference.json.

    Both are empty without further cameras. `own` is the motion of the capture's own camera.
    """
    rng = np.random.default_rng([options.seed, 14])
    cameras: list[CellCamera] = []
    true: dict[str, Any] = {}
    arms: dict[str, Any] = {}

    def add(
        name: str, mount: Mount, camera: Intrinsics, places: Float[ndarray, "n 4 4"], **of_mount: Any
    ) -> None:
        images = tuple(f"{name}/{k:02d}.{image_suffix(options)}" for k in range(len(places)))
        for k, view in enumerate(render(scene, camera, places, options.texture, with_truth=False)):
            write_image(out / images[k], view.image, options, [15, k, *name.encode()])
        size, stated = (camera.width, camera.height), stated_intrinsics(camera, options, rng)
        cameras.append(
            CellCamera(name=name, mount=mount, images=images, image_size=size, intrinsics=stated, **of_mount)
        )

    for k in range(options.fixed_cameras):
        camera, azimuth = pinhole(rng), rng.uniform(-2.6, 2.6)
        away = np.array([0.55 * np.cos(azimuth), 0.55 * np.sin(azimuth), rng.uniform(0.6, 0.8)])
        middle = scene.table_center_in_base
        place = looking_at(middle + away, middle, rng)
        add(f"fixed{k}", "base", camera, place[None])
        true[f"fixed{k}"] = {"base_from_camera": (own.base_from_true_base @ place).tolist()}
    if options.wrist_cameras > 1:
        camera = pinhole(rng)
        beside = transform(rotation_exp(0.05 * rng.normal(size=3)), np.array([0.06, 0.0, 0.0]))
        places = own.base_from_gripper @ own.physical @ beside
        add("second", "gripper", camera, places, frame=np.arange(len(places)))
        true["second"] = {"gripper_from_camera": (own.effective @ beside).tolist()}
    if options.arms > 1:
        camera = pinhole(rng)
        other_from_base, other = _second_arm(options, scene, rng)
        places = inverse(other_from_base) @ other.base_from_gripper @ other.physical
        reported = with_robot_noise(other.reported, *options.robot_noise, rng)
        add("other_wrist", "gripper", camera, places, arm="other", base_from_gripper=reported)
        true["other_wrist"] = {"gripper_from_camera": other.effective.tolist()}
        base_from_other = (
            own.base_from_true_base @ inverse(other_from_base) @ inverse(other.base_from_true_base)
        )
        arms["other"] = {"base_from_other_base": base_from_other.tolist()}
    return tuple(cameras), {"cameras": true, "arms": arms} if cameras else {}


def _second_arm(
    options: SimulateOptions, scene: Scene, rng: np.random.Generator
) -> tuple[Float[ndarray, "4 4"], Motion]:
    """An arm across the table: other_from_base, and its motion in its own base."""
    middle = scene.table_center_in_base
    rotation = rotation_exp(np.array([0.0, 0.0, np.pi + rng.uniform(-0.4, 0.4)]))
    aside = np.zeros(2) if options.robot else 0.03 * rng.normal(size=2)
    motion = motion_of(replace(options, pattern="varied"), middle + np.append(aside, 0.0), (rng, rng, rng))
    return transform(rotation, motion.target_in_base - rotation @ middle), motion


def simulate_eye_to_hand(out: Path, options: SimulateOptions, progress: Progress) -> Path:
    """Write a capture whose camera stands fixed and watches a package in the gripper, before the scene."""
    rng = np.random.default_rng([options.seed, 16])
    scene = make_scene(options.scene, options.seed, options.table)
    gripper_from_object = random_hand_eye(rng)
    joints, bent = None, None
    if options.robot is None:
        reported = true = _gripper_without_arm(scene, options.images, rng)
        gripper_from_object[:3, 3] = [0.0, 0.0, AHEAD]
    else:
        bent = bent_arm(options, options.robot, rng)
        scene = moved(scene, table_center(bent.arm))
        joints = about_posture(bent.arm, bent.arm.rest, options.images, rng)
        true, reported = bent.true(joints), bent.reported(joints)
        gripper_from_object[:3, 3] = AHEAD * bent.arm.forward
    middle = (true @ gripper_from_object)[:, :3, 3].mean(0)
    side = rng.uniform(0.3, 1.2) * rng.choice([-1, 1])
    away = AWAY * np.array([np.cos(side), np.sin(side), 0.5]) / np.hypot(1, 0.5)
    base_from_camera = looking_at(middle + away, middle, rng)
    effective = base_from_camera, gripper_from_object
    if bent is not None:
        others = about_posture(bent.arm, bent.arm.rest, EFFECTIVE_POSES, rng)
        effective = effective_exchanged(bent, others, *effective)
    camera, package = pinhole(rng), carried_package(rng)
    images = tuple(f"images/{k:02d}.{image_suffix(options)}" for k in range(options.images))
    for k, gripper in steps(progress, "render", list(enumerate(true))):
        carried = replace(package, base_from_object=gripper @ gripper_from_object)
        shown = replace(scene, objects=(*scene.objects, carried))
        (view,) = render(shown, camera, base_from_camera[None], options.texture, with_truth=False)
        write_image(out / images[k], view.image, options, [7, k])
    reference = {
        "base_from_camera": effective[0].tolist(),
        "gripper_from_object": effective[1].tolist(),
        "how": "simulated; of a bent arm the pair by which reported poses best predict what the camera sees",
    }
    write_text(out / "reference.json", json.dumps(reference, indent=1) + "\n")
    capture = Capture(
        folder=out,
        images=images,
        base_from_gripper=with_robot_noise(reported, *options.robot_noise, rng),
        image_size=(camera.width, camera.height),
        intrinsics=stated_intrinsics(camera, options, rng),
        joints=joints,
        robot=options.robot,
        camera_name="front",
        mount="base",
    )
    capture_json.write(out, capture)
    return out


def _gripper_without_arm(scene: Scene, count: int, rng: np.random.Generator) -> Float[ndarray, "n 4 4"]:
    """base_from_gripper (n,4,4) of a gripper that rotates in one place above the table."""
    middle = scene.table_center_in_base + [0.0, 0.0, 0.4]
    rotations = rotation_exp(ROTATIONS * rng.uniform(-1, 1, (count, 3)))
    first = rotation_exp(rng.normal(size=3))
    return transform(rotations @ first, middle + SHIFTS * rng.uniform(-1, 1, (count, 3)))
