"""Difference of two hand-eye calibrations: χ² test with both covariances, and the share of χ² by cause of error."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.calibration.likely_cause import UNLIKELY, likely_cause
from jcr.calibration.record import (
    AnyCalibration,
    Calibration,
    FailedCalibration,
    PublishedCalibration,
    read_content,
    validated,
)
from jcr.capture.transform_file import read_transform
from jcr.distributions import chi2
from jcr.errors import InputError, first_fault
from jcr.geometry import require_rigid, step_between
from jcr.records.json_fields import Matrix, Spread3
from jcr.records.json_file import read_json


@dataclass(frozen=True)
class StatedTransform:
    """gripper_from_camera of a calibration or of a reference, with its covariance if that is known."""

    gripper_from_camera: Float[ndarray, "4 4"]
    parts: dict[str, Float[ndarray, "6 6"]] = field(default_factory=dict)
    """Parts of the covariance of translation (m) and rotation vector (rad), as in COVARIANCE_ORDER, by cause of error.
    Empty: the covariance is unknown."""
    doubt: str | None = None
    """Reason why the calibration is rejected; None if it is accepted, or if it is a reference without a verdict."""
    calibration: Calibration | None = None
    """Calibration that the transform is of; None for a reference."""


if TYPE_CHECKING:
    from jcr.result import RunResult

    Comparable = RunResult | AnyCalibration | StatedTransform | str | Path | ArrayLike
else:
    Comparable = object

OTHER = "reference"
"""Cause of error that stands for the covariance outside an uncertainty budget."""
NOTHING = 1e-6
"""Largest share of χ² that is attributed to rounding."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Step from one gripper_from_camera to another along the gripper's axes, and the χ² test of the step."""

    translation_m: Float[ndarray, "3"]
    rotation_vector: Float[ndarray, "3"]
    """Rotation vector r (rad): R_other = exp(r)·R."""
    doubts: tuple[str | None, str | None] = (None, None)
    """Reason why each of the two calibrations is rejected; None if it is accepted or a reference without a verdict."""
    has_errors: tuple[bool, bool] = (False, False)
    """Whether each of the two states its errors. Those of a transform that states none count as 0."""
    sigmas: Float[ndarray, "6"] | None = None
    """Absolute translation and rotation per axis, divided by their standard deviations; None without covariances."""
    chi2: float | None = None
    """Squared Mahalanobis distance; χ² with 6 degrees of freedom if the errors of both are independent."""
    p_value: float | None = None
    explained_by: dict[str, float] = field(default_factory=dict)
    """Share of χ² by cause of error, largest first; the sum is 1. Empty if both transforms are equal."""
    likely_cause: str | None = None
    """Other intrinsics or another frame that explain a difference beyond the reported errors, or of transforms without
    errors; None without such a cause."""

    def __repr__(self) -> str:
        """Return translation, rotation, and whether the reported errors explain them, on one line."""
        mm, deg = 1e3 * np.linalg.norm(self.translation_m), np.degrees(np.linalg.norm(self.rotation_vector))
        explained = "no errors are known"
        if self.p_value is not None:
            explained = f"{'not ' * (self.p_value < UNLIKELY)}explained by the reported errors (p = {self.p_value:.2g})"
        rejected = ", of a rejected calibration" * any(self.doubts)
        return f"<Difference: {mm:.3f} mm, {deg:.4f}°, {explained}{rejected}>"


class _Reference(BaseModel):
    """Content of a reference.json: gripper_from_camera and its standard deviations along the gripper's axes."""

    model_config = ConfigDict(allow_inf_nan=False)
    gripper_from_camera: Matrix | None = None
    std_mm: Spread3 | None = None
    std_deg: Spread3 | None = None


