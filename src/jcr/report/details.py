"""Collapsed sections of the report: cameras of the cell, measured objects, and details of calibration and options."""

import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import AnyCalibration
from jcr.calibration.summary import facts
from jcr.cell.cameras_json import CamerasFile, TransformUncertainty
from jcr.extras import is_installed
from jcr.number_format import decimals_of, significant
from jcr.report.render import Content, label_colors
from jcr.segments.measure import Measurement

StageOptions = Mapping[str, Mapping[str, Any]]
"""Options of each stage: name of the stage, then name of the option, to value."""
PACKAGES = ("numpy", "scipy", "torch", "pycolmap")
"""Packages whose versions the report states."""


def details_section(
    calibration: AnyCalibration, options: StageOptions, map_history: Mapping[str, str] | None = None
) -> Content:
    """Return tables of names and values: calibration, map (`map_history`), options of each stage, and versions."""
    blocks = facts(calibration) | {"Map": map_history or {}}
    for stage, chosen in options.items():
        blocks[f"Options: {stage}"] = {
            name: "unset" if value is None else str(list(value) if isinstance(value, tuple) else value)
            for name, value in chosen.items()
        }
    versions = {"jcr": calibration.version, "python": platform.python_version()}
    blocks["Versions"] = versions | {name: metadata.version(name) for name in PACKAGES if is_installed(name)}
    return {"blocks": {title: rows for title, rows in blocks.items() if rows}}


def objects_section(measured: Measurement, label_names: tuple[str, ...]) -> Content:
    """Return a row for each object: name, RGB of its label, height, length, width (mm, ± one sigma), and place.

    The place is the centre x, y of the object's box (m, base frame).
    """
    colors = label_colors(len(label_names)).tolist()
    rows = []
    for one in measured.objects:
        digits = [max(1, decimals_of(1e3 * std)) for std in one.box_std]
        length, width, height = (
            f"{1e3 * value:.{n}f} ±\u00a0{1e3 * std:.{n}f}"
            for value, std, n in zip(one.box_size, one.box_std, digits, strict=True)
        )
        if not one.top_seen:
            height = f"at least {1e3 * one.height:.1f}"
        x, y = one.base_from_box[:2, 3]
        rows.append((one.name, colors[one.label], (height, length, width, f"{x:.3f}, {y:.3f}")))
    return {"rows": rows, "noise": f"{1e3 * measured.support.noise:.1f}"}


def cameras_section(cameras: CamerasFile) -> Content:
    """Return the section on the other cameras: a card for each camera and each other arm, with its transform."""
    cards = []
    for camera in cameras.cameras:
        arm = "" if camera.arm is None else f" of arm {camera.arm}"
        name = "base_from_camera" if camera.mount == "base" else f"gripper_from_camera{arm}"
        images = list[tuple[str, ...]]()
        for image in camera.images:
            px = "" if image.reprojection_px is None else f"{significant(image.reprojection_px)} px"
            images.append((image.image, f"{image.points} points", px, image.reason or "used"))
        about = {"rejected": camera.doubt is not None, "remarks": camera.warnings, "images": images}
        matrix = _matrix(camera.parent_from_camera, camera.uncertainty)
        cards.append({"title": f"{camera.name}: {name}", "name": name} | about | matrix)
    about, name = {"rejected": False, "remarks": (), "images": ()}, "base_from_other_base"
    for arm in cameras.arms:
        matrix = _matrix(np.array(arm.base_from_other_base), arm.uncertainty)
        cards.append({"title": f"arm {arm.name}: {name}", "name": name} | about | matrix)
    return {"cards": cards}


def _matrix(
    matrix: Float[ndarray, "4 4"] | None, uncertainty: TransformUncertainty | None
) -> dict[str, str | None]:
    """Return texts of a transform (m): "matrix" to read, "copied" to copy, and "std" with its standard deviations.

    Without a transform or its uncertainty, "matrix" is None and the only entry.
    """
    if matrix is None or uncertainty is None:
        return {"matrix": None}
    return {
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row)[1:] for row in matrix),
        "copied": str(matrix.round(9).tolist()),
        "std": uncertainty.in_words,
    }
