"""Section of the cell's other cameras and arms: transform, uncertainty and images of each."""

from typing import Any

import numpy as np

from jcr.cell.cameras_json import ArmPlaced, CameraPlaced, CamerasFile, TransformUncertainty
from jcr.report.render import Section
from jcr.rounding import significant


def cameras_section(cameras: CamerasFile) -> Section:
    """Return a card for each camera and arm."""
    cards = [_camera(camera) for camera in cameras.cameras] + [_arm(arm) for arm in cameras.arms]
    return Section("cameras", {"cards": cards})


def _camera(camera: CameraPlaced) -> dict[str, Any]:
    """Return the card of a camera with its images."""
    arm = "" if camera.arm is None else f" of arm {camera.arm}"
    name = "base_from_camera" if camera.mount == "base" else f"gripper_from_camera{arm}"
    images = [
        (
            image.image,
            f"{image.points} points",
            "" if image.reprojection_px is None else f"{significant(image.reprojection_px)} px",
            image.reason or "used",
        )
        for image in camera.images
    ]
    placed = _transform(name, camera.parent_from_camera, camera.uncertainty)
    return placed | {
        "title": f"{camera.name}: {name}",
        "rejected": camera.doubt is not None,
        "remarks": camera.warnings,
        "images": images,
    }


def _arm(arm: ArmPlaced) -> dict[str, Any]:
    """Return the card of an arm."""
    name = "base_from_other_base"
    placed = _transform(name, arm.base_from_other_base, arm.uncertainty)
    return placed | {"title": f"arm {arm.name}: {name}", "rejected": False, "remarks": (), "images": ()}


def _transform(
    name: str, matrix: list[list[float]] | None, uncertainty: TransformUncertainty | None
) -> dict[str, Any]:
    """Return the matrix as text, to read and to copy, and its standard deviations; None without a transform."""
    if matrix is None or uncertainty is None:
        return {"name": name, "matrix": None}
    scene = ""
    if uncertainty.at_scene_mm is not None and uncertainty.scene_distance_m is not None:
        far = f"{uncertainty.scene_distance_m:.2f} m away"
        scene = f"; ± {significant(uncertainty.at_scene_mm)} mm at the scene, {far}"
    millimetres = ", ".join(significant(value) for value in uncertainty.translation_std_mm)
    degrees = ", ".join(significant(value) for value in uncertainty.rotation_std_deg)
    return {
        "name": name,
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row)[1:] for row in matrix),
        "copied": str(np.round(np.array(matrix), 9).tolist()),
        "std": f"± {millimetres} mm, {degrees} ° (1 σ){scene}",
    }
