"""Options, state and result of a run; parts of the result are read from the run folder on first use.

A file of the run folder may be invalid, because the user has edited it; reading then raises InputError.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr.backends import ReconstructOptions
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import (
    AnyCalibration,
    Calibration,
    FailedCalibration,
    PublishedCalibration,
    read_calibration,
)
from jcr.capture.added_capture import read_added
from jcr.capture.read import read_capture
from jcr.cell.added_cameras import read_added_cameras
from jcr.cell.cameras_json import CamerasFile, read_cameras
from jcr.depth.depth_npz import DEPTH_FILE as DEPTH
from jcr.depth.depth_npz import read_depth
from jcr.depth.options import DepthOptions
from jcr.errors import InputError, RejectedError, first_fault
from jcr.files import as_path, read_bytes
from jcr.findings import Finding, Verdict
from jcr.records import Attempt, Capture, CellCamera, IntrinsicsAndStd, PointCloud, Reconstruction
from jcr.records.reconstruction_npz import read_reconstruction
from jcr.scene.cloud import read_cloud
from jcr.scene.map_file import MAP_FILE as MAP
from jcr.scene.map_file import load_map
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.pipeline.verify import Verification
    from jcr.scene.scene_map import SceneMap
    from jcr.segments.measure import Measurement

STATE = "run.json"
"""File of a RunState: capture, options and attempts of a run, and fingerprints of its inputs and files."""
RECONSTRUCTION, CALIBRATION, LOG = "reconstruction.npz", "calibration.json", "log.txt"
CLOUD, REPORT = "cloud.ply", "report.html"
CAPTURE = "capture"
"""Folder for a copy of images and poses that were read from another format than capture.json."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of all stages of a run."""

    method: Literal["default", "paper"] = "default"
    """Method of reconstruction, calibration and map: that of this package, or the published one (jcr.paper)."""
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions | None = field(default_factory=MapOptions)
    """Options of the map; None: neither map, point cloud nor dense depth is made."""
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)


