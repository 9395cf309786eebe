"""gripper_from_camera as a file of anybody's states it: a calibration, or the reference of a data set."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.arrays_json import Covariance7, Matrix, Spread3
from jcr.calibration.record import UncertaintyBudget, read_content, validated
from jcr.capture.plain_files import first_fault
from jcr.errors import InputError
from jcr.geometry import require_rigid


@dataclass(frozen=True)
class Known:
    """A calibration as a file of anybody's states it."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"] | None
    """Of the first six of COVARIANCE_ORDER; None where the file has none."""
    parts: dict[str, Float[ndarray, "6 6"]]
    """Of the covariance, by cause; empty where the file names none."""
    doubt: str | None = None
    """Why it is rejected, by its own file; None where it is accepted, or the file has no verdict."""


def read_hand_eye(path: Path) -> Known:
    """gripper_from_camera, and its covariance where the file has one; InputError where there is no transform.

    A reference.json may state `std_mm` and `std_deg`, along the axes of the gripper.
    """
    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = read_content(file)
    doubt = validated(content, file).doubt if "format" in content else None
    try:
        found = _Transform.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; correct it there") from None
    if found.gripper_from_camera is None:
        raise InputError(f"{file}: has no gripper_from_camera; that calibration failed")
    transform = require_rigid(np.array(found.gripper_from_camera), f"{file}: gripper_from_camera")
    if (uncertainty := found.uncertainty) is not None:
        budget = {} if uncertainty.budget is None else vars(uncertainty.budget)
        parts = {name: share.covariance for name, share in budget.items() if share is not None}
        return Known(
            transform,
            np.array(uncertainty.covariance)[:6, :6],
            {name: np.array(part)[:6, :6] for name, part in parts.items() if part is not None},
            doubt,
        )
    if found.std_mm is not None and found.std_deg is not None:
        std = np.r_[np.array(found.std_mm) / 1e3, np.radians(found.std_deg)]
        return Known(transform, np.diag(std**2), {})
    return Known(transform, None, {})


class _Known(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)
    covariance: Covariance7
    budget: UncertaintyBudget | None = None


class _Transform(BaseModel):
    """What is asked of a file that somebody else wrote."""

    model_config = ConfigDict(allow_inf_nan=False)
    gripper_from_camera: Matrix | None = None
    uncertainty: _Known | None = None
    std_mm: Spread3 | None = None
    std_deg: Spread3 | None = None
