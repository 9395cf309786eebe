"""The records that flow from stage to stage, and nothing else.

Frames: `base`, `gripper`, `camera` (OpenCV optical: x right, y down, z forward), `recon` (arbitrary origin
and unit). Pixel (0, 0) is the *centre* of the top-left pixel, as in OpenCV. Metres and radians.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

LensModel = Literal["pinhole", "rational", "fisheye"]
COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Of each distortion, in OpenCV's order; ROS calls them plumb_bob, rational_polynomial and equidistant."""
Coefficients = (
    tuple[float, float, float, float]
    | tuple[float, float, float, float, float]
    | tuple[float, float, float, float, float, float, float, float]
)


def coefficients_of(values: Iterable[float]) -> Coefficients:
    """Four, five or eight numbers as a model has them."""
    return cast(Coefficients, tuple(float(value) for value in values))


@dataclass(frozen=True)
class Intrinsics:
    """A camera with one of OpenCV's distortions, in pixels of a `width` x `height` image."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)
    """As many coefficients as COEFFICIENTS has names for the model."""
    model: LensModel = "pinhole"

    @property
    def matrix(self) -> Float[ndarray, "3 3"]:
        """K (3,3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


Mount = Literal["gripper", "base"]
"""What a camera is bolted to: the gripper of an arm, or the ground that the arm's base stands on."""


@dataclass(frozen=True)
class CellCamera:
    """A further camera of the robot's cell, and its images."""

    name: str
    mount: Mount
    images: tuple[str, ...]
    """Paths relative to the folder."""
    image_size: tuple[int, int]
    intrinsics: Intrinsics | None = None
    intrinsics_std: Float[ndarray, " q"] | None = None
    folder: Path | None = None
    """None: the capture's."""
    frame: Int[ndarray, " k"] | None = None
    """Rows of the capture at whose gripper poses the images were taken: of a camera on the same gripper, or of a fixed
    one that watches what this gripper carries. None of others."""
    arm: str | None = None
    """The other arm that carries it; None: the capture's own, or none."""
    base_from_gripper: Float[ndarray, "k 4 4"] | None = None
    """Of the other arm, in its own base, at each image."""

    @property
    def watches_gripper(self) -> bool:
        """Whether it is fixed and sees what the gripper carries instead of the scene."""
        return self.mount == "base" and self.frame is not None


@dataclass(frozen=True)
class Capture:
    """Images of one scene and the gripper pose at each, checked on reading."""

    folder: Path
    images: tuple[str, ...]
    """Paths relative to `folder`; the names by which everything later speaks of an image."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    image_size: tuple[int, int]
    """Width, height in pixels after EXIF rotation; the same for all images."""
    intrinsics: Intrinsics | None = None
    """None: unknown, to be estimated."""
    intrinsics_std: Float[ndarray, " q"] | None = None
    """Standard deviations of the given ones, in the order of camera.parameters, not a number where one is not stated."""
    source: Path | None = None
    """What it was read from, where that is not a capture.json in `folder`."""
    cameras: Path | None = None
    """A COLMAP model or transforms.json that holds the cameras' poses already."""
    notes: tuple[str, ...] = ()
    """What reading found that the user should know: how files were paired, frames left out."""
    joints: Float[ndarray, "n dof"] | None = None
    """Joint angles (rad) at each image, from the base on; None: not recorded."""
    robot: str | None = None
    """Name of the arm, one of jcr.handeye.arms.ROBOT_NAMES."""
    urdf: Path | None = None
    """Of the arm, where it was given."""
    orientation: int = 1
    """EXIF's, of all images: 1 as the sensor has them; others were rotated upright, and the camera frame is theirs."""
    depths: tuple[str | None, ...] | None = None
    """Of a depth camera, an image each or None: 16-bit PNG in mm, aligned with the images, relative to `folder`."""
    camera_name: str = "wrist"
    mount: Mount = "gripper"
    """base: a fixed camera, and the images show what the gripper carries."""
    others: tuple[CellCamera, ...] = ()

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class PosePairs:
    """Gripper and camera poses of the same instants, the cameras found by somebody else: no image is needed."""

    source: Path
    images: tuple[str, ...]
    """Names of the samples."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    recon_from_camera: Float[ndarray, "n 4 4"]
    is_metric: bool
    """The cameras' unit is the metre, as with a marker of known size."""
    notes: tuple[str, ...] = ()
    backend: str = "poses given"

    def __len__(self) -> int:
        return len(self.images)

    @property
    def image_index(self) -> Int[ndarray, " n"]:
        """Rows of the samples with a camera pose: all, as in a Reconstruction that registered every image."""
        return np.arange(len(self))


@dataclass(frozen=True)
class Tracks:
    """Observations of common 3D points, for bundle adjustment, whatever back end made them."""

    image: Int[ndarray, " k"]
    """Row of the reconstruction (not of the capture) that each observation belongs to."""
    x_px: Float[ndarray, "k 2"]
    """In the capture's original image, distorted as the camera made it."""
    point: Int[ndarray, " k"]
    """Row of `points_in_recon`."""
    points_in_recon: Float[ndarray, "p 3"]
    from_pointmaps: bool = False
    """Matched between pointmaps, with errors that neighbours share, instead of found in the images."""


@dataclass(frozen=True)
class CameraEvidence:
    """What the images alone say of the cameras, and how surely; the robot was not asked."""

    recon_from_camera: Float[ndarray, "m 4 4"]
    covariance: Float[ndarray, "r r"]
    """Of steps of the cameras (geometry.retract, recon axes), camera by camera; r = 6m. The recon frame is that of one
    of the cameras, which is therefore exact."""


NO_DEPTH, MATCHED, PRIOR, BOTH = 0, 1, 2, 3
"""What a depth rests on: nothing; images that show the same (or a network's prediction); a plane that the colours
and the matched depths around it speak for; both."""


@dataclass(frozen=True)
class Reconstruction:
    """Camera poses and dense pointmaps in one frame, up to a similarity unless `is_metric`."""

    image_index: Int[ndarray, " m"]
    """Rows of the capture that were registered, ascending."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    intrinsics: Intrinsics
    """Of the capture's original images: given, or estimated by the back end."""
    pointmap_intrinsics: Intrinsics
    """The undistorted pinhole grid in which the pointmaps live (size W x H)."""
    points_in_recon: Float[ndarray, "m h w 3"]
    confidence: Float[ndarray, "m h w"]
    """At least 0; 0 means no estimate (the point may be anything, finite)."""
    colors: UInt8[ndarray, "m h w 3"]
    """RGB at the pointmap's pixels."""
    tracks: Tracks
    backend: str
    is_metric: bool = False
    """Whether the unit is meant to be the metre."""
    metric_std: float | None = None
    """How well its unit is known to be a metre, relative one sigma; None: nobody vouches for it."""
    notes: tuple[str, ...] = ()
    """What was done: images not registered, matches left out."""
    warnings: tuple[str, ...] = ()
    """What the user must act on: intrinsics that cannot be used, a gripper pose that the images contradict."""
    reason: UInt8[ndarray, "m h w"] | None = None
    """NO_DEPTH, MATCHED, PRIOR or BOTH; None: all that is known was matched or predicted."""
    depth_std: Float[ndarray, "m h w"] | None = None
    """One sigma of the depth (z) at the pixels, in recon units, 0 without depth; None: not known."""
    evidence: CameraEvidence | None = None
    """In the same frame, where the robot's poses were used for `recon_from_camera` or cameras err beside them."""


@dataclass(frozen=True)
class ImageVerdict:
    """What the calibration thinks of one image of the capture."""

    image: str
    used: bool
    reason: str | None
    """Why it was not used; None when it was."""
    translation_residual_mm: float | None
    rotation_residual_deg: float | None


@dataclass(frozen=True)
class Observability:
    """Which directions of (translation, rotation, scale) the motions can see."""

    observable: bool
    unobservable: tuple[str, ...]
    """In words, e.g. "scale: every view rotates about one point fixed to the gripper"."""
    advice: tuple[str, ...]
    """One remedy per unobservable direction."""


@dataclass(frozen=True)
class Excitation:
    """Principal directions of what the motions see, least seen first (handeye/observability.py)."""

    value: Float[ndarray, "7"]
    direction: Float[ndarray, "7 7"]
    """Rows; unit vectors of (translation in m, rotation times the arm there, log scale times `spread`)."""
    spread: float
    """Root mean square distance (m) of the camera centres from their mean."""


@dataclass(frozen=True)
class NextPose:
    """A gripper pose worth adding, and what is known with it and those before it."""

    base_from_gripper: Float[ndarray, "4 4"]
    expected_std: Float[ndarray, "7"]
    """In COVARIANCE_ORDER."""
    like: int
    """Row of the existing pose that it is nearest to."""
    moved_m: float
    turned_rad: float


@dataclass(frozen=True)
class RobotNoise:
    """One-sigma noise of the gripper poses per axis."""

    translation: float
    rotation: float
    estimated: bool
    given: tuple[float, float] | None = None
    """m, rad: what the user said of it; counted where the residuals say no more."""
    systematic: float = 0.0
    """rad: size of the systematic errors; of joint offsets where the arm is known, else of the gripper's rotation."""
    systematic_left: tuple[float, float] = (0.0, 0.0)
    """m, rad: systematic errors of these poses per axis, after the effective hand-eye transform took its part."""

    @property
    def together(self) -> tuple[float, float]:
        """m, rad: random and systematic errors of a gripper pose per axis."""
        metres, radians = np.hypot((self.translation, self.rotation), self.systematic_left)
        return float(metres), float(radians)


@dataclass(frozen=True)
class JointOffsets:
    """By how much each joint of the arm seems off."""

    offset: Float[ndarray, " dof"]
    """rad: true angle less the reported one."""
    std: Float[ndarray, " dof"]
    prior_std: float
    """rad: of any joint, before its own poses are asked."""


@dataclass(frozen=True)
class Budget:
    """What the covariance of a calibration comes from; in COVARIANCE_ORDER, and their sum is the covariance."""

    robot_random: Float[ndarray, "7 7"]
    robot_systematic: Float[ndarray, "7 7"]
    intrinsics: Float[ndarray, "7 7"]
    """What would go if they were known."""
    images: Float[ndarray, "7 7"]
    """Camera poses and features; and what is unobservable."""


@dataclass(frozen=True)
class HeldOut:
    """Error on images left out of the calibration: the number to believe."""

    translation_mm: float
    rotation_deg: float
    reprojection_px: float | None
    how: str


COVARIANCE_ORDER = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "log_scale")
"""The step (geometry.retract) that takes gripper_from_camera to the true one, in gripper axes: R_true = exp(r)·R;
relative scale error (scale_true = exp(s)·scale)."""