class RunState(BaseModel):
    """Content of run.json: capture, options and attempts of a run, and what its files were made from."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    capture: Annotated[str, Field(max_length=4096, pattern=r"^[^\x00]+$")]
    """Folder of the capture."""
    options: RunOptions
    version: Annotated[int, Field(ge=1)] = 1
    """Number of this calibration of the camera: 1, and one more with each `jcr verify --recalibrate`."""
    predecessor: str | None = None
    """Run folder of the version before; None for the first one."""
    attempts: tuple[Attempt, ...] = ()
    """Attempts with different back ends, from which the reconstruction was selected."""
    made: dict[str, str] = {}
    """Fingerprints of the inputs of stages by their names: "select" (reconstruction), "densify" (depth), and "report"
    for all inputs, which only a finished run has."""
    files: dict[str, str] = {}
    """Fingerprints of calibration.json and added images, by file name, and an empty text for each other file of a
    finished run; empty for an unfinished run."""


class RunResult:
    """Result of a run in the folder `out`: its records, and the numbers that most programs need.

    All other numbers are those of its `calibration`; `help(jcr.Calibration)` describes them.

    Parts that this process has not computed are read from the folder on first use; a damaged file raises InputError.
    """

    out: Path
    """Run folder."""
    is_unchanged: bool = False
    """Whether nothing was computed, because the folder held the results of the same run already."""

    def __init__(self, out: str | Path, **parts: Any) -> None:
        """Open the run folder `out`; `parts` are properties known already, such as `calibration`, which are not read."""
        vars(self).update(parts, out=as_path(out, "out"))

    def with_parts(self, **parts: Any) -> "RunResult":
        """Return the result with the properties named in `parts`, such as `calibration`, replaced."""
        return RunResult(**(vars(self) | parts))

    def __repr__(self) -> str:
        try:
            found = self.calibration
        except InputError as error:
            return f"<RunResult {error}>"
        return f"<RunResult {self.out}: {found.in_short}>"

    @cached_property
    def calibration(self) -> AnyCalibration:
        """Calibration of the run, which is the content of calibration.json; also that of a failed one."""
        return read_calibration(self.out)

    @property
    def verdict(self) -> Verdict:
        """Result of all checks: accepted; accepted, but not as exact as needed; not checked; or rejected."""
        return self.calibration.verdict

    @property
    def converged(self) -> bool:
        """Whether no finding rejects the calibration, which may be less exact than needed."""
        return self.calibration.converged

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the checks: first those that reject, then warnings, then remarks; causes before consequences."""
        return self.calibration.findings

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """Pose (m) of a camera on the gripper; raises InputError for a fixed one, RejectedError without calibration."""
        return self.solved.gripper_from_camera

    @property
    def base_from_camera(self) -> Float[ndarray, "4 4"]:
        """Pose (m) of a fixed camera; raises InputError for one on the gripper, RejectedError without calibration."""
        return self.solved.base_from_camera

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance of transform and log scale, as `Calibration.covariance`; the errors are those of `found`."""
        return self.found.covariance

    @property
    def intrinsics(self) -> IntrinsicsAndStd | None:
        """Intrinsics to use together with the transform (px); None for a calibration from given poses."""
        return self.calibration.intrinsics

    def point_in_base(
        self, pixel: ArrayLike, depth_m: ArrayLike | float, base_from_gripper: ArrayLike
    ) -> tuple[Float[ndarray, "*points 3"], Float[ndarray, "*points 3 3"]]:
        """Return base-frame coordinates (m) and covariances (m²) of points, as `Calibration.point_in_base`.

        Raises also the errors of `found`.
        """
        return self.found.point_in_base(pixel, depth_m, base_from_gripper)

    @property
    def found(self) -> Calibration:
        """Calibration of a successful run; raises RejectedError for a failed one, InputError for a published one."""
        if isinstance(found := self.solved, PublishedCalibration):
            raise InputError(f"{self.out}: --method paper has no uncertainty; run the default method")
        return found

    @property
    def solved(self) -> Calibration | PublishedCalibration:
        """Calibration of a successful run by either method; raises RejectedError for a failed calibration."""
        if isinstance(self.calibration, FailedCalibration):
            raise RejectedError(f"no calibration was found: {self.calibration.doubt}")
        return self.calibration

    @cached_property
    def state(self) -> RunState:
        """Content of run.json; raises InputError if the folder holds no run."""
        file = self.out / STATE
        try:
            return RunState.model_validate_json(read_bytes(file), strict=True)
        except ValidationError as error:
            raise InputError(f"{file}: {first_fault(error)}; repeat `jcr calibrate` or `jcr run`") from None
        except OSError:
            raise InputError(f"{self.out}: no run; make one with `jcr run` or `jcr calibrate`") from None

    @cached_property
    def capture(self) -> Capture:
        """Capture of the run; raises InputError if it was moved or deleted."""
        folder = Path(self.state.capture)
        try:
            if not folder.exists():
                raise InputError(
                    f"{self.out}: was made from the capture at {folder}, which is gone; move it back there, or run it "
                    f"again (jcr run CAPTURE {self.out})"
                )
            return read_capture(folder)
        except OSError as error:  # a path that is invalid for the file system
            raise InputError(f"{self.out / STATE}: capture: {error.strerror}; run `jcr run` again") from None

    @cached_property
    def added(self) -> Capture:
        """Capture of the images that `build_map` added later for the map only; empty if there are none."""
        return read_added(self.out, self.capture)

    @cached_property
    def others(self) -> tuple[CellCamera, ...]:
        """Cameras of the cell besides the calibrated one: from the capture, then added to the run (`add_camera`)."""
        return (*self.capture.others, *read_added_cameras(self.out, self.capture))

    @cached_property
    def reconstruction(self) -> Reconstruction:
        """Reconstruction of the run, with pointmaps if the run has depth."""
        found = read_reconstruction(self.out / RECONSTRUCTION)
        if found.pointmaps is not None or not (self.out / DEPTH).is_file():
            return found
        try:
            capture = self.capture
        except InputError:  # the images are missing, so the points have no colours
            capture = None
        return replace(found, pointmaps=read_depth(self.out / DEPTH, found, capture))

    @cached_property
    def cloud(self) -> PointCloud | None:
        """Point cloud in the base frame; None for a run without a map."""
        return read_cloud(self.out / CLOUD) if (self.out / CLOUD).is_file() else None

    @cached_property
    def scene(self) -> "SceneMap | None":
        """Map of the run in the base frame; None for a run without a map."""
        return load_map(self.out) if (self.out / MAP).is_file() else None

    @cached_property
    def measured(self) -> "Measurement | None":
        """Support plane and objects on it; None without a map or without a support plane."""
        from jcr.segments.measure import measure_objects

        try:
            return None if self.cloud is None else measure_objects(self.cloud, self.scale_std)
        except InputError:
            return None

    @cached_property
    def cameras(self) -> CamerasFile | None:
        """Content of cameras.json: calibration of the cell's other cameras; None without other cameras."""
        return read_cameras(self.out)

    @property
    def image_index(self) -> Int[ndarray, " m"]:
        """Indices in the capture, from 0, of the m images that the reconstruction registered."""
        return self.reconstruction.image_index

    @property
    def scale_std(self) -> float:
        """Standard deviation of the scale (metres per recon unit) divided by the scale; 0 if it is unknown."""
        uncertainty = self.calibration.uncertainty
        return 0.0 if uncertainty is None else uncertainty.scale_std_percent / 100

    def verify(
        self,
        images: Sequence[ArrayLike | Path | str],
        base_from_gripper: ArrayLike,
        *,
        joints: ArrayLike | None = None,
        name: str | None = None,
        **options: Any,
    ) -> "Verification":
        """Test with new images of the calibrated scene whether the camera has moved since, as `jcr verify` does.

        `images` are n RGB images (h,w,3) uint8 or their files, `base_from_gripper` (n,4,4) their gripper poses, `joints`
        (n,dof) the joint angles (rad), if known. `name` is the capture's name in the history; None: the time. `options`
        are further arguments of `verify_run`, which states the errors, too.
        """
        import jcr  # the test is a stage above this module

        new = jcr.NewImages.of(images, base_from_gripper, joints)
        return jcr.verify_run(self.out, {name or time.strftime("%Y-%m-%d %H:%M:%S"): new}, **options)

    def of_wrist_camera(self) -> tuple[Calibration | PublishedCalibration, Capture, Reconstruction]:
        """Return calibration, capture and reconstruction of a run with a camera on the gripper.

        Raises InputError if one is missing or damaged, if the calibration failed or is of a fixed camera, or if the
        three do not have the same images.
        """
        calibration = self.calibration
        if calibration.mount == "base":
            raise InputError(
                f"{self.out}: is for a camera that watches the gripper; this needs a camera on the gripper"
            )
        if isinstance(calibration, FailedCalibration):
            raise InputError(
                f"{self.out}: found no calibration ({calibration.doubt}); fix the capture, run it again"
            )
        capture = self.capture
        if [image.image for image in calibration.images] != list(capture.images):
            raise InputError(f"{capture.folder}: changed after {self.out}; run `jcr calibrate` again")
        reconstruction = self.reconstruction
        if len(calibration.images) <= reconstruction.image_index.max(initial=-1):
            raise InputError(
                f"{self.out / CALIBRATION}: names {len(calibration.images)} images and {RECONSTRUCTION} has more; "
                "run `jcr calibrate` or `jcr run` again"
            )
        return calibration, capture, reconstruction


def load_run(out: str | Path) -> RunResult:
    """Return the result of the run in the folder `out`; raise InputError if calibration.json is missing or damaged.

    A rejected result is returned, too, with its matrix: look at `converged` before you use it.
    """
    return RunResult(out, calibration=read_calibration(as_path(out, "out")))
