"""State of a calibration, with its uncertainty, and the records that it is made of."""

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.findings import (
    Finding,
    FindingKind,
    Verdict,
    doubt_of,
    remedy,
    strongest_first,
    verdict_of,
    warnings_of,
)
from jcr.findings.requirement import Requirement
from jcr.findings.sentences import unobservable
from jcr.records.capture import Intrinsics


@dataclass(frozen=True, kw_only=True)
class ImageVerdict:
    """Use and residuals of one image of the capture."""

    image: str
    used: bool
    reason: str | None
    """Why it was not used; None when it was."""
    translation_residual_mm: float | None = None
    rotation_residual_deg: float | None = None
    reprojection_px: float | None = None
    """Median reprojection error."""


@dataclass(frozen=True)
class Observability:
    """Directions of (translation, rotation, scale) that the motions determine."""

    findings: tuple[Finding, ...] = ()
    """One of kind UNOBSERVABLE per direction that is unobservable, or nearly so."""

    @property
    def observable(self) -> bool:
        """Whether every direction is observed, however weakly."""
        return all("nearly" in finding.details for finding in self.findings)

    @property
    def unobservable(self) -> tuple[str, ...]:
        """Unobservable directions in words, e.g. "scale: every view rotates about one point fixed to the gripper"."""
        return tuple(unobservable(finding) for finding in self.findings)

    @property
    def advice(self) -> tuple[str, ...]:
        """One remedy per unobservable direction."""
        return tuple(remedy(finding) for finding in self.findings)


@dataclass(frozen=True)
class Excitation:
    """Principal directions of the excitation by the motions, the weakest first (estimation/observability.py)."""

    value: Float[ndarray, "7"]
    direction: Float[ndarray, "7 7"]
    """Rows; unit vectors of (translation in m, rotation times the arm there, log scale times `spread`)."""
    spread: float
    """Root mean square distance (m) of the camera centres from their mean."""


@dataclass(frozen=True, kw_only=True)
class NextPose:
    """Gripper pose to add, and the expected accuracy of a calibration with it and those before it."""

    base_from_gripper: Float[ndarray, "4 4"]
    expected_std: Float[ndarray, "7"]
    """One standard deviation of each unknown once this pose is added, in COVARIANCE_ORDER."""
    within_95_mm: float
    """Distance that 95 % of the errors of a seen point stay below, as Seen has it."""
    rotation_95_deg: float
    """Bound on 95 % of the errors of directions there."""
    like: int
    """Row of the existing pose that it is nearest to."""
    moved_m: float
    """Distance of the gripper's origin from there (m)."""
    rotation_rad: float
    """Angle of the rotation from there (rad)."""


@dataclass(frozen=True, kw_only=True)
class RobotNoise:
    """One-sigma noise of the gripper poses per axis."""

    translation: float
    rotation: float
    estimated: bool
    given: tuple[float, float] | None = None
    """m, rad: what the user gave; used where the residuals determine no more."""
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
    """Estimated offset of each joint of the arm."""

    offset: Float[ndarray, " dof"]
    """rad: true angle less the reported one."""
    std: Float[ndarray, " dof"]
    prior_std: float
    """rad: of any joint, before its own poses are asked."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Parts of the covariance of a calibration, by cause, in COVARIANCE_ORDER; their sum is the covariance."""

    robot_random: Float[ndarray, "7 7"]
    robot_systematic: Float[ndarray, "7 7"]
    intrinsics: Float[ndarray, "7 7"]
    """Part that would vanish if the intrinsics were known."""
    images: Float[ndarray, "7 7"]
    """Camera poses and features; and what is unobservable."""
    faults: Float[ndarray, "7 7"]
    """Part that findings and their uncertainty add."""

    @property
    def mostly_systematic(self) -> bool:
        """Whether systematic robot errors, which more images leave, are most of the translation's variance."""
        others = self.robot_random, self.intrinsics, self.images, self.faults
        return bool(np.trace(self.robot_systematic[:3, :3]) >= sum(np.trace(part[:3, :3]) for part in others))


