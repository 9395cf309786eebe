"""What a check returns."""

from dataclasses import dataclass

from jcr.adjust.robots import Adjusted
from jcr.records import Finding, HandEye


@dataclass(frozen=True)
class Checked:
    """Findings of one check."""

    findings: tuple[Finding, ...] = ()
    """Strongest first."""
    hand_eye: HandEye | None = None
    """The calibration with what was measured in it, or the one to keep in place of the present one; None: it stays."""
    adjusted: Adjusted | None = None
    """The adjustment that it is made of, where that is another one."""
