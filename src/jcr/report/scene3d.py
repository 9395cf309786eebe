"""The 3D view: what page/scene3d.js draws, packed small enough to live in the page."""

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.cell.poses import base_from_camera as poses_of
from jcr.geometry import apply_similarity, inverse
from jcr.report.figures import TRACK_COLOR, label_colors
from jcr.report.map_samples import SurfacePoints, point_size
from jcr.report.markup import filled
from jcr.report.pictures import image_numbers, shown_names
from jcr.results import RunResult

POINTS = 60_000
"""Of each layer, at most."""


@dataclass(frozen=True)
class PointLayer:
    """Points of one kind, which the reader shows or hides."""

    name: str
    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]


def scene_section(
    result: RunResult, base_from_camera: Float[ndarray, "m 4 4"], surface: SurfacePoints | None
) -> str:
    """Cameras, grippers and points in the base frame, to be rotated by hand."""
    layers, legend = _layers(result, surface)
    tracked = apply_similarity(
        result.hand_eye.base_from_recon,
        result.hand_eye.scale,
        result.reconstruction.tracks.points_in_recon,
    )
    red = np.tile(np.array(TRACK_COLOR, np.uint8), (len(tracked), 1))
    tracks = PointLayer("tracked features", tracked, red)
    views = _views(result, base_from_camera)
    others, bases = _others(result, base_from_camera)
    data = {
        **_packed_layers([*layers, tracks], base_from_camera[:, :3, 3]),
        "views": views,
        "others": others,
        "bases": bases,
        "next": [
            {
                "gripper": pose.base_from_gripper[:3],
                "camera": (np.array(pose.base_from_gripper) @ result.hand_eye.gripper_from_camera)[
                    :3
                ].tolist(),
            }
            for pose in result.calibration.next_poses
        ],
        "lens": asdict(result.lens),
    }
    checks = [("cameras", "cameras", True), *([("others", "other cameras", True)] * bool(others))]
    checks += [("grippers", "grippers", True), ("grid", "base and grid", True)]
    if result.calibration.next_poses:
        checks.append(("next", "poses to add (green)", False))
    checks.append(("tracks", "tracked features (red)", not layers))
    return filled(
        "scene3d.html",
        layers="".join(
            _choice(f'type="radio" name="scene-layer" value="{k}"', name, k == 0)
            for k, name in enumerate([layer.name for layer in layers] + ["no points"] * bool(layers))
        ),
        checks="".join(_choice(f'type="checkbox" id="scene-{key}"', name, on) for key, name, on in checks),
        through="".join(
            f'<option value="{k}">through {escape(view["name"])}</option>'
            for k, view in enumerate(views)
            if view["camera"]
        ),
        legend=legend,
        # A name that holds </script> must not end the element it stands in.
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
    )


def _choice(attributes: str, name: str, on: bool) -> str:
    return f"<label><input {attributes}{' checked' if on else ''}>{name}</label>"


def _layers(result: RunResult, surface: SurfacePoints | None) -> tuple[list[PointLayer], str]:
    """The layers to choose from, and the legend of the labels."""
    layers, legend = [], ""
    if surface is not None and result.scene is not None:
        x, names = surface.points_in_base[:POINTS], result.scene.label_names
        layers.append(PointLayer("map, predicted colour", x, surface.color[:POINTS]))
        if len(names) > 1:
            palette = label_colors(len(names))
            layers.append(PointLayer("map, predicted label", x, palette[surface.label[:POINTS]]))
            items = (
                f'<span><i class="swatch" style="background:rgb({r},{g},{b})"></i>{escape(name)}</span>'
                for name, (r, g, b) in zip(names, palette.tolist(), strict=True)
            )
            legend = f'<div class="legend">labels: {"".join(items)}</div>'
    if (cloud := result.cloud) is not None:
        some = np.random.default_rng(0).permutation(len(cloud.points_in_base))[:POINTS]
        layers.append(PointLayer("points as measured", cloud.points_in_base[some], cloud.color[some]))
    return layers, legend


def _packed_layers(
    layers: Sequence[PointLayer], centers_in_base: Float[ndarray, "m 3"]
) -> dict[str, list[Any]]:
    """The points in their common box, as 16-bit steps through it."""
    everything = np.vstack([layer.points_in_base for layer in layers] + [centers_in_base])
    # A few stray points far away must not take the resolution, and the view, from all others.
    low, high = np.percentile(everything, [1, 99], axis=0)
    margin = 0.25 * (high - low) + 0.05
    box = np.stack([low - margin, high + margin])
    return {"box": box.round(4).tolist(), "layers": [_packed(layer, box.round(4)) for layer in layers]}


def _packed(layer: PointLayer, box: Float[ndarray, "2 3"]) -> dict[str, Any]:
    low, high = box
    inside = ((layer.points_in_base >= low) & (layer.points_in_base <= high)).all(1)
    x = layer.points_in_base[inside]
    steps = (x - low) / (high - low) * 65535
    return {
        "name": layer.name,
        "size": point_size(x),
        "xyz": base64.b64encode(steps.round().astype("<u2").tobytes()).decode(),
        "rgb": base64.b64encode(layer.color[inside].tobytes()).decode(),
    }


def _views(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> list[dict[str, Any]]:
    """Per image its name, its numbers, and three rows of where its gripper and its camera (or null) were."""
    row_of = {int(row): k for k, row in enumerate(result.reconstruction.image_index)}
    images = result.calibration.images
    return [
        {
            "name": name,
            "used": image.used,
            "caption": image_numbers(image) if image.used else f"rejected: {image.reason}",
            "gripper": result.capture.base_from_gripper[i, :3].round(6).tolist(),
            "camera": base_from_camera[row_of[i], :3].round(6).tolist() if i in row_of else None,
        }
        for i, (image, name) in enumerate(zip(images, shown_names(images), strict=True))
    ]


def _others(
    result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The cell's further cameras, each with where it was and what it is, and the bases of other arms."""
    if result.cameras is None:
        return [], []
    grippers = base_from_camera @ inverse(result.hand_eye.gripper_from_camera)
    by_row = dict(zip(result.image_index.tolist(), grippers, strict=True))
    known = {camera.name: camera for camera in result.capture.others}
    out = []
    for found in result.cameras.cameras:
        if found.parent_from_camera is None or found.intrinsics is None:
            continue
        if found.mount == "base":
            places = [np.array(found.parent_from_camera)]
        elif found.name in known:
            places = [*poses_of(known[found.name], found, result.cameras, by_row).values()]
        else:
            continue
        arm = "" if found.arm is None else f" of arm {found.arm}"
        doubt = "" if found.doubt is None else "\nrejected"
        lens = found.intrinsics
        out.append(
            {
                "name": found.name,
                "caption": f"{'fixed in the base' if found.mount == 'base' else f'on the gripper{arm}'}{doubt}",
                "fixed": found.mount == "base",
                "lens": {key: getattr(lens, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
                "cameras": [place[:3].round(6).tolist() for place in places],
            }
        )
    bases = [
        {"name": f"base of {arm.name}", "base": np.array(arm.base_from_other_base)[:3].round(6).tolist()}
        for arm in result.cameras.arms
    ]
    return out, bases
