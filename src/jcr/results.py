"""What the whole job is told, and what it hands to the report, the command line and the caller."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.options import CalibrateOptions
from jcr.reconstruct.backends import ReconstructOptions
from jcr.records import Capture, HandEye, Intrinsics, PointCloud, Reconstruction
from jcr.represent.options import CloudOptions, MapOptions
from jcr.segment.measure import Measured
from jcr.segment.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap


@dataclass(frozen=True)
class RunOptions:
    """The options of every stage."""

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions | None = field(default_factory=MapOptions)
    """None: no cloud and no map, and no dense depth, which only these need."""
    segment: SegmentOptions = field(default_factory=SegmentOptions)


@dataclass(frozen=True)
class RunResult:
    """What a run found, and where it is kept; each stage adds its part."""

    out: Path
    capture: Capture
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

    @property
    def lens(self) -> Intrinsics:
        """As the calibration left it."""
        return self.hand_eye.intrinsics or self.reconstruction.intrinsics


@dataclass(frozen=True)
class PosesResult:
    """What camera poses that were given say, without images."""

    out: Path
    calibration: CalibrationFile
    hand_eye: HandEye
    scale_is_one: bool
    """Whether it may be trusted and the scale is that of a marker whose size is right."""

    @property
    def converged(self) -> bool:
        """Whether the calibration may be trusted."""
        return self.hand_eye.converged
