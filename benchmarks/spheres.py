"""Spheres that a map calls free at 95 %, in simulated cells whose true surfaces are known."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.special import ndtri

from benchmarks.page import table
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.camera import rays, resized, without_distortion
from jcr.errors import RejectedError
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.geometry import apply, inverse, rotation_exp, scale_translation, transform
from jcr.records import Capture, Pointmaps, Reconstruction, Tracks
from jcr.scene.build import build_scene
from jcr.scene.cloud import point_cloud
from jcr.scene.options import MapOptions
from jcr.scene.scene_map import SceneMap
from jcr.scene.uncertainty import map_uncertainty
from simulation.arms import (
    PRESETS,
    PresetName,
    bend,
    effective_about,
    hand_eye_on,
    table_center,
    view_size,
    views,
)
from simulation.pairs import scene_depth, scene_distance, smooth_noise
from simulation.problems import INTRINSICS, disturbed, shown_points

CELLS, COUNTS = 40, (6, 8, 10, 12)
"""Number of cells, and images of the captures of each."""
ERRORS: tuple[PresetName, ...] = ("factory-calibrated", "typical", "poor", "white")
"""Errors of the arms, cell by cell."""
SHRUNK = 0.6
"""Size of the scene of simulation.pairs before a UR5e."""
DEPTH_STD = 0.002
"""Standard deviation of the depth, relative to it: smooth over each image, and as much again white."""
CAMERAS_STD = (5e-5, float(np.radians(0.005)))
"""m, rad per axis of the reconstructed cameras."""
FEATURES, PIXEL_STD = 50, 0.3
"""Features drawn in each image, and errors of their observations (px)."""
GRID = (128, 96)
SPHERES, RADII, CLEARANCE = 4000, (0.01, 0.05), 0.01
"""Spheres of a capture; their radii (m); largest distance (m) from their surface to the true surface."""
CONFIDENCE, CELL_M, PATIENCE_S = 0.95, 0.01, 10.0
STATED = (0.01, 0.05, 0.1, 0.25, 0.5)
"""Borders of the groups by stated probability of a collision."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers of the map of one accepted capture, a sphere each."""

    cell: int
    images: int
    errors: str
    collides: Bool[ndarray, " n"]
    """Whether the sphere reaches the true surface."""
    gap: Float[ndarray, " n"]
    """Distance in the map minus radius, m."""
    std: Float[ndarray, " n"]
    probability: Float[ndarray, " n"]
    """Stated probability of a collision, where seen surfaces alone count."""
    called_free: Bool[ndarray, " n"]
    """Whether the map calls it free at CONFIDENCE, where seen surfaces alone count."""
    called_seen_free: Bool[ndarray, " n"]
    """Whether the map calls it free at CONFIDENCE, where unseen space counts as occupied."""
    surface_off: Float[ndarray, " n"]
    """True distance minus distance in the map (m) at the centre, over its stated standard deviation."""


