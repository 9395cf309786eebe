"""Map, dense depth and heights of objects, against simulated truth."""

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from benchmarks.page import of_rows, table
from benchmarks.peers import WEBCAM
from jcr.backends import ReconstructOptions, reconstruct
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.record import Calibration
from jcr.camera import project
from jcr.capture.read import read_capture
from jcr.depth.densify import densify
from jcr.errors import InputError
from jcr.export.options import ExportOptions, provenance
from jcr.export.planner_maps import write_octomap
from jcr.geometry import apply, inverse
from jcr.paper.fields import published_scene
from jcr.records import PointCloud, Reconstruction
from jcr.scene.build import build_scene
from jcr.scene.cloud import point_cloud
from jcr.scene.options import MapOptions
from jcr.scene.scene_map import SceneMap
from jcr.segments.measure import ObjectSize, measure_objects
from jcr.segments.segmentation import read_labels
from jcr.segments.tabletop import label_tabletop
from simulation.capture import SimulateOptions, simulate
from simulation.scenes import make_scene, solid_labels
from simulation.truth import (
    TrueObject,
    Truth,
    read_truth,
    surface_in_workspace,
    true_depth,
    true_labels,
    true_surface,
)

VIEWS, POINTS = 12, 200_000
QUERIES, SPHERES, FCL_SPHERES = 2_000_000, 1_000_000, 20_000
REPEATS = 5
PATIENCE_S = 150.0
"""The paper's network may train so long until its plateau."""
GRID = 0.004
"""Metres between the places at which the map is scored."""
DEPTH_SCENES = {
    "textured table": ("colmap", SimulateOptions()),
    "plain table, webcam": ("colmap", SimulateOptions(scene="light8", **WEBCAM)),
    "everything plain": ("direct", SimulateOptions(seed=1, texture=False)),
}
LIMITS_MM = (2, 5, 10)
PLACES = 20_000
SEES = 0.003
"""m: difference of depth up to which an image shows a place."""
HEIGHT_SEEDS, HEIGHT_COUNTS = (6, 7, 8), (8, 10)
"""Scenes to which no constant of the method was fitted, and numbers of images."""
PAPER_PERCENT = {8: 8.6, 10: 3.1}
"""Largest height errors of the paper, by number of images."""


def run() -> str:
    """Return the page in Markdown: accuracy of the map, dense depth, heights of objects, and times beside python-fcl."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        truth = read_truth(simulate(folder / "capture", SimulateOptions(images=VIEWS)))
        accuracy, scene = _accuracy(truth)
        parts = [accuracy, _speed(scene, folder), _depth(folder), _heights(folder)]
    claims = [line for part in parts for line in part if line.startswith("> ")]
    rest = [line for part in parts for line in part if not line.startswith("> ")]
    return "\n".join([*claims, *rest]) + "\n"


def _accuracy(truth: Truth) -> tuple[list[str], SceneMap]:
    """Return the claim and the table of the map's accuracy, and the default map of perfect poses and depth."""
    score = scorer(truth)
    clouds = {"true poses and depth": true_cloud(truth), "calibrated, COLMAP": calibrated_cloud(truth)}
    found, rows, scenes = {}, [], {}
    for (source, cloud), preset in product(clouds.items(), ("default", "paper")):
        build = published_scene if preset == "paper" else build_scene
        scene = build(cloud, MapOptions(preset=preset, max_seconds=PATIENCE_S))
        shares, psnr, iou, unknown = score(scene)
        seconds = float(scene.history["training_s"])
        scenes[source, preset], found[source, preset] = scene, (shares, seconds)
        digits = [1] * 6 + [3] * 4
        cells = [f"{100 * share:.{digit}f}" for share, digit in zip(shares.values(), digits, strict=True)]
        last = f"{psnr:.1f} dB", f"{iou:.3f}", f"{100 * unknown:.0f}"
        rows.append([source, preset, f"{seconds:.2f} s", *cells, *last])
    exact, calibrated = clouds
    (ours, ours_s), (paper, paper_s) = found[exact, "default"], found[exact, "paper"]
    built = found[calibrated, "default"][0]
    lines = [
        f"> Map of the simulated table from true depth: F-score {100 * ours['F 10']:.1f} % at 10 mm after {ours_s:.1f} "
        f"s of training (the paper's network: {100 * paper['F 10']:.1f} % at 10 mm after {paper_s:.1f} s of training); "
        f"calibrated and reconstructed by COLMAP: precision {100 * built['P 10']:.1f} %, recall "
        f"{100 * built['R 10']:.1f} %, for plain surfaces give no points.",
        "",
        f"Simulated scene `tabletop`, {VIEWS} views, {POINTS:,} points with true masks as labels; shares of "
        "the workspace within 0.36 x 0.40 m of the middle, in %. F-score, precision and recall of occupied places "
        "against the surface that the images show, at 10 mm and 5 mm; colour and labels where the map knows that "
        "surface.",
        "",
        *table(f"poses | preset | training | {' | '.join(ours)} | colour PSNR | label mIoU | unknown", rows),
        "",
    ]
    return lines, scenes[exact, "default"]


