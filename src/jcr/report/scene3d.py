"""Data of the 3D view, which templates/scene3d.js draws."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.geometry import inverse, scale_translation
from jcr.records import Intrinsics, PointCloud
from jcr.report.images import image_numbers, shown_names
from jcr.report.render import TRACK_COLOR, Content, label_colors
from jcr.result import RunResult
from jcr.scene.surface import point_size, sample_surface

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap

POINTS = 60_000
"""Largest number of points of a layer."""
TRACK_SIZE = 0.006
"""Side (m) of the squares as which tracked features are drawn."""
BY_LABEL, MEASURED = "map, predicted label", "points as measured"
"""Names of layers."""

PointLayer = tuple[str, Float[ndarray, "_ 3"], UInt8[ndarray, "_ 3"], float]
"""Layer of points that can be shown or hidden: name, points (m, base frame), RGB, and side (m) of their squares."""


def scene_section(result: RunResult) -> Content:
    """Return the section of the 3D view: its data (cameras, grippers, points), check boxes, and legend of labels."""
    calibration, reconstruction = result.solved, result.reconstruction
    base_from_recon = calibration.base_from_recon
    base_from_camera = base_from_recon.rigid @ scale_translation(
        reconstruction.recon_from_camera, base_from_recon.scale
    )
    layers, labels = point_layers(result.scene, result.cloud, POINTS)
    tracked = base_from_recon(reconstruction.tracks.points_in_recon)
    row_of, images = {int(row): k for k, row in enumerate(result.image_index)}, result.calibration.images
    views = list[dict[str, Any]]()
    for i, (image, name) in enumerate(zip(images, shown_names(images), strict=True)):
        caption = image_numbers(image) if image.used else f"rejected: {image.reason}"
        camera = base_from_camera[row_of[i]] if i in row_of else None
        views.append(scene_view(name, caption, image.used, result.capture.base_from_gripper[i], camera))
    others = _others(result, base_from_camera)
    intrinsics = result.intrinsics or reconstruction.intrinsics
    drawn = [*layers, track_layer("tracked features", tracked)]
    arms = {} if result.cameras is None else {a.name: a.base_from_other_base for a in result.cameras.arms}
    bases = [{"name": f"base of {name}", "base": _rows(np.array(matrix))} for name, matrix in arms.items()]
    data = scene_data(drawn, views, intrinsics, base_from_camera[:, :3, 3])
    data |= {"others": others, "bases": bases}
    checks = [("cameras", "cameras", True), *([("others", "other cameras", True)] * bool(others))]
    checks += [("grippers", "grippers", True), ("grid", "base and grid", True)]
    checks.append(("tracks", "tracked features (red)", not layers))
    return {
        "layers": [name for name, *_ in layers] + ["no points"] * bool(layers),
        "checks": checks,
        "through": [(k, view["name"]) for k, view in enumerate(views) if view["camera"]],
        "labels": labels,
        "data": data,
    }


def point_layers(
    scene: "SceneMap | None", cloud: PointCloud | None, most: int
) -> tuple[list[PointLayer], list[tuple[str, list[int]]]]:
    """Return the layers of a map and a cloud with at most `most` points each, and the name and RGB of each label.

    There are no labels if the map has only one.
    """
    layers, labels = list[PointLayer](), []
    if scene is not None:
        (at, color, label), names = sample_surface(scene, most), scene.label_names
        layers.append(("map, predicted colour", at, color, size := point_size(at)))
        if len(names) > 1:
            palette = label_colors(len(names))
            labels = list(zip(names, palette.tolist(), strict=True))
            layers.append((BY_LABEL, at, palette[label], size))
    if cloud is not None:
        some = np.random.default_rng(0).permutation(len(cloud.points_in_base))[:most]
        at = cloud.points_in_base[some]
        layers.append((MEASURED, at, cloud.color[some], point_size(at)))
    return layers, labels


def track_layer(name: str, points_in_base: Float[ndarray, "n 3"]) -> PointLayer:
    """Return a layer of the 3D view called `name`: points (m, base frame), with colour and size of tracked features."""
    red = np.tile(np.array(TRACK_COLOR, np.uint8), (len(points_in_base), 1))
    return name, points_in_base, red, TRACK_SIZE


def scene_data(
    layers: Sequence[PointLayer],
    views: Sequence[Mapping[str, Any]],
    intrinsics: Intrinsics,
    shown_in_base: Float[ndarray, "m 3"],
) -> dict[str, Any]:
    """Return the data of the 3D view for scene3d.js: layers of points, images, and intrinsics.

    Coordinates of points are 16-bit fractions of a box (m, base frame), which encloses most points of the layers and of
    `shown_in_base`.
    """
    everything = np.vstack([points for _, points, *_ in layers] + [shown_in_base])
    # A few distant outliers must not enlarge the box, which sets the resolution and the view.
    low, high = np.percentile(everything, [1, 99], axis=0)
    margin = 0.25 * (high - low) + 0.05
    low, high = box = np.stack([low - margin, high + margin]).round(4)
    packed = []
    for name, points, color, size in layers:
        inside = ((points >= low) & (points <= high)).all(1)
        steps = ((points[inside] - low) / (high - low) * 65535).round().astype("<u2")
        xyz, rgb = (base64.b64encode(part.tobytes()).decode() for part in (steps, color[inside]))
        packed.append({"name": name, "size": size, "xyz": xyz, "rgb": rgb})
    return {
        "box": box.tolist(),
        "layers": packed,
        "views": views,
        "others": [],
        "bases": [],
        "intrinsics": asdict(intrinsics),
    }


def scene_view(
    name: str,
    caption: str,
    used: bool,
    base_from_gripper: Float[ndarray, "4 4"],
    base_from_camera: Float[ndarray, "4 4"] | None,
) -> dict[str, Any]:
    """Return the JSON entry of an image in the 3D view; base_from_camera is None for an image without a camera pose.

    `caption` is the text shown with its `name`; `used` states whether the calibration uses the image. Poses are in
    metres.
    """
    camera = None if base_from_camera is None else _rows(base_from_camera)
    about = {"name": name, "used": used, "caption": caption}
    return about | {"gripper": _rows(base_from_gripper), "camera": camera}


def _rows(a_from_b: Float[ndarray, "4 4"]) -> list[list[float]]:
    """Return the upper three rows [R | t] of a transform as lists, t in metres, rounded to six decimals."""
    return a_from_b[:3].round(6).tolist()


def _others(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> list[dict[str, Any]]:
    """Return the other cameras of the cell that have a pose: name, caption, intrinsics, and poses in the base frame.

    `base_from_camera` are the poses of the calibrated camera at its registered images.
    """
    if result.cameras is None:
        return []
    grippers = base_from_camera @ inverse(result.calibration.gripper_from_camera)
    by_row = dict(zip(result.image_index.tolist(), grippers, strict=True))
    known = {camera.name: camera for camera in result.capture.others}
    shown = []
    for found in result.cameras.cameras:
        fixed, places = found.mount == "base", list[ndarray]()
        if fixed and found.parent_from_camera is not None:
            places = [np.array(found.parent_from_camera)]
        elif not fixed and found.name in known:
            places = result.cameras.base_from_camera(known[found.name], found, by_row)
        if not places or (intrinsics := found.intrinsics) is None:
            continue
        arm = "" if found.arm is None else f" of arm {found.arm}"
        doubt = "" if found.doubt is None else "\nrejected"
        sizes = ("fx", "fy", "cx", "cy", "width", "height")
        shown.append(
            {
                "name": found.name,
                "caption": f"{'fixed in the base' if fixed else f'on the gripper{arm}'}{doubt}",
                "fixed": fixed,
                "intrinsics": {key: getattr(intrinsics, key) for key in sizes},
                "cameras": [_rows(place) for place in places],
            }
        )
    return shown
