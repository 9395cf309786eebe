"""Record of the required accuracy of a calibration and of the accuracy that the calibration reaches."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """Required and reached accuracy of a point that the camera sees, as bounds on 95 % of the errors."""

    translation_mm: float
    """Required bound on the translation error."""
    rotation_deg: float
    """Required bound on the rotation error."""
    distance_mm: float
    """Distance from the camera to the point at the image centre to which the bounds refer."""
    reached_mm: float
    """Bound on the translation error that the calibration reaches."""
    reached_deg: float
    """Bound on the rotation error that the calibration reaches."""
    more_images: int | None = None
    """Number of images to add until the required accuracy is reached, by an estimate; 0 if it is reached, None if no
    reasonable number suffices."""

    @property
    def met(self) -> bool:
        """Whether both reached bounds are at most the required ones."""
        return self.reached_mm <= self.translation_mm and self.reached_deg <= self.rotation_deg

    @property
    def details(self) -> dict[str, float | str]:
        """Required and reached accuracy as the `details` of a finding that the requirement is not met."""
        return {name: float(value) for name, value in vars(self).items() if value is not None}
