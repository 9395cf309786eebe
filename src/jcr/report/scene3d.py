"""Data of the 3D view that templates/scene3d.js draws."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.cell.placement import CameraPlacement
from jcr.geometry import apply_similarity, inverse
from jcr.records import CellCamera, Intrinsics
from jcr.report.images import image_numbers, shown_names
from jcr.report.raster import TRACK_COLOR, label_colors
from jcr.report.render import Section
from jcr.run_folder import RunResult
from jcr.scene.samples import SurfacePoints, point_size

POINTS = 60_000
"""Most points of each layer."""
TRACK_SIZE = 0.006
"""Side (m) of the squares that are drawn in place of tracked features."""


@dataclass(frozen=True)
class PointLayer:
    """Points of one kind, which can be shown or hidden."""

    name: str
    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    size: float
    """Side (m) of the squares that are drawn in place of the points."""


def scene_section(
    result: RunResult, base_from_camera: Float[ndarray, "m 4 4"], surface: SurfacePoints | None
) -> Section:
    """Return the section of the 3D view: cameras, grippers and points in the base frame."""
    layers = [*_map_layers(result, surface), *_measured_layer(result)]
    views = _views(result, base_from_camera)
    next_poses = [np.array(pose.base_from_gripper) for pose in result.calibration.next_poses]
    others = _others(result, base_from_camera)
    x, centers = result.hand_eye.gripper_from_camera, base_from_camera[:, :3, 3]
    intrinsics = result.intrinsics or result.reconstruction.intrinsics
    data = scene_data([*layers, _tracks(result)], views, next_poses, x, intrinsics, centers)
    data |= {"others": others, "bases": _bases(result)}
    checks = [("cameras", "cameras", True), *([("others", "other cameras", True)] * bool(others))]
    checks += [("grippers", "grippers", True), ("grid", "base and grid", True)]
    if result.calibration.next_poses:
        checks.append(("next", "poses to add (green)", False))
    checks.append(("tracks", "tracked features (red)", not layers))
    content = {
        "layers": [layer.name for layer in layers] + ["no points"] * bool(layers),
        "checks": checks,
        "through": [(k, view["name"]) for k, view in enumerate(views) if view["camera"]],
        "labels": _labels(result),
        "data": data,
    }
    return Section("view", content)


def scene_data(
    layers: Sequence[PointLayer],
    views: Sequence[Mapping[str, Any]],
    next_poses: Sequence[Float[ndarray, "4 4"]],
    gripper_from_camera: Float[ndarray, "4 4"],
    intrinsics: Intrinsics,
    shown_in_base: Float[ndarray, "m 3"],
) -> dict[str, Any]:
    """Return the data of scene3d.js: points, images (`scene_view`), and gripper poses to add.

    `shown_in_base` are further points (m) that the box of coordinates contains.
    """
    return {
        **_packed_layers(layers, shown_in_base),
        "views": views,
        "others": [],
        "bases": [],
        "next": [
            {"gripper": _rows(pose), "camera": _rows(pose @ gripper_from_camera)} for pose in next_poses
        ],
        "intrinsics": asdict(intrinsics),
    }


def scene_view(
    name: str,
    caption: str,
    used: bool,
    base_from_gripper: Float[ndarray, "4 4"],
    base_from_camera: Float[ndarray, "4 4"] | None,
) -> dict[str, Any]:
    """Return an image with its name, numbers, gripper pose and camera pose (None: unknown)."""
    camera = None if base_from_camera is None else _rows(base_from_camera)
    return {
        "name": name,
        "used": used,
        "caption": caption,
        "gripper": _rows(base_from_gripper),
        "camera": camera,
    }


def _rows(a_from_b: Float[ndarray, "4 4"]) -> list[list[float]]:
    """Return the upper three rows, to a micrometre."""
    return a_from_b[:3].round(6).tolist()


def _labels(result: RunResult) -> list[tuple[str, list[int]]]:
    """Return names and colours of the map's labels; none for a single label."""
    names = () if result.scene is None else result.scene.label_names
    return list(zip(names, label_colors(len(names)).tolist(), strict=True)) if len(names) > 1 else []


def _map_layers(result: RunResult, surface: SurfacePoints | None) -> list[PointLayer]:
    """Return the surface of the map by colour, and by label where it has several."""
    if surface is None:
        return []
    x, size = surface.points_in_base[:POINTS], surface.point_size
    layers = [PointLayer("map, predicted colour", x, surface.color[:POINTS], size)]
    if labels := _labels(result):
        palette = np.array([color for _, color in labels], np.uint8)
        layers.append(PointLayer("map, predicted label", x, palette[surface.label[:POINTS]], size))
    return layers


