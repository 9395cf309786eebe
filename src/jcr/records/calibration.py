"""Where the camera sits on the gripper, how well that is known, and what was found on the way."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.records.capture import Intrinsics


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
