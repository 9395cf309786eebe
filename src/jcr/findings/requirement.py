"""Required accuracy of a calibration, and the accuracy that it reaches."""

from dataclasses import dataclass
from typing import Literal

Where = Literal["seen", "camera", "scene"]
"""Quantity that an accuracy refers to: a point that the camera sees, the camera on the gripper, or the mapped scene."""


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """Required and reached accuracy of a calibration; 95 % of errors are smaller."""

    translation_mm: float
    rotation_deg: float
    asked: bool
    """Whether the user asked for it; else it is the default, for grasping."""
    distance_mm: float
    """From the camera to the point that the translation is of; 0: the camera itself."""
    reached_mm: float
    reached_deg: float
    more_images: int | None = None
    """At the poses proposed, that would reach it; 0 where it is, None where no reasonable number does."""
    at: Where = "camera"
    """Quantity that the millimetres and degrees refer to."""

    @property
    def met(self) -> bool:
        """Whether 95 % of the errors are within what is required."""
        return self.reached_mm <= self.translation_mm and self.reached_deg <= self.rotation_deg

    @property
    def details(self) -> dict[str, float | str]:
        """Numbers and names for the details of a finding."""
        named = {name: value for name, value in vars(self).items() if value is not None}
        return {name: one if isinstance(one, str) else float(one) for name, one in named.items()}
