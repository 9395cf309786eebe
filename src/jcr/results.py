"""What the whole job is given, and what it hands to the report, the command line and the caller."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.calibration_json import CalibrationFile
from jcr.calibration.options import CalibrateOptions
from jcr.cell.placement import CamerasFile
from jcr.depth.options import DepthOptions
from jcr.errors import InputError
from jcr.findings import Verdict, verdict_of
from jcr.reconstruct import BACKENDS, ReconstructOptions, tries, with_cameras_of
from jcr.records import Capture, HandEye, Intrinsics, PointCloud, PosePairs, Reconstruction
from jcr.run_folder import MadeWith, RunFolder
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.calibration.seen import SeenInBase
    from jcr.scene.scene_map import SceneMap
    from jcr.segments.measure import Measured


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
    def estimates_depth(self) -> bool:
        """Whether dense depth is needed, and the back end that is tried first predicts none."""
        return self.needs_depth and not BACKENDS[tries(self.reconstruct)[0].backend].predicts_depth

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


@dataclass(frozen=True, kw_only=True)
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
        """Whether the calibration is accepted, with warnings or without."""
        return self.hand_eye.converged

    @property
    def verdict(self) -> Verdict:
        """That of calibration.json."""
        return self.hand_eye.verdict

    def noted(self, *notes: str) -> "RunResult":
        """With more notes."""
        update = {"notes": [*self.calibration.notes, *notes]}
        return replace(self, calibration=self.calibration.model_copy(update=update))

    def timed(self, stage: str, start: float, notes: Sequence[str] = ()) -> "RunResult":
        """With the seconds since `start` (time.perf_counter) and the notes of one more stage."""
        timings = self.calibration.timings_s | {stage: round(time.perf_counter() - start, 3)}
        calibration = self.calibration.model_copy(update={"timings_s": timings})
        return replace(self, calibration=calibration).noted(*notes)

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the images that have a camera pose."""
        return self.reconstruction.image_index

    @property
    def intrinsics(self) -> Intrinsics:
        """As the calibration left them."""
        return self.hand_eye.intrinsics or self.reconstruction.intrinsics

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """The hand-eye transform."""
        return self.hand_eye.gripper_from_camera

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """In records.COVARIANCE_ORDER."""
        return self.hand_eye.covariance

    def seen_uncertainty(
        self, x_px: Float[ndarray, "*points 2"], distance_m: Float[ndarray, "*points"] | float
    ) -> Float[ndarray, "*points 3 3"]:
        """Covariance (m², camera axes) of where on the gripper points are that are seen at pixels at distances.

        `x_px` (...,2) are pixels of the distorted image, `distance_m` is along the ray. It is that of `intrinsics`,
        `gripper_from_camera` and the scale together; the robot's pose errors are not in it.
        """
        from jcr.calibration.seen import seen_uncertainty

        return seen_uncertainty(self.hand_eye.estimate, self.intrinsics, np.asarray(x_px, float), distance_m)

    def seen_in_base(
        self,
        x_px: Float[ndarray, "*points 2"],
        distance_m: Float[ndarray, "*points"] | float,
        base_from_gripper: Float[ndarray, "4 4"],
    ) -> "SeenInBase":
        """The same in the base frame for a reported gripper pose, with the errors of that pose beside it.

        Raises InputError for a camera that is fixed, which no gripper pose moves.
        """
        from jcr.calibration.seen import seen_in_base

        if self.capture.mount == "base":
            raise InputError(
                f"{self.out}: its camera is fixed and no gripper pose places its points; use seen_uncertainty"
            )
        x_px = np.asarray(x_px, float)
        return seen_in_base(
            self.hand_eye, self.intrinsics, x_px, distance_m, np.asarray(base_from_gripper, float)
        )

    def _repr_html_(self) -> str:
        """A table, for notebooks."""
        return self.hand_eye.as_html(str(self.out / "report.html"))


@dataclass(frozen=True)
class SavedRun:
    """What a run folder holds, read back without computing anything."""

    out: Path
    calibration: CalibrationFile
    cameras: CamerasFile | None
    """The other cameras of the cell; None where there are none."""

    @property
    def verdict(self) -> Verdict:
        """That of calibration.json."""
        return verdict_of(self.calibration.findings)

    @property
    def converged(self) -> bool:
        """Whether the calibration is accepted, with warnings or without."""
        return self.calibration.converged

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each finding that rejects or warns."""
        return tuple(self.calibration.warnings)

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"] | None:
        """The hand-eye transform; None where none was found, or the camera is fixed."""
        found = self.calibration.gripper_from_camera
        return None if found is None else np.array(found)

    @property
    def covariance(self) -> Float[ndarray, "7 7"] | None:
        """In records.COVARIANCE_ORDER; None where nothing was found."""
        known = self.calibration.uncertainty
        return None if known is None else np.array(known.covariance)

    def capture(self) -> Capture:
        """The images and poses that the run was made from; InputError where they are gone."""
        return RunFolder(self.out).capture()

    def scene(self) -> "SceneMap":
        """The map; InputError where there is none."""
        return RunFolder(self.out).scene()


def load_run(out: str | Path) -> SavedRun:
    """The run in the folder `out`; InputError where there is none, or its calibration.json was damaged."""
    folder = RunFolder(Path(out))
    return SavedRun(folder.path, folder.calibration(), folder.cameras())


@dataclass(frozen=True, kw_only=True)
class PosesResult:
    """The calibration from camera poses that were given, without images."""

    out: Path
    pairs: PosePairs
    calibration: CalibrationFile
    hand_eye: HandEye
    scale_is_one: bool
    """Whether it is accepted and the scale is that of a marker whose size is right."""

    @property
    def converged(self) -> bool:
        """Whether the calibration is accepted, with warnings or without."""
        return self.hand_eye.converged

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Rows of the samples that have a camera pose: all."""
        return self.pairs.image_index
