"""gripper_from_camera of a calibration, or of the reference of a data set."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.arrays_json import Matrix, Spread3
from jcr.calibration.record import Calibration, read_content, validated
from jcr.capture.plain_files import first_fault
from jcr.errors import InputError


@dataclass(frozen=True)
class StatedTransform:
    """Transform and covariance of a calibration, or of a reference."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"] | None
    """Covariance of the first six of COVARIANCE_ORDER; None where none is stated."""
    parts: dict[str, Float[ndarray, "6 6"]]
    """Parts of the covariance, by cause; empty where none are stated."""
    doubt: str | None = None
    """Reason of the rejection; None where it is accepted, or has no verdict."""


def read_hand_eye(path: Path) -> StatedTransform:
    """Read gripper_from_camera, and its covariance where the file has one; raise InputError without a transform.

    A reference.json may state `std_mm` and `std_deg`, along the axes of the gripper.
    """
    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = read_content(file)
    if "format" in content:
        return known_calibration(validated(content, file), str(file))
    try:
        found = _Transform.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; correct it there") from None
    if found.gripper_from_camera is None:
        raise InputError(f"{file}: has no gripper_from_camera; that calibration failed")
    transform = found.gripper_from_camera
    if found.std_mm is not None and found.std_deg is not None:
        std = np.r_[np.array(found.std_mm) / 1e3, np.radians(found.std_deg)]
        return StatedTransform(transform, np.diag(std**2), {})
    return StatedTransform(transform, None, {})


def known_calibration(calibration: Calibration, name: str = "the calibration") -> StatedTransform:
    """Return the transform of a calibration with its covariance and the parts of it; raise InputError without one."""
    if calibration.parent_from_camera is None or calibration.uncertainty is None:
        raise InputError(f"{name}: has no {calibration.mount}_from_camera; that calibration failed")
    budget = calibration.uncertainty.budget
    shares = {} if budget is None else {name: share for name, share in budget if share is not None}
    return StatedTransform(
        calibration.gripper_from_camera,
        calibration.covariance[:6, :6],
        {name: share.covariance[:6, :6] for name, share in shares.items() if share.covariance is not None},
        calibration.doubt,
    )


class _Transform(BaseModel):
    """Fields of a file that somebody else wrote."""

    model_config = ConfigDict(allow_inf_nan=False)
    gripper_from_camera: Matrix | None = None
    std_mm: Spread3 | None = None
    std_deg: Spread3 | None = None
