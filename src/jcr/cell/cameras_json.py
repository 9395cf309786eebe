"""cameras.json: the further cameras and arms of a cell on disk, beside the calibration they were placed with."""

import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from jcr.calibration.calibration_json import Lens, Matrix, Spread, Spread3
from jcr.capture.plain_files import first_fault, is_written, read_json
from jcr.cell.found import ArmFound, CameraFound, CellFound, PictureFound
from jcr.errors import InputError
from jcr.files import write_text
from jcr.rounding import significant

FILE, FORMAT = "cameras.json", "jcr.cameras/1"
ORDER = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
"""Of the covariances: the step (geometry.retract) that takes the transform to the true one, in axes of its parent."""


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    matrix = np.array(rows)
    if np.linalg.eigvalsh((matrix + matrix.T) / 2)[0] < -1e-9 * max(float(np.abs(matrix).max()), 1e-12):
        raise ValueError("no covariance: a variance is negative")
    return rows


Numbers6 = Annotated[list[float], Field(min_length=6, max_length=6)]
Covariance6 = Annotated[list[Numbers6], Field(min_length=6, max_length=6), AfterValidator(_covariance)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Sureness(_Part):
    """One-sigma uncertainty of a transform, along axes of its parent frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    covariance: Covariance6
    """In ORDER; m and rad."""
    at_scene_mm: Spread | None = None
    """Along the worst axis, of a point at `scene_distance_m` before the camera."""
    scene_distance_m: Spread | None = None


class CameraPlaced(_Part):
    """One camera; of one that was not found the transforms are null, and the first warning says why."""

    name: str
    mount: Literal["gripper", "base"]
    arm: str | None
    """null: the capture's own arm."""
    base_from_camera: Matrix | None = None
    """Of a fixed camera."""
    gripper_from_camera: Matrix | None = None
    """Of a camera on a gripper."""
    uncertainty: Sureness | None = None
    intrinsics: Lens | None = None
    pictures: list[PictureFound]
    converged: bool
    warnings: list[str]

    @model_validator(mode="after")
    def _is_whole(self) -> "CameraPlaced":
        if (self.parent_from_camera is None) is not (self.uncertainty is None):
            raise ValueError("a transform without its uncertainty, or the other way round")
        if self.base_from_camera is not None and self.mount == "gripper":
            raise ValueError("base_from_camera of a camera that moves with the gripper")
        if self.converged and self.parent_from_camera is None:
            raise ValueError("converged without a transform")
        if not self.converged and not self.warnings:
            raise ValueError("not converged, and no warning says why")
        return self

    @property
    def parent_from_camera(self) -> list[list[float]] | None:
        """base_from_camera or gripper_from_camera, whichever its mount has."""
        return self.base_from_camera if self.mount == "base" else self.gripper_from_camera

    @property
    def doubt(self) -> str | None:
        """Why it is rejected; None when it is."""
        return None if self.converged else next(iter(self.warnings))


class ArmPlaced(_Part):
    """Another arm."""

    name: str
    base_from_other_base: Matrix
    """From its base to that of the capture's own arm."""
    uncertainty: Sureness


class CamerasFile(_Part):
    """The content of cameras.json."""

    format: Literal["jcr.cameras/1"] = FORMAT
    cameras: list[CameraPlaced]
    arms: list[ArmPlaced]
    version: str


def cameras_file(found: CellFound, version: str) -> CamerasFile:
    """The file of what was placed."""
    return CamerasFile(
        cameras=[_camera(camera) for camera in found.cameras],
        arms=[_arm(arm) for arm in found.arms],
        version=version,
    )


def _camera(found: CameraFound) -> CameraPlaced:
    key = "base_from_camera" if found.mount == "base" else "gripper_from_camera"
    transform, covariance = found.parent_from_camera, found.covariance
    lens, std = found.intrinsics, found.intrinsics_std
    return CameraPlaced(
        name=found.name,
        mount=found.mount,
        arm=found.arm,
        uncertainty=None
        if covariance is None
        else _sureness(covariance, found.std_at_scene, found.scene_distance),
        intrinsics=None
        if lens is None
        else Lens.model_validate(
            vars(lens) | {"distortion": list(lens.distortion), "std": None if std is None else std.tolist()}
        ),
        pictures=list(found.pictures),
        converged=found.converged,
        warnings=list(found.warnings),
        **{} if transform is None else {key: transform.tolist()},
    )


def _arm(found: ArmFound) -> ArmPlaced:
    return ArmPlaced(
        name=found.name,
        base_from_other_base=found.base_from_other.tolist(),
        uncertainty=_sureness(found.covariance),
    )


def _sureness(
    covariance: Float[ndarray, "6 6"], at_scene: float | None = None, distance: float | None = None
) -> Sureness:
    std = np.sqrt(np.diag(covariance))
    return Sureness(
        translation_std_mm=(1e3 * std[:3]).tolist(),
        rotation_std_deg=np.degrees(std[3:]).tolist(),
        covariance=covariance.tolist(),
        at_scene_mm=None if at_scene is None else 1e3 * at_scene,
        scene_distance_m=distance,
    )


def write_cameras(folder: Path, content: CamerasFile) -> None:
    """Write cameras.json of a run folder, whole or not at all."""
    write_text(folder / FILE, json.dumps(content.model_dump(), indent=2, allow_nan=False) + "\n")


def read_cameras(folder: Path) -> CamerasFile | None:
    """The cameras.json of a run folder, None where it has none; InputError where it was damaged."""
    file = folder / FILE
    if not is_written(file):
        return None
    read_json(file)  # says what is no JSON
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
        used = sum(picture.used for picture in camera.pictures)
        points = sum(picture.points for picture in camera.pictures if picture.used)
        pictures = f"{used} of {len(camera.pictures)} images, {points} points"
        lines.append(f"{camera.name}: {name} ({pictures})")
        with np.printoptions(precision=6, suppress=True):
            lines += [f"  {row}" for row in str(np.array(camera.parent_from_camera)).splitlines()]
        scene = (
            ""
            if sure.at_scene_mm is None or sure.scene_distance_m is None
            else f"; ± {significant(sure.at_scene_mm)} mm at the scene, {sure.scene_distance_m:.2f} m away"
        )
        lines.append(f"  {_plus_minus(sure)}{scene}")
        lines += [
            f"  {'rejected: ' if k == 0 and camera.doubt else ''}{text}"
            for k, text in enumerate(camera.warnings)
        ]
        lines += [f"  not used: {p.image}: {p.reason}" for p in camera.pictures if not p.used]
    for arm in content.arms:
        lines.append(f"base_from_{arm.name}_base")
        with np.printoptions(precision=6, suppress=True):
            lines += [f"  {row}" for row in str(np.array(arm.base_from_other_base)).splitlines()]
        lines.append(f"  {_plus_minus(arm.uncertainty)}")
    return lines


def _plus_minus(sure: Sureness) -> str:
    x, y, z = sure.translation_std_mm
    rx, ry, rz = sure.rotation_std_deg
    return f"± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ)"