def _measured_layer(result: RunResult) -> list[PointLayer]:
    """Return the measured points; none without a cloud."""
    if (cloud := result.cloud) is None:
        return []
    some = np.random.default_rng(0).permutation(len(cloud.points_in_base))[:POINTS]
    x = cloud.points_in_base[some]
    return [PointLayer("points as measured", x, cloud.color[some], point_size(x))]


def _tracks(result: RunResult) -> PointLayer:
    """Return the tracked features in red."""
    hand_eye, tracked = result.hand_eye, result.reconstruction.tracks.points_in_recon
    tracked = apply_similarity(hand_eye.base_from_recon, hand_eye.scale, tracked)
    red = np.tile(np.array(TRACK_COLOR, np.uint8), (len(tracked), 1))
    return PointLayer("tracked features", tracked, red, TRACK_SIZE)


def _packed_layers(
    layers: Sequence[PointLayer], centers_in_base: Float[ndarray, "m 3"]
) -> dict[str, list[Any]]:
    """Return the points in their common box, as 16-bit steps through it."""
    everything = np.vstack([layer.points_in_base for layer in layers] + [centers_in_base])
    # A few stray points far away must not take the resolution, and the view, from all others.
    low, high = np.percentile(everything, [1, 99], axis=0)
    margin = 0.25 * (high - low) + 0.05
    box = np.stack([low - margin, high + margin]).round(4)
    return {"box": box.tolist(), "layers": [_packed(layer, box) for layer in layers]}


def _packed(layer: PointLayer, box: Float[ndarray, "2 3"]) -> dict[str, Any]:
    """Return a layer as base64 text."""
    low, high = box
    inside = ((layer.points_in_base >= low) & (layer.points_in_base <= high)).all(1)
    steps = (layer.points_in_base[inside] - low) / (high - low) * 65535
    return {
        "name": layer.name,
        "size": layer.size,
        "xyz": base64.b64encode(steps.round().astype("<u2").tobytes()).decode(),
        "rgb": base64.b64encode(layer.color[inside].tobytes()).decode(),
    }


def _views(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> list[dict[str, Any]]:
    """Return every image with its numbers, gripper pose and camera pose."""
    row_of = {int(row): k for k, row in enumerate(result.image_index)}
    images = result.calibration.images
    return [
        scene_view(
            name,
            image_numbers(image) if image.used else f"rejected: {image.reason}",
            image.used,
            result.capture.base_from_gripper[i],
            base_from_camera[row_of[i]] if i in row_of else None,
        )
        for i, (image, name) in enumerate(zip(images, shown_names(images), strict=True))
    ]


def _others(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> list[dict[str, Any]]:
    """Return the cell's further cameras with their poses and intrinsics."""
    if result.cameras is None:
        return []
    grippers = base_from_camera @ inverse(result.hand_eye.gripper_from_camera)
    by_row = dict(zip(result.image_index.tolist(), grippers, strict=True))
    known = {camera.name: camera for camera in result.capture.others}
    shown = []
    for found in result.cameras.cameras:
        places = _places(result, found, known, by_row)
        if not places or found.intrinsics is None:
            continue
        arm = "" if found.arm is None else f" of arm {found.arm}"
        doubt = "" if found.doubt is None else "\nrejected"
        intrinsics = found.intrinsics
        shown.append(
            {
                "name": found.name,
                "caption": f"{'fixed in the base' if found.mount == 'base' else f'on the gripper{arm}'}{doubt}",
                "fixed": found.mount == "base",
                "intrinsics": {
                    key: getattr(intrinsics, key) for key in ("fx", "fy", "cx", "cy", "width", "height")
                },
                "cameras": [_rows(place) for place in places],
            }
        )
    return shown


def _places(
    result: RunResult,
    found: CameraPlacement,
    known: dict[str, CellCamera],
    by_row: dict[int, Float[ndarray, "4 4"]],
) -> list[Float[ndarray, "4 4"]]:
    """Return base_from_camera of each image of a further camera; one pose of a fixed camera."""
    if found.parent_from_camera is None or result.cameras is None:
        return []
    if found.mount == "base":
        return [np.array(found.parent_from_camera)]
    if found.name not in known:
        return []
    return result.cameras.base_from_camera(known[found.name], found, by_row)


def _bases(result: RunResult) -> list[dict[str, Any]]:
    """Return the bases of other arms."""
    arms = () if result.cameras is None else result.cameras.arms
    return [
        {"name": f"base of {arm.name}", "base": _rows(np.array(arm.base_from_other_base))} for arm in arms
    ]