def run(every: int = 1) -> str:
    """Return the page in Markdown, of one cell in `every`."""
    begun = time.process_time()
    found, tried = list[Answers](), 0
    for cell in range(0, CELLS, every):
        for number, count in enumerate(COUNTS):
            tried += 1
            if (one := answers(cell, number, count)) is not None:
                found.append(one)
    seconds = (time.process_time() - begun) / tried
    names = "collides", "gap", "std", "probability", "called_free"
    collides, gap, std, chance, stated = (
        np.concatenate([getattr(one, name) for one in found]) for name in names
    )
    groups = [
        f"{100 * low:.0f} to {100 * high:.0f} %: {100 * collides[(chance >= low) & (chance < high)].mean():.1f} %"
        for low, high in pairwise(STATED)
    ]
    # The mean over z of P(error > z σ), z from the quantile on, for depths uniform up to CLEARANCE.
    z = ndtri(CONFIDENCE)
    exact = std.mean() / CLEARANCE * (np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) - z * (1 - CONFIDENCE))
    same = float(np.quantile(gap[collides], 1 - stated[collides].mean()))
    share = float(stated[collides].mean())
    lost = 1 - stated[~collides].mean(), 1 - (gap[~collides] > same).mean(), 1 - (gap[~collides] > 0).mean()
    by_cell: dict[int, list[Answers]] = {}
    for one in found:
        by_cell.setdefault(one.cell, []).append(one)
    worst = max(wrongly_free(own) for own in by_cell.values())
    within = np.mean([wrongly_free(own) <= 1 - CONFIDENCE for own in by_cell.values()])
    rows = [
        [name, value, *_cells([one for one in found if str(getattr(one, field)) == value], same)]
        for name, field, values in (("images", "images", map(str, COUNTS)), ("arm", "errors", ERRORS))
        for value in values
    ]
    safe = np.concatenate([one.called_seen_free for one in found])
    lines = [
        f"> Of the spheres that truly collide, {100 * share:.1f} % are called free at {CONFIDENCE}, "
        f"{100 * worst:.1f} % in the worst of {len(by_cell)} cells; without a margin "
        f"{100 * (gap[collides] > 0).mean():.1f} %. Of the free ones {100 * lost[0]:.1f} % are lost, "
        f"{100 * lost[1]:.1f} % by the constant margin "
        f"({1e3 * same:.1f} mm) that calls as many free wrongly, {100 * lost[2]:.1f} % without a margin.",
        f"> Collisions by stated probability: {'; '.join(groups)}.",
        f"> Where unseen space counts as occupied, {100 * safe[collides].mean():.1f} % are called free at {CONFIDENCE}, "
        f"and {100 * (1 - safe[~collides].mean()):.1f} % of the free ones are lost.",
        "",
        f"{len(by_cell)} cells of arms with errors, {len(COUNTS)} captures each; {len(found)} of {tried} captures are "
        f"accepted. {SPHERES:,} spheres a capture of {100 * RADII[0]:.0f} to {100 * RADII[1]:.0f} cm radius, their "
        f"surface within {1e3 * CLEARANCE:.0f} mm of a true surface that the images show; seen surfaces alone count. "
        "Cameras and features are simulated, and the calibration is that of `jcr calibrate`; depth has errors of "
        f"{100 * DEPTH_STD:.1f} %, smooth and white. In {100 * within:.0f} % of the cells at most "
        f"{100 * (1 - CONFIDENCE):.0f} % are called free. {seconds:.1f} s of processor a capture.",
        "",
        f"Of colliding spheres far fewer than {100 * (1 - CONFIDENCE):.0f} % are called free, because {CONFIDENCE} is "
        "the probability of each sphere, and most of the colliding spheres are deeper than those at the end of the "
        f"margin. With normal errors of exactly the stated σ it would be {100 * exact:.2f} %, for depths uniform up to "
        f"{1e3 * CLEARANCE:.0f} mm.",
        "",
        *table(
            f"by | | captures | collide, called free: no margin | {CONFIDENCE} | {1e3 * same:.1f} mm | "
            f"free, lost: no margin | {CONFIDENCE} | {1e3 * same:.1f} mm | σ, median | surface beyond 1.645 σ",
            rows,
        ),
    ]
    return "\n".join(lines) + "\n"


def wrongly_free(found: Sequence[Answers]) -> float:
    """Return the share of colliding spheres that are called free."""
    return float(np.concatenate([one.called_free[one.collides] for one in found]).mean())


def _cells(found: Sequence[Answers], constant: float) -> list[str]:
    """Return the cells of a row: captures, shares wrongly free and lost by no, stated and constant margin, σ."""
    if not found:
        return ["0", *[""] * 8]
    names = ("collides", "gap", "called_free", "std", "surface_off")
    collides, gap, stated, std, off = (
        np.concatenate([getattr(one, name) for one in found]) for name in names
    )
    free = gap > 0, stated, gap > constant
    shares = [*(one[collides].mean() for one in free), *(1 - one[~collides].mean() for one in free)]
    return [
        str(len(found)),
        *(f"{100 * share:.1f} %" for share in shares),
        f"{1e3 * np.median(std):.2f} mm",
        f"{100 * (off < -1.645).mean():.1f} %",
    ]


def answers(cell: int, number: int, count: int) -> Answers | None:
    """Simulate one capture of a cell, calibrate and map it, and ask the map; None where it is rejected."""
    hand_eye, arms, elsewhere = (np.random.default_rng([cell, stream]) for stream in (0, 2, 4))
    rng, arm = np.random.default_rng([cell, 10 + number]), arm_named(ROBOT_NAMES[cell % len(ROBOT_NAMES)])
    errors = ERRORS[cell % len(ERRORS)]
    physical, bent = hand_eye_on(arm, hand_eye), bend(arm, PRESETS[errors], arms)
    size = SHRUNK * max(view_size(arm), 0.55)
    joints, effective = views(arm, count, physical, rng), effective_about(bent, physical, count, elsewhere)
    base_from_camera = bent.true(joints) @ physical
    # The scene rests in the true base; a calibration finds it in the base that fits the reported poses.
    scene_from_true_base = transform(np.eye(3), -table_center(arm))
    scene_from_base = scene_from_true_base @ inverse(effective.base_from_recon)
    capture = Capture(
        folder=Path(),
        images=tuple(f"{k}.png" for k in range(count)),
        base_from_gripper=disturbed(bent.reported(joints), PRESETS[errors].white, rng),
        image_size=(INTRINSICS.width, INTRINSICS.height),
        intrinsics=INTRINSICS,
    )
    made, surface = _reconstruction(scene_from_true_base @ base_from_camera, size, rng)
    surface = apply(inverse(scene_from_base), surface)
    try:
        found = calibrate_reconstruction(capture, made)
    except RejectedError:
        return None
    if not found.converged:
        return None
    cloud = point_cloud(capture, made, found)
    low, high = np.percentile(surface, [2, 98], axis=0)
    box = (*(low - 0.06).tolist(), *(high + 0.06).tolist())
    scene = build_scene(cloud, MapOptions(workspace=box, cell=CELL_M, max_seconds=PATIENCE_S))
    scene.set_uncertainty(map_uncertainty(scene, cloud, found))
    inside = ((surface > low) & (surface < high)).all(1)
    asked = _asked(scene, surface[inside], scene_from_base, size, rng)
    return Answers(cell=cell, images=count, errors=errors, **asked)