@dataclass(frozen=True)
class LeaveOneOut:
    """Leave-one-out error: prediction of each image's gripper pose from the others."""

    translation_mm: float
    rotation_deg: float
    reprojection_px: float | None
    how: str

    @property
    def length_m(self) -> float:
        """Both errors as one length, by which calibrations can be compared."""
        from jcr.geometry import ARM  # SciPy, which help need not wait for

        return float(np.hypot(1e-3 * self.translation_mm, ARM * np.radians(self.rotation_deg)))


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


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Point uncertainty: bounds on 95 % of the errors of a point that the camera sees."""

    distance_mm: float
    """Distance of the point from the camera along its ray (mm)."""
    within_95_mm: float
    """Distance of the point from where it is, in three dimensions."""
    lateral_95_mm: float
    """Across the ray."""
    along_95_mm: float
    """95 % bound of the error along the ray (mm), for a distance that was measured in the reconstruction."""
    ray_95_deg: float
    """Direction of the ray."""
    rotation_95_deg: float
    """Bound on directions there, the rotation about the ray included."""


@dataclass(frozen=True, kw_only=True)
class SceneUncertainty:
    """Uncertainty of the reconstructed scene in the base frame, every point by all images that see it."""

    middle_in_base: Float[ndarray, "3"]
    covariance: Float[ndarray, "7 7"]
    """Covariance of steps of the scene as a whole (geometry.retract) about its middle, along axes of the base, and
    of the logarithm of its size."""
    shape_m: float
    """One sigma per axis of what else moves a point: the scene is bent."""
    within_95_m: float
    """Distance that 95 % of a point's errors stay below, the median point; its own triangulation included."""

    def covariance_at(self, x_in_base: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
        """Return the covariances of points (m²), without their own triangulation."""
        from jcr.geometry import by_similarity  # SciPy, which help need not wait for

        by = by_similarity(x_in_base - self.middle_in_base)
        return by @ self.covariance @ np.swapaxes(by, 1, 2) + self.shape_m**2 * np.eye(3)


@dataclass(frozen=True, kw_only=True)
class InUse:
    """Point uncertainty by intrinsics, transform and scale together, without the robot's own pose errors."""

    seen: Seen
    """Uncertainty of a point at the centre of the image, at the median distance of the scene."""
    corners: Seen
    """Uncertainty of a point at the worst corner of the image."""
    scene: SceneUncertainty | None = None
    """None where no image was adjusted."""


@dataclass(frozen=True, kw_only=True)
class WithGivenIntrinsics:
    """Transform for the intrinsics that were given: the likeliest one where these are exact."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "7 7"]
    """Covariance in COVARIANCE_ORDER, with the distance from the transform of the estimated intrinsics."""
    intrinsics: Intrinsics
    seen: Seen
    """Uncertainty of a seen point with these intrinsics, what they place wrongly included."""
    differs_mm: float
    """Distance between the places of a point at the image centre by the two pairs (mm)."""


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """Distortion beyond the model: polynomials over the image, in its widths (estimation/intrinsics_prior.py)."""

    likeliest: Float[ndarray, " e"]
    covariance: Float[ndarray, "e e"]
    expressed: Float[ndarray, "q e"]
    """By how much the parameters (camera.parameters) express each polynomial where the images have points."""


AnyEstimate = TypeVar("AnyEstimate", bound="Estimate")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimated transform, scale and intrinsics, with their covariances."""

    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    """Metres per unit of the reconstruction."""
    base_from_recon: Float[ndarray, "4 4"]
    """Rigid; maps recon coordinates *already multiplied by scale* to the base frame."""
    covariance: Float[ndarray, "7 7"]
    """Covariance of the estimate, in COVARIANCE_ORDER."""
    budget: Budget | None = None
    """Parts of the covariance; None where it was not divided."""
    intrinsics: Intrinsics | None = None
    """Refined by bundle adjustment; None when poses alone were given."""
    intrinsics_covariance: Float[ndarray, "q q"] | None = None
    """Covariance of the intrinsics in the order of camera.parameters; None where they were not refined."""
    intrinsics_cross: Float[ndarray, "7 q"] | None = None
    """Covariance of COVARIANCE_ORDER (rows) with camera.parameters (columns); None where these were not refined."""
    model_error: ModelError | None = None
    """None where the intrinsics were not refined."""

    @property
    def intrinsics_std(self) -> Float[ndarray, " q"] | None:
        """Standard deviation of each parameter, in the same order."""
        known = self.intrinsics_covariance
        return None if known is None else np.sqrt(np.diag(known))

    def with_fault(self: AnyEstimate, covariance: Float[ndarray, "7 7"]) -> AnyEstimate:
        """Return the estimate, as uncertain as a fault with this covariance makes it."""
        budget = None if self.budget is None else replace(self.budget, faults=self.budget.faults + covariance)
        return replace(self, covariance=self.covariance + covariance, budget=budget)

    def with_finding(self: AnyEstimate, finding: Finding) -> AnyEstimate:
        """Return the estimate, as uncertain as the shifts of a finding make transform and intrinsics."""
        cross, known = self.intrinsics_cross, self.intrinsics_covariance
        if finding.intrinsics_shift is not None and cross is not None and known is not None:
            shift, moved = np.array(finding.shift), np.array(finding.intrinsics_shift)
            cross, known = cross + np.outer(shift, moved), known + np.outer(moved, moved)
        faulty = self.with_fault(finding.covariance)
        return replace(faulty, intrinsics_cross=cross, intrinsics_covariance=known)


@dataclass(frozen=True)
class PaperResiduals:
    """Residuals of consecutive used poses, as the paper defines them."""

    translation: float
    """Mean δ_t (m)."""
    rotation: float
    """Mean δ_R, Frobenius norm."""


LengthName = Literal["board", "known length", "depth camera", "network"]


@dataclass(frozen=True, kw_only=True)
class LengthCheck:
    """A length beside the robot's positions, compared with them."""

    name: LengthName
    robot_longer_percent: float
    """By how much it is longer by the robot's positions than as stated (negative: shorter)."""
    std_percent: float
    """One sigma of its own, the robot's not counted."""
    used: bool
    """Whether it is part of the scale; not where two lengths contradict each other."""


@dataclass(frozen=True, kw_only=True)
class BoardFound:
    """A board, or the tags of one `--board`, in the adjusted images."""

    spec: str
    bodies: int
    """1 for a board."""
    images: int
    corners: int
    side_mm: float
    """Side of a square or tag (mm) by the robot's positions alone."""
    side_std_mm: float
    stated_mm: float | None
    """None: unknown."""
    rms_px: float
    """Root mean square of the corners' reprojection errors, per axis (px)."""
    bend_mm: float
    """Between the lowest and the highest corner beside the plane; the largest of all bodies."""
    centres_in_base: tuple[tuple[float, float, float], ...]
    """Centres of the bodies in the base frame (m)."""
    tilts_deg: tuple[float, ...]
    """Angles of the bodies from the base's horizontal plane."""
    shape_mm: tuple[tuple[float, float, float], ...] = ()
    """Corners of the body that bends most: x and y on the body, and height above its plane, by the robot's positions."""


@dataclass(frozen=True, kw_only=True)
class HandEye(Estimate):
    """Numerical state of a calibration as it passes through fit, bundle adjustment and checks."""

    inliers: Bool[ndarray, " n"]
    """Whether each pose that the solver was given is used."""
    translation_residual_m: Float[ndarray, " n"]
    """Distance of each gripper from where the fit puts it."""
    rotation_residual_rad: Float[ndarray, " n"]
    reasons: tuple[str | None, ...] = ()
    """Why each pose was rejected, None where it is used."""
    reprojection_px: Float[ndarray, " n"] | None = None
    """Median reprojection error after bundle adjustment; NaN of images that took no part."""
    residuals: PaperResiduals = PaperResiduals(0.0, 0.0)
    robot_noise: RobotNoise
    joint_offsets: JointOffsets | None = None
    """None where the arm is not known."""
    leave_one_out: LeaveOneOut | None = None
    network: ScaleCheck | None = None
    """None where the reconstruction's unit is not meant to be the metre."""
    depth: DepthCheck | None = None
    """None without depth images, or where too few features have a depth."""
    lengths: tuple[LengthCheck, ...] = ()
    """Every length that was compared with the robot's positions."""
    board: BoardFound | None = None
    """None where no board took part beside features."""
    excitation: Excitation | None = None
    """Excitation by the used poses."""
    next_poses: tuple[NextPose, ...] = ()
    """Gripper poses that would shrink the reported uncertainty most; `like` counts the used poses."""
    requirement: Requirement | None = None
    """Required and reached accuracy; None of a fit outside the stage calibrate."""
    in_use: InUse | None = None
    """Point uncertainty; None of a fit outside the stage calibrate."""
    with_given_intrinsics: WithGivenIntrinsics | None = None
    """None where no intrinsics were given, or they were not estimated beside that."""
    before: "HandEye | None" = None
    """The fit to camera poses alone; None where that decided."""
    findings: tuple[Finding, ...] = ()
    """Findings, strongest first; of the same severity causes before consequences."""

    def with_findings(self, *findings: Finding) -> "HandEye":
        """Return the calibration with more findings, ordered from strongest to weakest."""
        return replace(self, findings=strongest_first((*self.findings, *findings)))

    @property
    def verdict(self) -> Verdict:
        """Verdict of the worst finding."""
        return verdict_of(self.findings)

    @property
    def converged(self) -> bool:
        """Whether it is accepted."""
        return self.verdict != "rejected"

    @property
    def doubt(self) -> str | None:
        """Reason of the rejection in words; None where it is accepted."""
        return doubt_of(self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings that reject or warn, in words."""
        return warnings_of(self.findings)

    @property
    def observability(self) -> Observability:
        """Directions that the motions determine."""
        return Observability(tuple(one for one in self.findings if one.kind is FindingKind.UNOBSERVABLE))

    @property
    def is_sound(self) -> bool:
        """Whether nothing but an unmet requirement rejects it: other stages can build on it."""
        return (
            verdict_of(one for one in self.findings if one.kind is not FindingKind.NOT_EXACT_ENOUGH)
            != "rejected"
        )


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Attempt with one back end."""

    backend: str
    images_registered: int | None
    """None where it failed."""
    reconstruct_s: float
    calibrate_s: float
    """0 where there was nothing to calibrate."""
    why_not: str | None
    """Reason why the run does not keep it; None where it does."""
    features: str | None = None
    """Features that were matched between images, where the back end has a choice."""
