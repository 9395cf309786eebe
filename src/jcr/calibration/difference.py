"""Difference of two calibrations, tested against the covariances of both, with the causes that would explain it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.calibration.known_transform import StatedTransform, known_calibration, read_hand_eye
from jcr.calibration.record import Calibration
from jcr.distributions import chi2
from jcr.errors import InputError
from jcr.geometry import require_rigid, step_between

if TYPE_CHECKING:
    from jcr.results import CalibrationResult

    Comparable = CalibrationResult | Calibration | str | Path | ArrayLike
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
    sigmas: Float[ndarray, "6"] | None
    """Size on each axis in standard deviations of the difference; None where neither states any."""
    chi2: float | None
    """Squared Mahalanobis distance, of 6 degrees of freedom where errors of the two are independent."""
    p_value: float | None
    explained_by: dict[str, float]
    """Share of χ² by cause, largest first; the sum is 1. Empty where there is no difference."""


def compare(calibration: Comparable, other: Comparable) -> Difference:
    """Return the difference of two calibrations and whether their errors explain it.

    Each is a result, a Calibration, a path (run folder, calibration.json, or a JSON file with gripper_from_camera), or
    a 4×4 gripper_from_camera. Raises InputError where one of them has no transform of a camera on the gripper,
    RejectedError where nothing was found.
    """
    return difference(_known(calibration), _known(other))


def _known(one: Comparable) -> StatedTransform:
    """Return transform and covariance of what `compare` takes."""
    if isinstance(one, str | Path):
        return read_hand_eye(Path(one))
    record = getattr(one, "calibration", one)
    if isinstance(record, Calibration):
        return known_calibration(record)
    matrix = np.asarray(one, float)
    if matrix.shape != (4, 4):
        raise InputError(f"a transform of shape {matrix.shape}; give a 4×4 gripper_from_camera")
    return StatedTransform(require_rigid(matrix, "gripper_from_camera"), None, {})


def difference(ours: StatedTransform, other: StatedTransform) -> Difference:
    """Return the difference of one calibration from another, compared with the covariances that they state.

    A cause of covariance Pₖ explains ΔᵀV⁻¹PₖV⁻¹Δ of ΔᵀV⁻¹Δ, V = ΣPₖ: the squared size of its best linear prediction.
    """
    step = step_between(ours.gripper_from_camera, other.gripper_from_camera)
    parts: dict[str, Float[ndarray, "6 6"]] = {}
    together = np.zeros((6, 6))
    for known in (ours, other):
        if known.covariance is None:
            continue
        together += known.covariance
        rest = known.covariance - sum(known.parts.values(), np.zeros((6, 6)))
        for name, part in (known.parts | {OTHER: rest}).items():
            parts[name] = parts.get(name, np.zeros((6, 6))) + part
    if not np.diag(together).all():  # neither states any, or both are said to be exact
        return Difference(
            translation_m=step[:3],
            rotation_vector=step[3:],
            sigmas=None,
            chi2=None,
            p_value=None,
            explained_by={},
        )
    std = np.sqrt(np.diag(together))
    weighed = np.linalg.solve(together / np.outer(std, std), step / std) / std
    squared = float(step @ weighed)
    explained = {name: float(weighed @ part @ weighed) for name, part in parts.items()} if squared else {}
    return Difference(
        translation_m=step[:3],
        rotation_vector=step[3:],
        sigmas=np.abs(step) / std,
        chi2=squared,
        p_value=float(chi2.sf(squared, 6)),
        explained_by={
            name: part / squared
            for name, part in sorted(explained.items(), key=lambda item: -item[1])
            if name != OTHER or part > NOTHING * squared
        },
    )