def _reconstruction(
    scene_from_camera: Float[ndarray, "n 4 4"], size: float, rng: np.random.Generator
) -> tuple[Reconstruction, Float[ndarray, "k 3"]]:
    """Return cameras, features and depth images with errors, in a frame and unit of their own, and true points (m).

    The scene is that of simulation.pairs, `size` times as large; `scene_from_camera` are the true cameras in its frame.
    """
    count, pinhole = len(scene_from_camera), resized(without_distortion(INTRINSICS), *GRID)
    ray = rays(pinhole)
    in_scene = transform(scene_from_camera[:, :3, :3], scene_from_camera[:, :3, 3] / size)
    depth = size * np.stack([scene_depth(pose, ray) for pose in in_scene])
    errors = np.stack([smooth_noise(rng, *ray.shape[:2]) for _ in depth]) + rng.normal(size=depth.shape)
    exact, measured = (depth, depth * (1 + DEPTH_STD * errors))
    recon_from_scene = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    scale = float(np.exp(rng.uniform(-1, 1)))
    cameras = scale_translation(disturbed(recon_from_scene @ scene_from_camera, CAMERAS_STD, rng), 1 / scale)
    points = [apply(pose, z[..., None] * ray / scale) for pose, z in zip(cameras, measured, strict=True)]
    true = np.stack(
        [apply(pose, z[..., None] * ray) for pose, z in zip(scene_from_camera, exact, strict=True)]
    )
    near = true.reshape(count, -1, 3)
    drawn = np.concatenate([own[rng.choice(len(own), FEATURES, replace=False)] for own in near])
    image, point, x_px = shown_points(drawn, scene_from_camera, [INTRINSICS] * count, PIXEL_STD, rng)
    made = Reconstruction(
        image_index=np.arange(count),
        recon_from_camera=cameras,
        intrinsics=INTRINSICS,
        tracks=Tracks(
            image=image, x_px=x_px, point=point, points_in_recon=apply(recon_from_scene, drawn) / scale
        ),
        pointmaps=Pointmaps(
            intrinsics=pinhole,
            points_in_recon=np.stack(points).astype(np.float32),
            confidence=np.ones(depth.shape, np.float32),
            colors=np.full((*depth.shape, 3), 128, np.uint8),
        ),
        backend="simulated",
    )
    close = np.linalg.norm(true - scene_from_camera[:, None, None, :3, 3], axis=-1) < 1.5 * np.median(depth)
    return made, true[close]


def _asked(
    scene: SceneMap,
    surface: Float[ndarray, "k 3"],
    scene_from_base: Float[ndarray, "4 4"],
    size: float,
    rng: np.random.Generator,
) -> dict[str, ndarray]:
    """Return truth and the map's answers for spheres about points (m, base frame) of the true surface."""

    def clearance(x: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
        """Return the true distance (m) of places in the base frame from the scene."""
        return size * scene_distance(apply(scene_from_base, x) / size)

    at = surface[rng.choice(len(surface), SPHERES)]
    steps = 1e-4 * np.eye(3)
    normal = np.stack([clearance(at + h) - clearance(at - h) for h in steps], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = rng.uniform(*RADII, SPHERES)
    centers = at + (radius + rng.uniform(-CLEARANCE, CLEARANCE, SPHERES))[:, None] * normal
    sample, true = scene.query(centers, unknown="free"), clearance(centers)
    inside = np.isfinite(sample.distance)
    free, safe = (
        ~scene.check_spheres(centers, radius, unknown, confidence=CONFIDENCE)
        for unknown in ("free", "occupied")
    )
    return {
        "collides": (true < radius)[inside],
        "gap": (sample.distance - radius)[inside],
        "std": sample.std[inside],
        "probability": scene.check_spheres(centers, radius, "free", probability=True)[inside],
        "called_free": free[inside],
        "called_seen_free": safe[inside],
        "surface_off": ((true - sample.distance) / sample.std)[inside],
    }