def scorer(truth: Truth) -> Callable[[SceneMap], tuple[dict[str, float], float, float, float]]:
    """Return a function that scores maps of a simulated capture at places drawn once.

    Its scores are shares by name, the PSNR (dB) of colour and the mean IoU of labels on the surface where the map
    knows it, and the share of the workspace that is unknown.
    """
    draw = np.random.default_rng(0)
    low, high = truth.workspace_in_base
    surface = surface_in_workspace(truth)
    some = draw.choice(len(surface.label), min(100_000, len(surface.label)), replace=False)
    x_shown, color, label = surface.x_in_base[some], surface.color[some], surface.label[some]
    grid = np.stack(np.meshgrid(*(np.arange(a, b, GRID) for a, b in zip(low, high, strict=True))), -1)
    x = grid.reshape(-1, 3) + draw.uniform(0, GRID, (grid.size // 3, 3))
    solid = solid_labels(make_scene(truth.scene, truth.seed), x)  # pyright: ignore[reportArgumentType]
    inside = solid > 1
    # Above the table, within nothing, and before what a camera's pixel shows.
    before = np.any([z < depth for z, depth in _depths(truth, x)], axis=0)
    free = (solid == 0) & (x[:, 2] > truth.table_height) & before
    to_surface = _distance(KDTree(surface.x_in_base[::4]), x)

    def score(scene: SceneMap) -> tuple[dict[str, float], float, float, float]:
        sample = scene.query(x)
        occupied = (sample.occupancy >= 0.5) & ~sample.unknown
        to_map = _distance(KDTree(x[occupied]), x_shown)
        shares = {}
        for limit in (10, 5):
            precision = float((to_surface[occupied] < limit / 1000).mean())
            recall = float((to_map < limit / 1000).mean())
            shares[f"F {limit}"] = 2 * precision * recall / max(precision + recall, 1e-9)
            shares |= {f"P {limit}": precision, f"R {limit}": recall}
        called_free = scene.query(x, unknown="occupied").occupancy < 0.5
        shares["false free inside"] = float(called_free[inside].mean())
        shares["more than 5 mm in"] = float(called_free[inside & (to_surface > 0.005)].mean())
        shares["false occupied in seen free space"] = float(occupied[free].mean())
        shares["more than 10 mm off"] = float(occupied[free & (to_surface > 0.01)].mean())
        mapped = ~scene.query(x_shown).unknown
        at, true = scene.query(x_shown[mapped]), label[mapped]
        psnr = -10 * np.log10(((at.color - color[mapped] / 255.0) ** 2).mean())
        overlaps = [((at.label == k) & (true == k)).sum() / ((at.label == k) | (true == k)).sum()
                    for k in np.unique(true)]  # fmt: skip
        return shares, float(psnr), float(np.mean(overlaps)), float(sample.unknown.mean())

    return score


def true_cloud(truth: Truth) -> PointCloud:
    """Return the cloud of perfect poses and depth."""
    surface, draw = true_surface(truth), np.random.default_rng(0)
    chosen = draw.choice(len(surface.image), min(POINTS, len(surface.image)), replace=False)
    return PointCloud(
        points_in_base=surface.x_in_base[chosen],
        color=surface.color[chosen],
        confidence=np.ones(len(chosen)),
        margin=np.zeros(len(chosen)),
        label=surface.label[chosen],
        image=surface.image[chosen],
        camera_centers_in_base=truth.base_from_camera[:, :3, 3],
        label_names=truth.labels,
    )


def calibrated_cloud(truth: Truth) -> PointCloud:
    """Return the cloud of COLMAP and the calibration of the capture, labelled by the true masks."""
    capture = read_capture(truth.folder)
    found = densify(capture, reconstruct(capture, ReconstructOptions(backend="colmap")))
    size = found.dense.confidence.shape[:0:-1]
    labels = [
        cv2.resize(true_labels(truth, row), size, interpolation=cv2.INTER_NEAREST)
        for row in found.image_index
    ]
    masks = np.stack(labels).astype(int)
    return point_cloud(
        capture, found, calibrate_reconstruction(capture, found), masks, label_names=truth.labels
    )


def _depths(
    truth: Truth, x_in_base: Float[ndarray, "n 3"]
) -> Iterator[tuple[Float[ndarray, " n"], Float[ndarray, " n"]]]:
    """Yield depths of places and of the pixels that show them, for each image; infinite and 0 outside of it."""
    camera = truth.intrinsics
    for k, camera_from_base in enumerate(inverse(truth.base_from_camera)):
        x_in_camera = apply(camera_from_base, x_in_base)
        z = x_in_camera[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = np.round(project(camera, x_in_camera)).T
        shown = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        there, depth = np.where(shown, z, np.inf), np.zeros(len(z))
        depth[shown] = true_depth(truth, k)[row[shown].astype(int), column[shown].astype(int)]
        yield there, depth


def _distance(tree: KDTree, x: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
    """Metres to the nearest point of the tree; infinite beyond 2 cm, which keeps the search short."""
    return np.asarray(tree.query(x, distance_upper_bound=0.02, workers=-1)[0])


def _speed(scene: SceneMap, folder: Path) -> list[str]:
    """Return the claim and the table of times."""
    draw = np.random.default_rng(0)
    low, high = scene.box
    x = draw.uniform(low, high, (QUERIES, 3)).astype(np.float32)
    centers, radii = x[:SPHERES], draw.uniform(0.01, 0.05, SPHERES).astype(np.float32)
    seen = np.resize(x[~scene.query(x).unknown], x.shape)
    anywhere = _median_seconds(lambda: scene.query(x).occupancy)
    where_seen = _median_seconds(lambda: scene.query(seen).occupancy)
    ours = SPHERES / _median_seconds(lambda: scene.check_spheres(centers, radii))
    grid = _median_seconds(
        lambda: SceneMap(scene.fields, scene.seen, scene.label_names).distance_grid("occupied")
    )
    nodes = " x ".join(str(n // 2 + 1) for n in scene.seen.state.shape[::-1])
    theirs, alike = _fcl(scene, folder, centers[:FCL_SPHERES], radii[:FCL_SPHERES])
    return [
        f"> The map answers {QUERIES / anywhere / 1e6:.0f} M point queries/s and {ours / 1e6:.0f} M spheres/s, "
        f"{ours / theirs:.0f} times as many of these as python-fcl against the same voxels.",
        "",
        f"Times: medians of {REPEATS}, torch on {torch.get_num_threads()} threads.",
        "",
        "| what | measured |",
        "|---|---|",
        f"| occupancy and unknown at {QUERIES:,} points anywhere in the workspace | "
        f"{QUERIES / anywhere / 1e6:.1f} M points/s |",
        f"| the same at places that were seen | {QUERIES / where_seen / 1e6:.1f} M points/s |",
        f"| signed distance and gradient, {nodes} nodes of {100 * scene.cell:.1f} cm | {grid:.2f} s |",
        f"| `check_spheres`, {SPHERES:,} spheres of 1 to 5 cm | {ours / 1e6:.2f} M spheres/s |",
        f"| `fcl.collide`, the same spheres one by one against the map's OctoMap, same voxels | "
        f"{theirs / 1e6:.3f} M spheres/s, {ours / theirs:.0f} times less; {100 * alike:.1f} % of answers alike |",
    ]


def _median_seconds(what: Callable[[], object]) -> float:
    """Return the median of `REPEATS` calls after one that warms up."""
    what()
    seconds = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        what()
        seconds.append(time.perf_counter() - begun)
    return float(np.median(seconds))


def _fcl(
    scene: SceneMap, folder: Path, centers: Float[ndarray, "n 3"], radii: Float[ndarray, " n"]
) -> tuple[float, float]:
    """Return spheres a second of python-fcl against the map's OctoMap, and the share of answers alike."""
    try:
        import fcl
    except ImportError:
        raise InputError(
            "bench map: needs python-fcl and pyoctomap; pip install 'jcr-handeye[dev,planning]'"
        ) from None
    tree: Any = fcl
    write_octomap(folder / "map.bt", scene, provenance("base"), ExportOptions())
    content = (folder / "map.bt").read_bytes()
    voxels = np.frombuffer(content[content.index(b"\ndata\n") + 6 :], np.int8)
    world = tree.CollisionObject(tree.OcTree(scene.cell, voxels.tolist()))
    request = tree.CollisionRequest()
    spheres = [
        tree.CollisionObject(tree.Sphere(float(r)), tree.Transform(np.asarray(c, float)))
        for c, r in zip(centers, radii, strict=True)
    ]
    begun = time.perf_counter()
    hits = [tree.collide(sphere, world, request, tree.CollisionResult()) > 0 for sphere in spheres]
    rate = len(centers) / (time.perf_counter() - begun)
    return rate, float((np.array(hits) == scene.check_spheres(centers, radii, "free")).mean())


def _depth(folder: Path) -> list[str]:
    """Return the claim and the table of dense depth: shares of places near a point of all pointmaps."""
    rows, parts = [], []
    for name, (backend, options) in DEPTH_SCENES.items():
        made = simulate(folder / name.replace(" ", "_"), options)
        capture = read_capture(made)
        begun = time.process_time()
        found = densify(capture, reconstruct(capture, ReconstructOptions(backend=backend)))
        seconds = time.process_time() - begun
        near, on_table = covered(found, calibrate_reconstruction(capture, found), read_truth(made))
        of_table, of_objects = 100 * near[on_table].mean(0), 100 * near[~on_table].mean(0)
        parts.append(f"{name} {of_table[1]:.1f} % of the table and {of_objects[1]:.1f} % of the objects")
        shares = 100 * (found.dense.confidence > 0).mean(), *of_table, *of_objects
        rows.append([name, backend, *(f"{share:.1f}" for share in shares), f"{seconds:.0f}"])
    head = "scene | back end | with depth, % | table within 2 mm, % | 5 mm | 10 mm | objects 2 mm | 5 mm | 10 mm | s"
    return [
        f"> Dense depth within 5 mm, of places that two views show: {'; '.join(parts)}.",
        "",
        "## Dense depth",
        "",
        *table(head, rows),
    ]


def covered(
    found: Reconstruction, hand_eye: Calibration, truth: Truth
) -> tuple[Bool[ndarray, "k 3"], Bool[ndarray, " k"]]:
    """Return, of places that two images show, which are within each limit of a pointmap, and which are on the table."""
    surface = surface_in_workspace(truth)
    drawn = np.random.default_rng(0).choice(len(surface.label), PLACES, replace=False)
    x = surface.x_in_base[drawn]
    asked = np.sum([np.abs(z - depth) < SEES for z, depth in _depths(truth, x)], axis=0) > 1
    points = hand_eye.scale * found.dense.points_in_recon[found.dense.confidence > 0].astype(np.float64)
    distance = KDTree(apply(hand_eye.base_from_recon.rigid, points)).query(
        x[asked], distance_upper_bound=0.011
    )[0]
    return 1e3 * distance[:, None] <= LIMITS_MM, (surface.label[drawn] == 1)[asked]


def _heights(folder: Path) -> list[str]:
    """Return the claim and the table of heights of tape, box, mug and toolbox."""
    cells: dict[tuple[str, int], list[str]] = {}
    percent: dict[int, list[float]] = {count: [] for count in HEIGHT_COUNTS}
    sigmas, tried = [], 0
    for seed, count in product(HEIGHT_SEEDS, HEIGHT_COUNTS):
        for true, found in _measured_heights(folder / f"heights{seed}", seed, count):
            tried += 1
            text = "not seen"
            if found is not None and not found.top_seen:
                text = f"at least {1e3 * found.height:.0f} of {1e3 * true.height:.0f} mm"
            elif found is not None:
                error = found.height - true.height
                percent[count].append(100 * abs(error) / true.height)
                sigmas.append(abs(error) / found.height_std)
                text = f"{100 * error / true.height:+.2f}"
            cells.setdefault((true.name, count), []).append(text)
    every = [value for values in percent.values() for value in values]
    worst = ", ".join(
        f"with {n} images {max(v):.1f} % (the paper's {PAPER_PERCENT[n]} %)" for n, v in percent.items() if v
    )
    head = " | ".join(["object | images", *(f"seed {seed}, %" for seed in HEIGHT_SEEDS)])
    return [
        f"> Heights of tape, box, mug and toolbox: {len(every)} of {tried} measured, median error "
        f"{np.median(every):.2f} %; worst {worst}; {100 * np.mean(np.array(sigmas) <= 2):.0f} % within two stated σ.",
        "",
        "## Heights of objects",
        "",
        *table(head, ([*key, *texts] for key, texts in cells.items())),
    ]


def _measured_heights(place: Path, seed: int, images: int) -> list[tuple[TrueObject, ObjectSize | None]]:
    """Return each true object of a scene with its measurement, None where it was not found."""
    if not place.exists():
        simulate(place, SimulateOptions(scene="measuring", images=max(HEIGHT_COUNTS), seed=seed))
        shutil.copytree(place / "truth" / "labels", place / "labels")
    capture, truth = of_rows(read_capture(place), range(images)), read_truth(place)
    reconstruction = densify(capture, reconstruct(capture, ReconstructOptions(backend="colmap")))
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    given = read_labels(capture, reconstruction)
    assert given is not None  # copied above
    masked = point_cloud(capture, reconstruction, hand_eye, given[0], label_names=given[1])
    cloud = label_tabletop(masked)
    measured = measure_objects(cloud, float(np.sqrt(hand_eye.covariance[6, 6]))).objects
    sizes = {size.label: size for size in measured}
    # Each true object and the segment with which it overlaps most.
    count = np.zeros((cloud.label.max() + 1, len(truth.labels)))
    np.add.at(count, (cloud.label, masked.label), 1)
    iou = count / np.maximum(count.sum(0) + count.sum(1)[:, None] - count, 1)
    rows, columns = (one.tolist() for one in linear_sum_assignment(-iou[1:, 1:]))
    segment = {c + 1: r + 1 for r, c in zip(rows, columns, strict=True) if iou[r + 1, c + 1] > 0}
    return [(true, sizes.get(segment.get(true.label, -1))) for true in truth.objects]