def compare(calibration: Comparable, other: Comparable) -> Difference:
    """Return the step from `calibration` to `other`, and a χ² test whether their covariances explain the step.

    Each argument is a result, a Calibration, a path (run folder, calibration.json, a JSON file with
    gripper_from_camera, or a file that `read_transform` reads), or a 4×4 gripper_from_camera. Raises
    InputError if one of them has none.

    The step Δ is translation (m), then rotation vector (rad), along gripper axes. Its χ² is ΔᵀV⁻¹Δ, where V is the sum
    of the covariances Pₖ of both by all causes of error k. The share of cause k in χ² is ΔᵀV⁻¹PₖV⁻¹Δ / χ². Without any
    covariance, only the step is set.
    """
    ours, others = (_stated(one, "the calibration") for one in (calibration, other))
    doubts, has_errors = (ours.doubt, others.doubt), (bool(ours.parts), bool(others.parts))
    step = step_between(ours.gripper_from_camera, others.gripper_from_camera)
    nothing = np.zeros((6, 6))
    parts = {
        cause: ours.parts.get(cause, nothing) + others.parts.get(cause, nothing)
        for cause in ours.parts | others.parts
    }
    together = sum(parts.values(), nothing)
    pair = ours.gripper_from_camera, others.gripper_from_camera
    calibrations = ours.calibration, others.calibration
    if not np.diag(together).all():  # no covariance is known, or both transforms are stated to be exact
        cause = likely_cause(*pair, None, calibrations)
        return Difference(
            translation_m=step[:3],
            rotation_vector=step[3:],
            doubts=doubts,
            has_errors=has_errors,
            likely_cause=cause,
        )
    std = np.sqrt(np.diag(together))
    weighed = np.linalg.solve(together / np.outer(std, std), step / std) / std
    squared = float(step @ weighed)
    shares = {name: float(weighed @ part @ weighed) / squared for name, part in parts.items() if squared}
    if abs(shares.get(OTHER, 1.0)) <= NOTHING:
        del shares[OTHER]
    p_value = float(chi2.sf(squared, 6))
    return Difference(
        translation_m=step[:3],
        rotation_vector=step[3:],
        doubts=doubts,
        has_errors=has_errors,
        likely_cause=None if p_value >= UNLIKELY else likely_cause(*pair, together, calibrations),
        sigmas=np.abs(step) / std,
        chi2=squared,
        p_value=p_value,
        explained_by=dict(sorted(shares.items(), key=lambda item: -item[1])),
    )


def _stated(one: Comparable, name: str) -> StatedTransform:
    """Return gripper_from_camera and covariance (None for a bare 4×4 transform) of `one`, an argument of `compare`.

    Raises InputError without a transform; `name` denotes the argument in the message.
    """
    if isinstance(one, StatedTransform):
        return one
    if isinstance(one, str | Path):
        return read_hand_eye(Path(one))
    record = getattr(one, "calibration", one)
    if isinstance(record, FailedCalibration):
        raise InputError(f"{name}: has no {record.mount}_from_camera; that calibration failed")
    if isinstance(record, PublishedCalibration):
        return StatedTransform(record.gripper_from_camera, doubt=record.doubt)
    if isinstance(record, Calibration):
        budget = record.uncertainty.budget
        causes = {} if budget is None else vars(budget)
        rest = record.covariance - sum(causes.values(), np.zeros((7, 7)))
        parts = {cause: part[:6, :6] for cause, part in (causes | {OTHER: rest}).items()}
        return StatedTransform(record.gripper_from_camera, parts, record.doubt, record)
    matrix = np.asarray(one, float)
    if matrix.shape != (4, 4):
        raise InputError(f"a transform of shape {matrix.shape}; give a 4×4 gripper_from_camera")
    return StatedTransform(require_rigid(matrix, "gripper_from_camera"))


def read_hand_eye(path: Path) -> StatedTransform:
    """Read gripper_from_camera and its covariance from a run folder, calibration.json or reference.json.

    A reference.json may state standard deviations `std_mm` and `std_deg` along the axes of the gripper. Another file
    holds a transform as jcr.capture.transform_file reads it. Raises InputError for a file without a transform.
    """
    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = _content_of(file)
    if content is None:
        return StatedTransform(read_transform(file))
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
    return StatedTransform(found.gripper_from_camera, {OTHER: np.diag(std**2)})


def _content_of(file: Path) -> dict[str, object] | None:
    """Return the content of a JSON file that states gripper_from_camera or a format of jcr; None for another file."""
    if file.suffix.lower() != ".json":
        return None
    content = read_json(file)
    is_ours = file.name == "calibration.json" or (
        isinstance(content, dict) and "gripper_from_camera" in content
    )
    return read_content(file) if is_ours else None
