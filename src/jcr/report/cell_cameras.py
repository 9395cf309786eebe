"""The section of the cell's other cameras and arms: where each is, how surely, and by which images."""

from html import escape

import numpy as np

from jcr.cell.cameras_json import ArmPlaced, CameraPlaced, CamerasFile, TransformUncertainty
from jcr.report.markup import filled
from jcr.report.transform import copy_button
from jcr.rounding import significant


def cameras_section(cameras: CamerasFile) -> str:
    """A card for each."""
    cards = [_camera(camera) for camera in cameras.cameras] + [_arm(arm) for arm in cameras.arms]
    return filled("cell_cameras.html", cards="\n".join(cards))


def _camera(camera: CameraPlaced) -> str:
    arm = "" if camera.arm is None else f" of arm {camera.arm}"
    name = "base_from_camera" if camera.mount == "base" else f"gripper_from_camera{arm}"
    images = "".join(
        f"<tr><td>{escape(image.image)}</td><td>{image.points} points</td><td>"
        + ("" if image.reprojection_px is None else f"{significant(image.reprojection_px)} px")
        + f"</td><td>{escape(image.reason or 'used')}</td></tr>"
        for image in camera.images
    )
    remarks = "".join(f"<li>{escape(text)}</li>" for text in camera.warnings)
    doubt = "" if camera.doubt is None else '<p class="why">Rejected.</p>'
    body = _transform(name, camera.parent_from_camera, camera.uncertainty)
    return (
        f'<div class="notation wide"><header><h3>{escape(camera.name)}: {escape(name)}</h3>'
        f"{body}{doubt}<ul>{remarks}</ul><table>{images}</table></div>"
    )


def _arm(arm: ArmPlaced) -> str:
    body = _transform("base_from_other_base", arm.base_from_other_base, arm.uncertainty)
    return f'<div class="notation wide"><header><h3>arm {escape(arm.name)}: base_from_other_base</h3>{body}</div>'


def _transform(name: str, matrix: list[list[float]] | None, sure: TransformUncertainty | None) -> str:
    """The rest of the header, the matrix and its standard deviations."""
    if matrix is None or sure is None:
        return "</header>"
    rows = "\n".join("".join(f"{value:>10.6f}" for value in row)[1:] for row in matrix)
    millimetres = ", ".join(significant(value) for value in sure.translation_std_mm)
    degrees = ", ".join(significant(value) for value in sure.rotation_std_deg)
    scene = ""
    if sure.at_scene_mm is not None and sure.scene_distance_m is not None:
        scene = f"; ± {significant(sure.at_scene_mm)} mm at the scene, {sure.scene_distance_m:.2f} m away"
    button = copy_button(str(np.round(np.array(matrix), 9).tolist()), name)
    return (
        f'{button}</header><pre class="matrix">{rows}</pre>'
        f'<p class="note">metres; ± {millimetres} mm, {degrees} ° (1 σ){scene}</p>'
    )