@dataclass(frozen=True)
class ScaleCheck:
    """The robot's metre against that of a metric network: an independent check of the scale."""

    off_percent: float
    """By how much the network's lengths are too long (negative: too short)."""
    std_percent: float
    """One-sigma uncertainty that the calibration leaves in that."""


@dataclass(frozen=True)
class DepthCheck:
    """A depth camera's lengths against the robot's, at features whose depth the images and the robot give."""

    off_percent: float
    """By how much its lengths are too long (negative: too short)."""
    std_percent: float
    """One-sigma uncertainty of that, the robot's own scale included."""
    noise_m: float
    noise_per_m: float
    """One sigma of a depth z, its scale corrected, is hypot(noise_m, noise_per_m · z²)."""
    distances_m: tuple[float, float]
    """Nearest and farthest of the features (5 % and 95 %): beyond, the noise is extrapolated."""
    images: int
    features: int

    def std_m(self, depth: Float[ndarray, "*any"] | float) -> Float[ndarray, "*any"] | float:
        """One sigma (m) of corrected depths (m), what is unknown of the scale included."""
        common = 0.01 * self.std_percent * depth
        return np.sqrt(self.noise_m**2 + (self.noise_per_m * depth**2) ** 2 + common**2)


@dataclass(frozen=True)
class Requirement:
    """How exact the camera on the gripper must be known, and how exact it is; 95 % of errors are smaller."""

    translation_mm: float
    rotation_deg: float
    asked: bool
    """By the user; else the default, for grasping."""
    distance_mm: float
    """Of the point that the translation is of, ahead of the camera; 0: the camera itself."""
    reached_mm: float
    reached_deg: float
    more_images: int | None = None
    """At the poses proposed, that would reach it; 0 where it is, None where no reasonable number does."""

    @property
    def is_met(self) -> bool:
        """Whether the errors are within what is required."""
        return self.reached_mm <= self.translation_mm and self.reached_deg <= self.rotation_deg


