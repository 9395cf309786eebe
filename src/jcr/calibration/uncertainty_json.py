"""The uncertainty of a calibration as calibration.json has it: in mm and degrees, with covariance and budget."""

from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import AfterValidator

from jcr.arrays_json import Covariance7, Part, Spread, Spread3
from jcr.calibration.words import worst_direction
from jcr.records import COVARIANCE_ORDER, Budget, Estimate


def mm_and_deg(metres: float, radians: float) -> dict[str, float]:
    """A translation and a rotation in the units of the file."""
    return {"translation_mm": 1e3 * float(metres), "rotation_deg": float(np.degrees(radians))}


def _order(names: list[str]) -> list[str]:
    if tuple(names) != COVARIANCE_ORDER:
        raise ValueError(f"not {', '.join(COVARIANCE_ORDER)}")
    return names


class Share(Part):
    """One sigma per axis, root mean square over the axes: squares of shares add up to that of the whole."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: Covariance7 | None = None
    """In the order of `uncertainty`; the parts' sum is the whole."""

    @classmethod
    def of(cls, covariance: Float[ndarray, "7 7"]) -> "Share":
        """What a part of the covariance amounts to."""
        metres, radians = np.sqrt(np.diag(covariance)[:6].reshape(2, 3).mean(1))
        return cls(**mm_and_deg(metres, radians), covariance=covariance.tolist())


class UncertaintyBudget(Part):
    """What the uncertainty of the camera on the gripper comes from."""

    robot_random: Share
    robot_systematic: Share
    intrinsics: Share
    images: Share
    faults: Share | None = None
    """What findings add; null in files of earlier versions."""

    @classmethod
    def of(cls, budget: Budget | None) -> "UncertaintyBudget | None":
        """The same parts as shares."""
        if budget is None:
            return None
        return cls(**{name: Share.of(part) for name, part in vars(budget).items()})


class Uncertainty(Part):
    """One-sigma uncertainty; axes of the gripper frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    scale_std_percent: Spread
    covariance: Covariance7
    order: Annotated[list[str], AfterValidator(_order)]
    worst: str
    """The least certain direction of the translation in words, and its size."""
    budget: UncertaintyBudget | None = None

    @classmethod
    def of(cls, estimate: Estimate) -> "Uncertainty":
        """That of an estimate."""
        std = np.sqrt(np.diag(estimate.covariance))
        return cls(
            translation_std_mm=(1e3 * std[:3]).tolist(),
            rotation_std_deg=np.degrees(std[3:6]).tolist(),
            scale_std_percent=float(100 * std[6]),
            covariance=estimate.covariance.tolist(),
            order=list(COVARIANCE_ORDER),
            worst=worst_direction(estimate),
            budget=UncertaintyBudget.of(estimate.budget),
        )
