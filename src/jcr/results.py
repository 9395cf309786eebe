"""What the whole job is given, and what it hands to the report, the command line and the caller."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.options import CalibrateOptions
from jcr.cell.cameras_json import CamerasFile
from jcr.depth.options import DepthOptions
from jcr.geometry import rotation_log
from jcr.reconstruct.backends import ReconstructOptions, with_cameras_of
from jcr.records import Capture, HandEye, Intrinsics, PointCloud, PosePairs, Reconstruction
from jcr.represent.options import CloudOptions, MapOptions
from jcr.run_folder import MadeWith
from jcr.segment.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap
    from jcr.segment.measure import Measured


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The options of every stage."""

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions | None = field(default_factory=MapOptions)
    """None: no cloud and no map, and no dense depth, which only these need."""
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)

    @classmethod
    def of(
        cls,
        made_with: MadeWith,
        *,
        map: MapOptions | None,
        cloud: CloudOptions | None = None,
        segment: SegmentOptions | None = None,
    ) -> "RunOptions":
        """The options that a run was made with, those of the map chosen again."""
        return cls(
            reconstruct=made_with.reconstruct,
            calibrate=made_with.calibrate,
            depth=replace(made_with.depth, dense=True),
            cloud=cloud or CloudOptions(),
            map=map,
            segment=segment or SegmentOptions(),
        )

    @property
    def needs_depth(self) -> bool:
        """Whether anything needs dense depth: a map, or a known length, which ends on surfaces."""
        return self.map is not None or self.calibrate.known_length is not None

    @property
    def made_with(self) -> MadeWith:
        """What the run folder keeps of them: the map may be made again with other ones."""
        return MadeWith(reconstruct=self.reconstruct, calibrate=self.calibrate, depth=self.depth)

    @property
    def for_report(self) -> dict[str, Mapping[str, Any]]:
        """The options of the stages up to the map, which has its own history."""
        stages = {"reconstruct": self.reconstruct, "calibrate": self.calibrate, "densify": self.depth}
        return {stage: asdict(options) for stage, options in stages.items()}

    def for_capture(self, capture: Capture, backend: str | None = None) -> "RunOptions":
        """The same with another back end, or the one that takes the capture's own camera poses."""
        reconstruct = self.reconstruct if backend is None else replace(self.reconstruct, backend=backend)
        return replace(self, reconstruct=with_cameras_of(capture, reconstruct))


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
    measured: "Measured | None" = None
    """None without a map, and where no plane carries the scene."""
    cameras: CamerasFile | None = None
    """The other cameras of the cell; None where there are none."""

    @property
    def converged(self) -> bool:
        """Whether the calibration may be trusted."""
        return self.hand_eye.converged

    def timed(self, stage: str, start: float, notes: Sequence[str] = ()) -> "RunResult":
        """With the seconds since `start` (time.perf_counter) and the notes of one more stage."""
        timings = self.calibration.timings_s | {stage: round(time.perf_counter() - start, 3)}
        update = {"timings_s": timings, "notes": [*self.calibration.notes, *notes]}
        return replace(self, calibration=self.calibration.model_copy(update=update))

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the images that have a camera pose."""
        return self.reconstruction.image_index

    @property
    def lens(self) -> Intrinsics:
        """As the calibration left it."""
        return self.hand_eye.intrinsics or self.reconstruction.intrinsics

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """The hand-eye transform."""
        return self.hand_eye.gripper_from_camera

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """In records.COVARIANCE_ORDER."""
        return self.hand_eye.covariance

    def _repr_html_(self) -> str:
        """A table, for notebooks."""
        return hand_eye_table(self.hand_eye, str(self.out / "report.html"))


def hand_eye_table(hand_eye: HandEye, report: str) -> str:
    """The transform with its standard deviations as HTML."""
    std = np.sqrt(np.diag(hand_eye.covariance))
    mm = 1e3 * hand_eye.gripper_from_camera[:3, 3]
    turn = np.degrees(rotation_log(hand_eye.gripper_from_camera[:3, :3]))
    rows = "".join(
        f"<tr><th>{axis}</th><td>{mm[k]:.2f} ± {1e3 * std[k]:.2f} mm</td>"
        f"<td>{turn[k]:.3f} ± {np.degrees(std[3 + k]):.3f}°</td></tr>"
        for k, axis in enumerate("xyz")
    )
    verdict = "accepted" if hand_eye.converged else f"rejected: {escape('; '.join(hand_eye.warnings))}"
    return (
        f"<p><b>gripper_from_camera</b>, {verdict}; {int(hand_eye.inliers.sum())} of {len(hand_eye.inliers)} poses "
        f"used</p><table><tr><th></th><th>translation</th><th>rotation vector</th></tr>{rows}</table>"
        f"<p>1σ, gripper axes. {escape(report)}</p>"
    )


@dataclass(frozen=True)
class PosesResult:
    """What camera poses that were given say, without images."""

    out: Path
    pairs: PosePairs
    calibration: CalibrationFile
    hand_eye: HandEye
    scale_is_one: bool
    """Whether it may be trusted and the scale is that of a marker whose size is right."""

    @property
    def converged(self) -> bool:
        """Whether the calibration may be trusted."""
        return self.hand_eye.converged

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the samples that have a camera pose: all."""
        return self.pairs.image_index
