"""`benchmarks gate`: scenes that mislead matching, with the robot's gate and without."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from benchmarks.matching import off, sigmas
from jcr.calibration.stage import calibrate
from jcr.errors import RejectedError
from jcr.geometry import Transforms, inverse, rotation_exp, transform
from jcr.match.matchers import FeatureName
from jcr.reconstruct.colmap import reconstruct_colmap
from jcr.reconstruct.colmap_options import ColmapOptions
from jcr.records import Capture, Intrinsics
from jcr.simulate.poses import gripper_poses, random_hand_eye
from jcr.simulate.render import render
from jcr.simulate.scenes import Scene, make_scene
from jcr.simulate.taken import with_robot_noise

IMAGES = 9
SEEDS: dict[FeatureName, int] = {"sift": 1}
LONG_SEEDS: dict[FeatureName, int] = {"sift": 2, "xfeat": 1}
"""Draws of every scene with --long; a network takes several times as long."""
ROBOT_NOISE = 0.2, 0.05
"""mm, degrees."""
WRONG_SIGMAS = 5.0
WRONG_MM, WRONG_DEG = 10.0, 1.0
"""An accepted result is wrong beyond its σ by so much and beyond what a person would call right."""


@dataclass(frozen=True)
class Drawn:
    """A simulated capture with its truth."""

    capture: Capture
    gripper_from_camera: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Verdict:
    """What came of one run."""

    kind: str
    features: FeatureName
    gate: bool
    registered: int
    accepted: bool
    wrong: bool
    off_mm: float | None
    seconds: float


def run(long: bool = False) -> str:
    """Markdown: for every kind of scene the share of right, accepted and wrong results with the gate and without."""
    verdicts, seeds = [], LONG_SEEDS if long else SEEDS
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            for seed in range(max(seeds.values())):
                drawn = draw(kind, seed, Path(folder) / f"{kind.replace(' ', '-')}-{seed}")
                seen: list[FeatureName] = [name for name, count in seeds.items() if seed < count]
                for features in seen:
                    verdicts += [judged(kind, drawn, features, gate) for gate in (True, False)]
    return table(verdicts, seeds)


def table(verdicts: Sequence[Verdict], seeds: Mapping[FeatureName, int]) -> str:
    """Markdown of the verdicts."""
    lines = []
    for kind in KINDS:
        for features in seeds:
            cells = []
            for gate in (True, False):
                some = [v for v in verdicts if (v.kind, v.features, v.gate) == (kind, features, gate)]
                right = sum(v.accepted and not v.wrong for v in some)
                off_mm = [v.off_mm for v in some if v.off_mm is not None]
                cells.append(
                    f"{right} / {sum(v.accepted for v in some)} / {sum(v.accepted and v.wrong for v in some)} | "
                    f"{np.mean([v.registered for v in some]):.1f} | "
                    f"{f'{np.median(off_mm):.1f}' if off_mm else '–'} | {np.mean([v.seconds for v in some]):.0f}"
                )
            lines.append(f"| {kind} | {features} | {cells[0]} | {cells[1]} |")
    wrong = {gate: sum(v.accepted and v.wrong for v in verdicts if v.gate == gate) for gate in (True, False)}
    right = {
        gate: sum(v.accepted and not v.wrong for v in verdicts if v.gate == gate) for gate in (True, False)
    }
    total = len(verdicts) // 2
    head = (
        f"> Misleading scenes, {total} runs each way: with the robot's gate {right[True]} right and {wrong[True]} wrong "
        f"that were accepted, without {right[False]} right and {wrong[False]} wrong."
    )
    return (
        "\n".join(
            [
                head,
                "",
                f"{IMAGES} images of 640x480, robot pose noise {ROBOT_NOISE[0]} mm and {ROBOT_NOISE[1]}°; "
                f"{', '.join(f'{count} of each with {name}' for name, count in seeds.items())}. "
                f"Wrong: over {WRONG_MM:.0f} mm or {WRONG_DEG:.0f}° off and beyond {WRONG_SIGMAS:.0f} of its own σ; "
                "right: accepted and not wrong. Off: median distance from the truth, accepted or not.",
                "",
                "| scene | features | gate: right / accepted / wrong | images registered | off, mm | s "
                "| no gate: right / accepted / wrong | images registered | off, mm | s |",
                "|---" * 10 + "|",
                *lines,
            ]
        )
        + "\n"
    )


def judged(kind: str, drawn: Drawn, features: FeatureName, gate: bool) -> Verdict:
    """One reconstruction and calibration, held against the truth."""
    begun = time.perf_counter()
    options = ColmapOptions(features=features, robot_checks=gate)
    try:
        made = reconstruct_colmap(drawn.capture, options)
        hand_eye = calibrate(drawn.capture, made)
    except RejectedError:
        return Verdict(kind, features, gate, 0, False, False, None, time.perf_counter() - begun)
    seconds = time.perf_counter() - begun
    mm, deg = off(hand_eye.gripper_from_camera, drawn.gripper_from_camera)
    wrong = sigmas(hand_eye, drawn.gripper_from_camera) > WRONG_SIGMAS and (mm > WRONG_MM or deg > WRONG_DEG)
    registered = len(made.image_index)
    return Verdict(kind, features, gate, registered, hand_eye.converged, wrong, mm, seconds)


def draw(kind: str, seed: int, folder: Path) -> Drawn:
    """A capture of one of KINDS, written to `folder`."""
    motion = np.random.default_rng([seed, 4])
    scene = KINDS[kind](make_scene("tabletop", seed), np.random.default_rng([seed, 11]))
    x = random_hand_eye(motion)
    gripper = gripper_poses("varied", IMAGES, scene.table_center_in_base, x, motion)
    if kind in _ROLLS:
        gripper = gripper @ _rolled(x, _ROLLS[kind])
    intrinsics = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)
    images = [view.image for view in render(scene, intrinsics, gripper @ x, with_truth=False)]
    if kind == "moved object":
        other = _with_moved_object(scene)
        for k in range(0, IMAGES, 3):
            images[k] = next(
                iter(render(other, intrinsics, (gripper @ x)[k : k + 1], with_truth=False))
            ).image
    if kind == "own fingers":
        images = [_with_fingers(image) for image in images]
    folder.mkdir(parents=True)
    names = tuple(f"{k:02d}.png" for k in range(IMAGES))
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(folder / name)
    reported = with_robot_noise(gripper, *ROBOT_NOISE, np.random.default_rng([seed, 6]))
    return Drawn(
        Capture(
            folder=folder,
            images=names,
            base_from_gripper=reported,
            image_size=(640, 480),
            intrinsics=intrinsics,
        ),
        x,
    )


def _on_table(
    scene: Scene, paint: Callable[[tuple[int, ...]], UInt8[ndarray, "h w 3"]], objects: int
) -> Scene:
    """The scene with another table top, and fewer objects on it."""
    top, *rest = scene.table
    assert top.texture is not None
    table = replace(top, texture=paint(top.texture.shape))
    return replace(scene, table=(table, *rest), objects=scene.objects[:objects])


def _chessboard(scene: Scene, rng: np.random.Generator) -> Scene:
    def paint(shape: tuple[int, ...]) -> UInt8[ndarray, "h w 3"]:
        row, column = np.indices(shape[:2]) // 60
        return np.repeat(np.where((row + column) % 2, 215, 40)[..., None], 3, 2).astype(np.uint8)

    return _on_table(scene, paint, 2)


def _equal_parts(scene: Scene, rng: np.random.Generator) -> Scene:
    tile = rng.integers(60, 200, (10, 10, 3)).astype(np.uint8)
    tile = cv2.resize(tile, (120, 120), interpolation=cv2.INTER_CUBIC)

    def paint(shape: tuple[int, ...]) -> UInt8[ndarray, "h w 3"]:
        times = -(-shape[0] // 120), -(-shape[1] // 120), 1
        return np.tile(tile, times)[: shape[0], : shape[1]]

    return _on_table(scene, paint, 2)


def _wood(scene: Scene, rng: np.random.Generator) -> Scene:
    return replace(scene, objects=scene.objects[:1])


def _as_it_is(scene: Scene, rng: np.random.Generator) -> Scene:
    return scene


KINDS: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "chessboard table": _chessboard,
    "equal parts": _equal_parts,
    "wood grain": _wood,
    "rolls of 90°": _as_it_is,
    "rolls of 180°": _as_it_is,
    "moved object": _as_it_is,
    "own fingers": _as_it_is,
}
_ROLLS = {"rolls of 90°": 90.0, "rolls of 180°": 180.0}


def _rolled(gripper_from_camera: Float[ndarray, "4 4"], step_deg: float) -> Transforms:
    """Gripper motions that rotate every image against the one before about the viewing axis."""
    rotations = np.radians(step_deg) * np.arange(IMAGES)[:, None] * np.array([0.0, 0.0, 1.0])
    about_axis = transform(rotation_exp(rotations), np.zeros(3))
    return gripper_from_camera @ about_axis @ inverse(gripper_from_camera)


def _with_moved_object(scene: Scene) -> Scene:
    """The scene with its largest object 10 cm aside and rotated."""
    largest = max(range(len(scene.objects)), key=lambda k: scene.objects[k].radius)
    aside = transform(rotation_exp(np.array([0.0, 0.0, 0.6])), np.array([0.07, -0.07, 0.0]))
    objects = list(scene.objects)
    objects[largest] = replace(objects[largest], base_from_object=objects[largest].base_from_object @ aside)
    return replace(scene, objects=tuple(objects))


def _with_fingers(image: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Two printed fingers that reach into the image from below, the same in all."""
    rng = np.random.default_rng(0)
    out = image.copy()
    for left in (190, 380):
        finger = cv2.resize(
            rng.integers(0, 255, (45, 18, 3)).astype(np.uint8), (72, 180), interpolation=cv2.INTER_NEAREST
        )
        out[300:480, left : left + 72] = finger
    return out
