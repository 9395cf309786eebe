"""Section of the cell's other cameras and arms: transform, uncertainty and images of each."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.cell.placement import ArmPlacement, CameraPlacement, CamerasFile, TransformUncertainty
from jcr.report.render import Section
from jcr.rounding import significant


def cameras_section(cameras: CamerasFile) -> Section:
    """Return a card for each camera and arm."""
    cards = [_camera(camera) for camera in cameras.cameras] + [_arm(arm) for arm in cameras.arms]
    return Section("cameras", {"cards": cards})


def _camera(camera: CameraPlacement) -> dict[str, Any]:
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


def _arm(arm: ArmPlacement) -> dict[str, Any]:
    """Return the card of an arm."""
    name = "base_from_other_base"
    placed = _transform(name, np.array(arm.base_from_other_base), arm.uncertainty)
    return placed | {"title": f"arm {arm.name}: {name}", "rejected": False, "remarks": (), "images": ()}


def _transform(
    name: str, matrix: Float[ndarray, "4 4"] | None, uncertainty: TransformUncertainty | None
) -> dict[str, Any]:
    """Return the matrix as text, to read and to copy, and its standard deviations; None without a transform."""
    if matrix is None or uncertainty is None:
        return {"name": name, "matrix": None}
    return {
        "name": name,
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row)[1:] for row in matrix),
        "copied": str(matrix.round(9).tolist()),
        "std": uncertainty.in_words,
    }
