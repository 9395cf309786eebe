"""What the whole job hands to the report, the command line and the caller."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.calibration.calibration_json import CalibrationFile
from jcr.records import HandEye, PointCloud, Reconstruction
from jcr.segment.measure import Measured

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap


@dataclass(frozen=True)
class RunResult:
    """What a run found, and where it is kept."""

    out: Path
    calibration: CalibrationFile
    hand_eye: HandEye
    reconstruction: Reconstruction
    cloud: PointCloud | None = None
    scene: "SceneMap | None" = None
    measured: Measured | None = None
    """None without a map, and where no plane carries the scene."""

    @property
    def converged(self) -> bool:
        """Whether the calibration may be trusted."""
        return self.hand_eye.converged


@dataclass(frozen=True)
class PosesResult:
    """What camera poses that were given say, without images."""

    out: Path
    calibration: CalibrationFile
    hand_eye: HandEye

    @property
    def converged(self) -> bool:
        """Whether the calibration may be trusted."""
        return self.hand_eye.converged
