"""Section of the hand-eye transform in the report: notations of robot software to copy, and a sketch to scale."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.calibration.summary import pair_in_words
from jcr.camera import unproject, without_distortion
from jcr.export.ros import (
    BASE,
    CHILD,
    PARENT,
    CameraMount,
    camera_info,
    static_transform_publisher,
    urdf_origin,
)
from jcr.geometry import apply, roll_pitch_yaw
from jcr.number_format import significant
from jcr.records import COVARIANCE_ORDER, Intrinsics, Mount
from jcr.report.render import Content

FIXED_AXES = "fixed axes x, y, z: R = Rz(yaw)·Ry(pitch)·Rx(roll)"
WIDTH, HEIGHT, MARGIN = 440, 320, 34
"""Width and height of the sketch, whose text can then be read on a phone, and its margin (px)."""
EYE_DEG = (-55.0, 22.0)
"""Direction from which the sketch is drawn: azimuth about the z axis of the parent frame, and elevation (degrees)."""
FLANGE_M = 0.0315
"""Radius (m) of the drawn flange: ISO 9409-1-50."""


def transform_section(hand_eye: Calibration | PublishedCalibration) -> Content:
    """Return the section on the result: the transform in all notations, with covariance and a sketch of the camera.

    The transform is gripper_from_camera or, for a fixed camera, base_from_camera. A published result has no covariance.
    """
    x, mount, covariance, pair = hand_eye.parent_from_camera, hand_eye.mount, None, list[str]()
    if isinstance(hand_eye, Calibration):
        covariance, pair = hand_eye.covariance, pair_in_words(hand_eye)
    names = hand_eye.frame_names
    base, child = names.base or BASE, names.camera or CHILD
    parent = names.gripper or PARENT if mount == "gripper" else base
    rotation = Rotation.from_matrix(x[:3, :3])
    rpy, order = roll_pitch_yaw(x[:3, :3]), list(COVARIANCE_ORDER)
    angles = ("roll", "pitch", "yaw")
    along, about = "± unknown", "± unknown"
    if covariance is not None:
        std = np.sqrt(np.diag(covariance))
        along = f"±{', '.join(significant(1e3 * value) for value in std[:3])} mm"
        about = f"±{', '.join(significant(value) for value in np.degrees(std[3:6]))}°"
    notations = [
        ("Translation (m)", "xyz", x[:3, 3], along),
        ("Quaternion", "xyzw", rotation.as_quat(canonical=True), "x, y, z, w: the scalar last"),
        ("Roll, pitch, yaw (rad)", angles, rpy, FIXED_AXES),
        ("Roll, pitch, yaw (deg)", angles, np.degrees(rpy), FIXED_AXES),
        ("Rotation vector (rad)", ("rx", "ry", "rz"), rotation.as_rotvec(), "axis times angle"),
    ]
    mounted = CameraMount(
        parent=parent, child=child, parent_from_child=x, base=base, intrinsics=hand_eye.intrinsics
    )
    return {
        "sketch": sketch(x, hand_eye.intrinsics, mount),
        "mount": mount,
        "pair": pair,
        "parent": parent,
        "child": child,
        "rejected": not hand_eye.converged,
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row) for row in x[:3]),
        "copied_matrix": "[" + ",\n ".join(json.dumps(row) for row in x.tolist()) + "]",
        "along": along,
        "about": about,
        "notations": [
            {
                "title": title,
                "copied": json.dumps(value.round(9).tolist()),
                "rows": [(name, f"{one:.6f}") for name, one in zip(names, value, strict=True)],
                "note": note,
            }
            for title, names, value, note in notations
        ],
        "ros": static_transform_publisher(mounted),
        "urdf": urdf_origin(x),
        "covariance": None
        if covariance is None
        else "\n".join(" ".join(f"{value:>10.2e}" for value in row) for row in covariance),
        "copied_covariance": ""
        if covariance is None
        else json.dumps({"order": order, "covariance": covariance.tolist()}),
        "order": order,
        "camera_info": None if hand_eye.intrinsics is None else camera_info(mounted),
    }


def sketch(
    parent_from_camera: Float[ndarray, "4 4"], intrinsics: Intrinsics | None, mount: Mount
) -> dict[str, Any]:
    """Return a sketch of the camera, as a pyramid with axes, in the gripper frame (z drawn downwards) or the base frame.

    The frame is that of `mount`. `intrinsics` give the shape of the pyramid; None selects those of a usual camera.
    "shapes" are tag, attributes and text of SVG elements. "width" and "height" are the size (px), "label" is the text
    for screen readers.
    """
    down = mount == "gripper"
    away = float(np.linalg.norm(parent_from_camera[:3, 3]))
    size = max(away, 2 * FLANGE_M)
    camera, axes = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480), 0.45 * size * np.eye(3)
    if intrinsics is not None:
        camera = without_distortion(intrinsics)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [camera.width, camera.height] - 0.5
    pyramid = apply(parent_from_camera, 0.4 * size * np.vstack([np.zeros(3), unproject(camera, corners)]))
    tips = apply(parent_from_camera, 0.6 * axes)
    turn = np.linspace(0, 2 * np.pi, 49)
    flange = FLANGE_M * down * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(49)])
    place = _projection(np.vstack([pyramid, tips, axes, flange]), down)
    origin, centre = place(np.zeros((1, 3)))[0], place(pyramid[:1])[0]
    shapes = list[tuple[str, dict[str, str], str]]()

    def draw(tag: str, ends: Sequence[ndarray] | ndarray, kind: str) -> None:
        """Add an SVG polyline or polygon (`tag`) through the points `ends` (px), with the CSS class `kind`."""
        shapes.append((tag, {"class": kind, "points": " ".join(f"{x:.1f},{y:.1f}" for x, y in ends)}, ""))

    def write(x: float, y: float, words: str, kind: str) -> None:
        """Add the text `words` with its left end, or with CSS class `kind` "middle" its centre, at x, y (px)."""
        shapes.append(("text", {"x": f"{x:.1f}", "y": f"{y:.1f}", "class": kind}, words))

    if down:
        draw("polyline", place(flange), "flange")
    draw("polyline", [origin, centre], "offset")
    tip, *rim = place(pyramid)
    for face in [*([tip, rim[k - 1], rim[k]] for k in range(4)), rim]:
        draw("polygon", face, "cone")
    for begin, ends in ((origin, place(axes)), (centre, place(tips))):
        for name, end in zip("xyz", ends, strict=True):
            x, y = end + 10 * (end - begin) / max(float(np.linalg.norm(end - begin)), 1.0)
            draw("polyline", [begin, end], f"axis-{name}")
            write(x, y + 4, name, "small middle")
    parent, (x, y) = "gripper" if down else "base", (origin + centre) / 2
    write(x + 12, y - 6, f"{1e3 * away:.0f} mm", "small")
    write(12.0, 18.0, f"{parent.capitalize()} and camera, to scale", "title")
    label = f"The camera in the frame of the {parent}, {1e3 * away:.0f} mm from its origin"
    return {"label": label, "width": WIDTH, "height": HEIGHT, "shapes": shapes}


def _projection(
    x: Float[ndarray, "n 3"], down: bool
) -> Callable[[Float[ndarray, "k 3"]], Float[ndarray, "k 2"]]:
    """Return a function that projects points (k,3) m to pixels (k,2) of the sketch, in parallel projection.

    The points are in the parent frame. The scale is such that all points `x` are visible. If `down` is true, the z axis
    is drawn downwards, else upwards.
    """
    azimuth, elevation = np.radians(EYE_DEG)
    up_z = -1.0 if down else 1.0
    eye = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), up_z * np.sin(elevation)]
    )
    up = np.array([0.0, 0.0, up_z]) - up_z * np.sin(elevation) * eye
    up /= np.linalg.norm(up)
    axes = np.array([np.cross(up, eye), up])
    flat = x @ axes.T
    low, high = flat.min(0), flat.max(0)
    zoom = float(((np.array([WIDTH, HEIGHT]) - 2 * MARGIN) / np.maximum(high - low, 1e-6)).min())
    middle, centre = (low + high) / 2, np.array([WIDTH / 2, HEIGHT / 2 + 8])
    return lambda points: (points @ axes.T - middle) * [zoom, -zoom] + centre
