"""`benchmarks depth`: completeness and accuracy of dense depth on simulated scenes, by texture and by reason."""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from benchmarks.map import places_to_ask, score
from benchmarks.peers import WEBCAM
from jcr.calibration.stage import calibrate
from jcr.camera import project, rays
from jcr.capture.read import read_capture
from jcr.depth.densify import densify
from jcr.geometry import apply, inverse
from jcr.reconstruct import ReconstructOptions, reconstruct
from jcr.records import BOTH, MATCHED, PRIOR, HandEye, Intrinsics, Reconstruction
from jcr.scene.build import build_scene
from jcr.scene.cloud import point_cloud
from simulation.capture import SimulateOptions, simulate
from simulation.truth import read_truth, true_depth, true_labels

LIMITS_MM = (2, 5, 10)
PLAIN, WEAK = 2.0, 6.0
"""Standard deviations of grey (of 255) in 9x9 pixels below which a place is plain, or weakly textured."""
PLACES = 20_000
SEES = 0.003
"""m. An image sees a place that lies so little behind what it shows there."""
SCENES = {
    "textured table": ("colmap", SimulateOptions()),
    "plain table, webcam": ("colmap", SimulateOptions(scene="light8", **WEBCAM)),
    "everything plain": ("direct", SimulateOptions(seed=1, texture=False)),
}


@dataclass(frozen=True)
class Shown:
    """What the pixels of a pointmap truly show."""

    depth: Float[ndarray, "m h w"]
    x_in_base: Float[ndarray, "m h w 3"]
    asked: Bool[ndarray, "m h w"]
    """Table or object within the workspace, which another image shows as well."""
    table: Bool[ndarray, "m h w"]
    texture: Int[ndarray, "m h w"]
    """0 plain, 1 weak, 2 textured."""


def run() -> str:
    """Markdown tables."""
    lines, claims = [], []
    scenes = list(SCENES.items())
    for name, (backend, options) in scenes:
        with tempfile.TemporaryDirectory() as folder:
            made = simulate(Path(folder) / "capture", options)
            capture = read_capture(made)
            begun = time.perf_counter()
            found = densify(capture, reconstruct(capture, ReconstructOptions(backend=backend)))
            seconds = time.perf_counter() - begun
            hand_eye = calibrate(capture, found)
            shown = shown_by(made, found)
            table, things = covered(found, hand_eye, shown)
            cloud = point_cloud(capture, found, hand_eye)
            mapped = score(build_scene(cloud), places_to_ask(read_truth(made)))
        claims.append(
            f"> {name}: within 5 mm {table[1]:.1f} % of the table and {things[1]:.1f} % of the objects that two views "
            f"or more see; map: F at 1 cm {100 * mapped.f_10mm:.1f} %, false free "
            f"{100 * mapped.false_free_inside:.3f} %, false occupied {100 * mapped.false_occupied:.3f} %."
        )
        lines += [
            "",
            f"## {name}",
            "",
            f"Back end {backend}, {len(found.image_index)} images, reconstruction {seconds:.0f} s; "
            f"{100 * (found.dense.confidence > 0).mean():.1f} % of all pixels have a depth. Places covered by all "
            f"pointmaps within {', '.join(map(str, LIMITS_MM))} mm: table {_shares(table)} %, objects "
            f"{_shares(things)} %.",
            "",
            *by_texture(found, hand_eye, shown),
        ]
    return "\n".join([*claims, *lines]) + "\n"


def shown_by(folder: Path, found: Reconstruction) -> Shown:
    """The truth of a simulated capture at the pixels of its pointmaps."""
    truth, grid = read_truth(folder), found.dense.intrinsics
    direction = rays(grid)
    place = project(truth.intrinsics, direction).astype(np.float32)
    nearest = np.rint(place).astype(int).clip(0, [truth.intrinsics.width - 1, truth.intrinsics.height - 1])
    depth, label = [], []
    for k in found.image_index.tolist():
        at_pixel = true_depth(truth, k)[nearest[..., 1], nearest[..., 0]]
        between = cv2.remap(
            true_depth(truth, k).astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR
        )
        depth.append(np.where(np.abs(between - at_pixel) < SEES, between, at_pixel))
        label.append(true_labels(truth, k)[nearest[..., 1], nearest[..., 0]])
    base_from_camera = truth.base_from_camera[found.image_index]
    x = np.stack(
        [apply(pose, z[..., None] * direction) for pose, z in zip(base_from_camera, depth, strict=True)]
    )
    low, high = truth.workspace_in_base
    labels = np.stack(label)
    asked = (labels > 0) & ((x >= low) & (x <= high)).all(-1)
    others = np.zeros(asked.shape, int)
    for i in range(len(x)):
        for j in range(len(x)):
            if i != j:
                others[i] += _sees(apply(inverse(base_from_camera[j]), x[i]), depth[j], grid)
    grey = found.dense.colors.mean(-1).astype(np.float32)
    spread = [np.sqrt(np.maximum(cv2.blur(g * g, (9, 9)) - cv2.blur(g, (9, 9)) ** 2, 0)) for g in grey]
    texture = np.digitize(np.stack(spread), [PLAIN, WEAK])
    return Shown(np.stack(depth), x, asked & (others > 0), labels == 1, texture)