@dataclass(frozen=True)
class HandEye:
    """The calibration: where the camera sits on the gripper, the metric scale, and how far to trust both."""

    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    """Metres per unit of the reconstruction."""
    base_from_recon: Float[ndarray, "4 4"]
    """Rigid; maps recon coordinates *already multiplied by scale* to the base frame."""
    covariance: Float[ndarray, "7 7"]
    inliers: Bool[ndarray, " n"]
    """Per pose given to the solver."""
    translation_residual_m: Float[ndarray, " n"]
    """Per pose: distance from where the fit puts the gripper."""
    rotation_residual_rad: Float[ndarray, " n"]
    observability: Observability
    robot_noise: RobotNoise
    residual_translation: float
    """Mean δ_t in metres over consecutive used poses, as the paper defines it."""
    residual_rotation: float
    """Mean δ_R, Frobenius norm, likewise."""
    converged: bool
    warnings: tuple[str, ...] = ()
    intrinsics: Intrinsics | None = None
    """Refined by bundle adjustment; None when poses alone were given."""
    intrinsics_covariance: Float[ndarray, "q q"] | None = None
    """In the order of camera.parameters; None where they were not refined."""
    held_out: HeldOut | None = None
    reasons: tuple[str | None, ...] = ()
    """Per pose: why it was rejected, None when used."""
    reprojection_px: Float[ndarray, " n"] | None = None
    """Per pose: median reprojection error after bundle adjustment; NaN where it took no part."""
    scale_check: ScaleCheck | None = None
    """None where the reconstruction's unit is not meant to be the metre."""
    scale_from_robot_alone: bool = False
    """Neither a known length nor a depth camera took part."""
    lens_shift: Float[ndarray, "7"] | None = None
    """How far the intrinsics that the images show, in place of the one given, would move the answer; in
    COVARIANCE_ORDER,
    and in the covariance. None where nothing speaks against the intrinsics."""
    refinement: "Refinement | None" = None
    """None where camera poses alone decided."""
    systematic_p: float | None = None
    """Chance of residuals like these where the robot's errors are random alone."""
    joint_offsets: JointOffsets | None = None
    """None where the arm is not known."""
    angle_ratio: tuple[float, float] | None = None
    """Rotation angles between cameras over those between grippers, 1 whatever gripper_from_camera is, and its standard
    deviation."""
    budget: Budget | None = None
    """Of the covariance, without what `lens_shift` adds to it."""
    excitation: Excitation | None = None
    """Of the used poses by themselves; None where the solver was asked and not the calibration stage."""
    next_poses: tuple[NextPose, ...] = ()
    """Those that would shrink the reported uncertainty most; `like` counts the used poses."""
    depth_check: DepthCheck | None = None
    """None without depth images, or where too few features have a depth."""
    requirement: Requirement | None = None
    """None where the solver was asked and not the calibration stage."""


