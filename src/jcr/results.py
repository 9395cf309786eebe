"""Options and results of a run."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.cell.placement import CamerasFile
from jcr.depth.options import DepthOptions
from jcr.findings import Finding, Verdict
from jcr.reconstruct import BACKENDS, ReconstructOptions, tries, with_cameras_of
from jcr.records import Capture, HandEye, Intrinsics, Mount, PointCloud, PosePairs, Reconstruction
from jcr.run_folder import MadeWith, RunFolder
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap
    from jcr.segments.measure import Measurement


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of every stage."""

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions | None = field(default_factory=MapOptions)
    """Options of the map; None: no cloud, no map, and no dense depth, which only these need."""
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
        """Return the options that a run was made with, those of the map chosen again."""
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
        """Whether a map or a known length, which ends on surfaces, needs dense depth."""
        return self.map is not None or self.calibrate.known_length is not None

    @property
    def estimates_depth(self) -> bool:
        """Whether dense depth is needed, and the back end that is tried first predicts none."""
        return self.needs_depth and not BACKENDS[tries(self.reconstruct)[0].backend].predicts_depth

    @property
    def made_with(self) -> MadeWith:
        """Options that the run folder keeps; the map may be made again with other ones."""
        return MadeWith(reconstruct=self.reconstruct, calibrate=self.calibrate, depth=self.depth)

    @property
    def for_report(self) -> dict[str, Mapping[str, Any]]:
        """Options of the stages up to the map, which has its own history."""
        stages = {"reconstruct": self.reconstruct, "calibrate": self.calibrate, "densify": self.depth}
        return {stage: asdict(options) for stage, options in stages.items()}

    def for_capture(self, capture: Capture, backend: str | None = None) -> "RunOptions":
        """Return the options with another back end, or the one that takes the capture's own camera poses."""
        reconstruct = self.reconstruct if backend is None else replace(self.reconstruct, backend=backend)
        return replace(self, reconstruct=with_cameras_of(capture, reconstruct))


@dataclass(frozen=True, kw_only=True)
class CalibrationResult:
    """Calibration and its run folder: the attributes that every result has, of a run or loaded."""

    out: Path
    calibration: Calibration

    @property
    def mount(self) -> Mount:
        """Body that the camera is mounted on."""
        return self.calibration.mount

    @property
    def verdict(self) -> Verdict:
        """Verdict of the worst finding."""
        return self.calibration.verdict

    @property
    def converged(self) -> bool:
        """Whether the calibration is accepted, with warnings or without."""
        return self.calibration.converged

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the checks, strongest first."""
        return tuple(self.calibration.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings that reject or warn, in words."""
        return tuple(self.calibration.warnings)

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """Transform of a camera on the gripper; InputError of a fixed one, RejectedError where nothing was found."""
        return self.calibration.gripper_from_camera

    @property
    def base_from_camera(self) -> Float[ndarray, "4 4"]:
        """Transform of a fixed camera; InputError of one on the gripper, RejectedError where nothing was found."""
        return self.calibration.base_from_camera

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance in records.COVARIANCE_ORDER; RejectedError where nothing was found."""
        return self.calibration.covariance

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Intrinsics that belong to the transform; None where camera poses were given."""
        known = self.calibration.intrinsics
        return None if known is None else known.record()

    def point_in_base(
        self,
        pixel: ArrayLike,
        depth_m: ArrayLike | float,
        base_from_gripper: ArrayLike,
    ) -> tuple[Float[ndarray, "*points 3"], Float[ndarray, "*points 3 3"]]:
        """Return the base-frame coordinates (m) of points that the camera shows, and their covariances (m²).

        As `Calibration.point_in_base`.
        """
        return self.calibration.point_in_base(pixel, depth_m, base_from_gripper)

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        return self.calibration.as_html(str(self.out / "report.html"))


@dataclass(frozen=True, kw_only=True)
class RunResult(CalibrationResult):
    """Result of a run; each stage adds its part."""

    capture: Capture
    hand_eye: HandEye
    """State of the calibration, with the residuals of each image as arrays."""
    reconstruction: Reconstruction
    cloud: PointCloud | None = None
    scene: "SceneMap | None" = None
    measured: "Measurement | None" = None
    """Support plane and objects; None without a map, and where no plane carries the scene."""
    cameras: CamerasFile | None = None
    """Further cameras of the cell; None where there are none."""

    def noted(self, *notes: str) -> "RunResult":
        """Return the result with more notes."""
        update = {"notes": [*self.calibration.notes, *notes]}
        return replace(self, calibration=self.calibration.model_copy(update=update))

    def timed(self, stage: str, start: float, notes: Sequence[str] = ()) -> "RunResult":
        """Return the result with the seconds since `start` (time.perf_counter) and the notes of one more stage."""
        timings = self.calibration.timings_s | {stage: round(time.perf_counter() - start, 3)}
        calibration = self.calibration.model_copy(update={"timings_s": timings})
        return replace(self, calibration=calibration).noted(*notes)

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the images that have a camera pose."""
        return self.reconstruction.image_index


@dataclass(frozen=True, kw_only=True)
class SavedRun(CalibrationResult):
    """Content of a run folder, each part read when it is first used; InputError where it is missing or damaged."""

    @cached_property
    def capture(self) -> Capture:
        """Images and poses of the run."""
        return RunFolder(self.out).capture()

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Camera poses, tracks, and depth where there is some."""
        return RunFolder(self.out).reconstruction()

    @cached_property
    def cloud(self) -> PointCloud:
        """Points in the base frame."""
        return RunFolder(self.out).cloud()

    @cached_property
    def scene(self) -> "SceneMap":
        """Map of the run."""
        return RunFolder(self.out).scene()

    @cached_property
    def cameras(self) -> CamerasFile | None:
        """Further cameras of the cell; None where there are none."""
        return RunFolder(self.out).cameras()

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the images that have a camera pose."""
        return self.reconstruction.image_index


def load_run(out: str | Path) -> SavedRun:
    """Return the run in the folder `out`; InputError where there is none, or its calibration.json was damaged."""
    folder = RunFolder(Path(out))
    return SavedRun(out=folder.path, calibration=folder.calibration())


@dataclass(frozen=True, kw_only=True)
class PosesResult(CalibrationResult):
    """Calibration from camera poses that were given, without images."""

    pairs: PosePairs
    hand_eye: HandEye
    scale_is_one: bool
    """Whether it is accepted and the scale is that of a marker whose size is right."""

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the samples that have a camera pose: all."""
        return self.pairs.image_index