def _sees(x: Float[ndarray, "h w 3"], depth: Float[ndarray, "h w"], grid: Intrinsics) -> Bool[ndarray, "h w"]:
    """Whether points in a camera's frame are what its depth image shows, give or take a pixel."""
    ahead = np.where(x[..., 2:] > 0, x, [0.0, 0.0, 1.0])
    u, v = np.moveaxis(np.rint(project(grid, ahead)), -1, 0)
    inside = (x[..., 2] > 0) & (u >= 0) & (v >= 0) & (u < grid.width) & (v < grid.height)
    u, v = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    return inside & (x[..., 2] > near[v, u] - SEES) & (x[..., 2] < far[v, u] + SEES)


def covered(
    found: Reconstruction, hand_eye: HandEye, shown: Shown
) -> tuple[Float[ndarray, " k"], Float[ndarray, " k"]]:
    """Percent of the table's and the objects' places with a point of all pointmaps within each limit."""
    has = found.dense.confidence > 0
    x = hand_eye.scale * found.dense.points_in_recon[has].astype(np.float64)
    tree = KDTree(apply(hand_eye.base_from_recon, x))
    drawn = np.random.default_rng(0).choice(int(shown.asked.sum()), PLACES, replace=False)
    distance = tree.query(shown.x_in_base[shown.asked][drawn], distance_upper_bound=0.011)[0]
    table = shown.table[shown.asked][drawn]
    shares = [(1e3 * distance[:, None] <= LIMITS_MM)[rows].mean(0) for rows in (table, ~table)]
    return 100 * shares[0], 100 * shares[1]


def by_texture(found: Reconstruction, hand_eye: HandEye, shown: Shown) -> list[str]:
    """A table: of the pixels that another image shows too, how many have a depth and how good it is."""
    direction = rays(found.dense.intrinsics)
    pairs = zip(inverse(found.recon_from_camera), found.dense.points_in_recon, strict=True)
    depth = np.stack([apply(pose, x.astype(np.float64))[..., 2] for pose, x in pairs])
    error_mm = 1e3 * np.abs(hand_eye.scale * depth - shown.depth) * np.linalg.norm(direction, axis=-1)
    has = found.dense.confidence > 0
    reason = found.dense.reason
    assert reason is not None
    lines = [
        "| pixels of | share, % | with depth, % | complete at 2, 5, 10 mm, % | accurate at 2, 5, 10 mm, % | off by more "
        "than 5 mm, %: matched | both | prior |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for thing, of_thing in (("table", shown.table), ("objects", ~shown.table)):
        for k, kind in enumerate(("plain", "weak", "textured")):
            rows = shown.asked & of_thing & (shown.texture == k)
            if rows.sum() < 500:
                continue
            good = [rows & has & (error_mm < limit) for limit in LIMITS_MM]
            complete = _shares(np.array([100 * g.sum() / rows.sum() for g in good]))
            accurate = _shares(np.array([100 * g.sum() / max((rows & has).sum(), 1) for g in good]))
            off = []
            for why in (MATCHED, BOTH, PRIOR):
                of_reason = rows & has & (reason == why)
                off.append(f"{100 * (error_mm > 5)[of_reason].mean():.1f}" if of_reason.any() else "")
            lines.append(
                f"| {thing}, {kind} | {100 * rows.sum() / shown.asked.sum():.1f} | {100 * has[rows].mean():.1f} | "
                f"{complete} | {accurate} | {' | '.join(off)} |"
            )
    return lines


def _shares(percent: Float[ndarray, " k"]) -> str:
    return ", ".join(f"{share:.1f}" for share in percent)
