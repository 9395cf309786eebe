"""cameras.json: the further cameras and arms of a cell on disk, beside the calibration they were placed with."""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, ValidationError, model_validator

from jcr.arrays_json import Covariance6, Matrix, Part, Spread, Spread3
from jcr.calibration.findings_json import FindingJson, derived, require_one_verdict
from jcr.capture.plain_files import first_fault, is_written, read_json
from jcr.cell.found import CameraFound, CellFound, ImageFound
from jcr.errors import InputError
from jcr.files import write_text
from jcr.findings import Verdict, doubt_of
from jcr.intrinsics_json import IntrinsicsAndStd
from jcr.records import Mount
from jcr.rounding import significant

FILE, FORMAT = "cameras.json", "jcr.cameras/1"


class TransformUncertainty(Part):
    """One-sigma uncertainty of a transform, along axes of its parent frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    covariance: Covariance6
    """Of the step (geometry.retract) to the true transform: translation (m) and rotation vector (rad), in axes of its
    parent."""
    at_scene_mm: Spread | None = None
    """One sigma along the worst axis of a point `scene_distance_m` before the camera."""
    scene_distance_m: Spread | None = None


class CameraPlaced(Part):
    """One camera; of one that was not found the transforms are null, and the first warning is the reason."""

    name: str
    mount: Mount
    arm: str | None
    """null: the capture's own arm."""
    base_from_camera: Matrix | None = None
    """Where a fixed camera is; null for one on a gripper."""
    gripper_from_camera: Matrix | None = None
    """Where a camera on a gripper is; null for a fixed one."""
    uncertainty: TransformUncertainty | None = None
    intrinsics: IntrinsicsAndStd | None = None
    images: list[ImageFound] = Field(alias="pictures")
    findings: list[FindingJson]
    """Findings of the checks, strongest first."""
    verdict: Verdict
    """Severity of the worst finding."""
    converged: bool
    warnings: list[str]
    """Findings in words: what rejects first; then what the user must act on."""

    @model_validator(mode="after")
    def _is_whole(self) -> "CameraPlaced":
        if (self.parent_from_camera is None) is not (self.uncertainty is None):
            raise ValueError("a transform without its uncertainty, or the other way round")
        if self.base_from_camera is not None and self.mount == "gripper":
            raise ValueError("base_from_camera of a camera that moves with the gripper")
        if self.converged and self.parent_from_camera is None:
            raise ValueError("converged without a transform")
        require_one_verdict(self.findings, self.verdict, self.converged)
        return self

    @property
    def parent_from_camera(self) -> list[list[float]] | None:
        """base_from_camera or gripper_from_camera, whichever its mount has."""
        return self.base_from_camera if self.mount == "base" else self.gripper_from_camera

    @property
    def doubt(self) -> str | None:
        """Why it is rejected; None when it is."""
        return doubt_of(self.findings)


class ArmPlaced(Part):
    """Another arm."""

    name: str
    base_from_other_base: Matrix
    """The transform from its base to that of the capture's own arm."""
    uncertainty: TransformUncertainty


class CamerasFile(Part):
    """The content of cameras.json."""

    format: Literal["jcr.cameras/1"] = FORMAT
    cameras: list[CameraPlaced]
    arms: list[ArmPlaced]
    version: str

    def as_json(self) -> dict[str, Any]:
        """As it is written."""
        return self.model_dump(by_alias=True)


def cameras_file(found: CellFound, version: str) -> CamerasFile:
    """The file of what was placed."""
    return CamerasFile(
        cameras=[_camera(camera) for camera in found.cameras],
        arms=[
            ArmPlaced(
                name=arm.name,
                base_from_other_base=arm.base_from_other.tolist(),
                uncertainty=_uncertainty(arm.covariance),
            )
            for arm in found.arms
        ],
        version=version,
    )


def _camera(found: CameraFound) -> CameraPlaced:
    key = "base_from_camera" if found.mount == "base" else "gripper_from_camera"
    transform, covariance = found.parent_from_camera, found.covariance
    sure = None if covariance is None else _uncertainty(covariance, found.std_at_scene, found.scene_distance)
    return CameraPlaced(
        name=found.name,
        mount=found.mount,
        arm=found.arm,
        uncertainty=sure,
        intrinsics=IntrinsicsAndStd.of(found.intrinsics, found.intrinsics_std),
        pictures=list(found.images),
        **derived(found.findings),
        **{} if transform is None else {key: transform.tolist()},
    )


def _uncertainty(
    covariance: Float[ndarray, "6 6"], at_scene: float | None = None, distance: float | None = None
) -> TransformUncertainty:
    std = np.sqrt(np.diag(covariance))
    return TransformUncertainty(
        translation_std_mm=(1e3 * std[:3]).tolist(),
        rotation_std_deg=np.degrees(std[3:]).tolist(),
        covariance=covariance.tolist(),
        at_scene_mm=None if at_scene is None else 1e3 * at_scene,
        scene_distance_m=distance,
    )


def write_cameras(folder: Path, content: CamerasFile) -> None:
    """Write cameras.json of a run folder, whole or not at all."""
    write_text(folder / FILE, json.dumps(content.as_json(), indent=2, allow_nan=False) + "\n")


def read_cameras(folder: Path) -> CamerasFile | None:
    """The cameras.json of a run folder, None where it has none; InputError where it was damaged."""
    file = folder / FILE
    if not is_written(file):
        return None
    read_json(file)  # raises InputError with the place of a fault
    try:
        return CamerasFile.model_validate_json(file.read_bytes(), strict=True)
    except ValidationError as error:
        raise InputError(
            f"{file}: {first_fault(error)}; place the cameras again (jcr run, jcr add-camera)"
        ) from None


def in_words(content: CamerasFile) -> list[str]:
    """What was placed, a few lines a camera."""
    lines = []
    for camera in content.cameras:
        arm = "" if camera.arm is None else f" of arm {camera.arm}"
        if camera.parent_from_camera is None or camera.uncertainty is None:
            lines.append(f"{camera.name}: not placed: {camera.doubt}")
            continue
        sure = camera.uncertainty
        name = "base_from_camera" if camera.mount == "base" else f"gripper_from_camera{arm}"
        used = [image for image in camera.images if image.used]
        points = sum(image.points for image in used)
        lines.append(f"{camera.name}: {name} ({len(used)} of {len(camera.images)} images, {points} points)")
        scene = ""
        if sure.at_scene_mm is not None and sure.scene_distance_m is not None:
            scene = f"; ± {significant(sure.at_scene_mm)} mm at the scene, {sure.scene_distance_m:.2f} m away"
        lines += [*_rows(camera.parent_from_camera), f"  {_plus_minus(sure)}{scene}"]
        rejected = ["rejected: " if camera.doubt else "", *[""] * len(camera.warnings)]
        lines += [f"  {first}{text}" for first, text in zip(rejected, camera.warnings, strict=False)]
        lines += [f"  not used: {image.image}: {image.reason}" for image in camera.images if not image.used]
    for arm in content.arms:
        rows = _rows(arm.base_from_other_base)
        lines += [f"base_from_{arm.name}_base", *rows, f"  {_plus_minus(arm.uncertainty)}"]
    return lines


def _rows(matrix: list[list[float]]) -> list[str]:
    with np.printoptions(precision=6, suppress=True):
        return [f"  {row}" for row in str(np.array(matrix)).splitlines()]


def _plus_minus(sure: TransformUncertainty) -> str:
    x, y, z = sure.translation_std_mm
    rx, ry, rz = sure.rotation_std_deg
    return f"± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ)"