@dataclass(frozen=True)
class Refinement:
    """What the images' features changed of the fit to camera poses alone."""

    before: HandEye
    moved_m: float
    """Of the camera on the gripper."""
    turned_rad: float


@dataclass(frozen=True)
class Attempt:
    """What came of one back end that was tried."""

    backend: str
    images_registered: int | None
    """None where it failed."""
    reconstruct_s: float
    calibrate_s: float
    """0 where there was nothing to calibrate."""
    why_not: str | None
    """Why the run does not keep it; None where it does."""
    features: str | None = None
    """What was matched between images, where the back end has a choice."""


@dataclass(frozen=True)
class PointCloud:
    """Confident points in the base frame, with the rays that saw them."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    confidence: Float[ndarray, " n"]
    margin: Float[ndarray, " n"]
    """One-sigma position uncertainty (m) that the calibration leaves at the point."""
    label: Int[ndarray, " n"]
    """Segment; 0 = none."""
    image: Int[ndarray, " n"]
    """Row of `camera_centers_in_base`."""
    camera_centers_in_base: Float[ndarray, "m 3"]
    label_names: tuple[str, ...] = field(default=("none",))
    reason: UInt8[ndarray, " n"] | None = None
    """MATCHED, PRIOR or BOTH; None: no point is a prior."""
    depth_std: Float[ndarray, " n"] | None = None
    """One sigma (m) of the depth in its image; None: not known."""
    clears: Bool[ndarray, " n"] | None = None
    """Whether the way from the camera to the point counts as seen free; None: every one but to a PRIOR."""

    @property
    def cleared(self) -> Bool[ndarray, " n"]:
        """`clears`, with what None stands for."""
        if self.clears is not None:
            return self.clears
        return np.ones(len(self.image), bool) if self.reason is None else self.reason != PRIOR
