"""Difference of two calibrations, tested against the covariances of both, with the causes that would explain it."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.calibration.record import (
    AnyCalibration,
    Calibration,
    FailedCalibration,
    read_content,
    validated,
)
from jcr.distributions import chi2
from jcr.errors import InputError, first_fault
from jcr.geometry import require_rigid, step_between
from jcr.records.json_fields import Matrix, Spread3

if TYPE_CHECKING:
    from jcr.result import RunResult

    Comparable = RunResult | AnyCalibration | str | Path | ArrayLike
else:
    Comparable = object

OTHER = "reference"
"""Name of the covariance of a calibration whose file has no budget."""
NOTHING = 1e-6
"""Share of a difference that is rounding."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Difference of one gripper_from_camera from another, in gripper axes."""

    translation_m: Float[ndarray, "3"]
    rotation_vector: Float[ndarray, "3"]
    """rad: R_other = exp(r)·R."""
    sigmas: Float[ndarray, "6"] | None = None
    """Size on each axis in standard deviations of the difference; None where neither states any."""
    chi2: float | None = None
    """Squared Mahalanobis distance, of 6 degrees of freedom where errors of the two are independent."""
    p_value: float | None = None
    explained_by: dict[str, float] = field(default_factory=dict)
    """Share of χ² by cause, largest first; the sum is 1. Empty where there is no difference."""


@dataclass(frozen=True)
class StatedTransform:
    """Transform and covariance of a calibration, or of a reference."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"] | None = None
    """Covariance of the first six of COVARIANCE_ORDER; None where none is stated."""
    parts: dict[str, Float[ndarray, "6 6"]] = field(default_factory=dict)
    """Parts of the covariance, by cause; empty where none are stated."""
    doubt: str | None = None
    """Reason of the rejection; None where it is accepted, or has no verdict."""


class _Reference(BaseModel):
    """Fields of a file that somebody else wrote, such as reference.json."""

    model_config = ConfigDict(allow_inf_nan=False)
    gripper_from_camera: Matrix | None = None
    std_mm: Spread3 | None = None
    std_deg: Spread3 | None = None


def compare(calibration: Comparable, other: Comparable) -> Difference:
    """Return the difference of two calibrations and whether their errors explain it.

    Each is a result, a Calibration, a path (run folder, calibration.json, or a JSON file with gripper_from_camera), or
    a 4×4 gripper_from_camera. Raises InputError where one of them has no transform of a camera on the gripper,
    RejectedError where nothing was found.
    """
    ours, others = (_stated(one, "the calibration") for one in (calibration, other))
    return difference(ours, others)


def _stated(one: Comparable, name: str) -> StatedTransform:
    """Return the transform of what `compare` takes with its covariance; raise InputError without a transform."""
    if isinstance(one, str | Path):
        return read_hand_eye(Path(one))
    record = getattr(one, "calibration", one)
    if isinstance(record, FailedCalibration):
        raise InputError(f"{name}: has no {record.mount}_from_camera; that calibration failed")
    if isinstance(record, Calibration):
        budget = record.uncertainty.budget
        parts = {} if budget is None else {cause: part[:6, :6] for cause, part in vars(budget).items()}
        return StatedTransform(record.gripper_from_camera, record.covariance[:6, :6], parts, record.doubt)
    matrix = np.asarray(one, float)
    if matrix.shape != (4, 4):
        raise InputError(f"a transform of shape {matrix.shape}; give a 4×4 gripper_from_camera")
    return StatedTransform(require_rigid(matrix, "gripper_from_camera"))


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
        return _stated(validated(content, file), str(file))
    try:
        found = _Reference.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; correct it there") from None
    if found.gripper_from_camera is None:
        raise InputError(f"{file}: has no gripper_from_camera; that calibration failed")
    if found.std_mm is None or found.std_deg is None:
        return StatedTransform(found.gripper_from_camera)
    std = np.r_[np.array(found.std_mm) / 1e3, np.radians(found.std_deg)]
    return StatedTransform(found.gripper_from_camera, np.diag(std**2))


def difference(ours: StatedTransform, other: StatedTransform) -> Difference:
    """Return the difference of one calibration from another, compared with the covariances that they state.

    A cause of covariance Pₖ explains ΔᵀV⁻¹PₖV⁻¹Δ of ΔᵀV⁻¹Δ, V = ΣPₖ: the squared size of its best linear prediction.
    """
    step = step_between(ours.gripper_from_camera, other.gripper_from_camera)
    parts, together = dict[str, Float[ndarray, "6 6"]](), np.zeros((6, 6))
    for known in (ours, other):
        if known.covariance is not None:
            together += known.covariance
            rest = known.covariance - sum(known.parts.values(), np.zeros((6, 6)))
            for name, part in (known.parts | {OTHER: rest}).items():
                parts[name] = parts.get(name, np.zeros((6, 6))) + part
    if not np.diag(together).all():  # neither states any, or both are said to be exact
        return Difference(translation_m=step[:3], rotation_vector=step[3:])
    std = np.sqrt(np.diag(together))
    weighed = np.linalg.solve(together / np.outer(std, std), step / std) / std
    squared = float(step @ weighed)
    shares = {name: float(weighed @ part @ weighed) / squared for name, part in parts.items() if squared}
    if abs(shares.get(OTHER, 1.0)) <= NOTHING:
        del shares[OTHER]
    return Difference(
        translation_m=step[:3],
        rotation_vector=step[3:],
        sigmas=np.abs(step) / std,
        chi2=squared,
        p_value=float(chi2.sf(squared, 6)),
        explained_by=dict(sorted(shares.items(), key=lambda item: -item[1])),
    )
