"""Sizes of the errors of arms, by name, for benches and tests."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from simulation.bent_arm import ErrorSizes


@dataclass(frozen=True)
class ArmErrors:
    """One-sigma errors of an arm's reported poses."""

    white: tuple[float, float] = (0.0, 0.0)
    """m, rad per axis, independent at each pose."""
    sizes: ErrorSizes = ErrorSizes()
    """Systematic errors, the same for all poses."""


PresetName = Literal["white", "factory-calibrated", "typical", "poor", "low-cost"]


def _bent(joint_offset_deg: float, link_mm: float) -> ArmErrors:
    return ArmErrors((5e-5, np.radians(0.01)), ErrorSizes(np.radians(joint_offset_deg), 1e-3 * link_mm))


PRESETS: dict[PresetName, ArmErrors] = {
    "white": ArmErrors((5e-4, np.radians(0.1))),
    "factory-calibrated": _bent(0.03, 0.1),
    "typical": _bent(0.1, 0.3),
    "poor": _bent(0.3, 1.0),
    "low-cost": _bent(1.0, 1.0),
}
"""Random noise alone, or systematic errors beside a small repeatability (0.05 mm, 0.01°)."""
