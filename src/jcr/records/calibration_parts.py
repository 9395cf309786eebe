"""Parts of the record of a calibration (calibration/record.py), in memory and in calibration.json.

In the file, arrays are lists, and lengths and angles have the unit that their key names.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import AfterValidator, Field, PlainSerializer, computed_field

from jcr.errors import InputError
from jcr.findings import Finding, unobservable
from jcr.records.capture import Intrinsics
from jcr.records.field_checks import Checked
from jcr.records.json_fields import (
    Covariance7,
    Matrix,
    Numbers,
    Numbers3,
    PartCovariance7,
    Spread,
    Square,
    in_json,
    in_unit,
)

Metres = Annotated[float, in_unit(1e3)]
"""Length (m); millimetres in files."""
Radians = Annotated[float, in_unit(180 / np.pi)]
"""Angle (rad); degrees in files."""


@dataclass(frozen=True, kw_only=True)
class ImageVerdict(Checked):
    """Verdict on one image of the capture: whether the calibration uses it, why not, and its residuals."""

    image: str
    """Path relative to the folder of the capture; for given camera poses, the name of the sample."""
    used: bool
    """Whether the calibration uses the image."""
    reason: str | None
    """Reason why the image is not used; None if it is."""
    translation_residual_mm: Spread | None = None
    """Distance between reported and predicted gripper position (mm); None for an image that is not registered."""
    rotation_residual_deg: Spread | None = None
    """Angle between reported and predicted gripper orientation (degrees); None for an image that is not registered."""
    reprojection_px: Spread | None = None
    """Median reprojection error (px); None for an image that was not adjusted."""


@dataclass(frozen=True)
class Observability:
    """Observability of the translation, rotation and scale of a calibration by the motions of the capture."""

    findings: Annotated[tuple[Finding, ...], Field(exclude=True)] = ()
    """Findings of kind UNOBSERVABLE, one for each direction that is unobservable, or nearly so."""

    @computed_field
    @property
    def observable(self) -> bool:
        """Whether every direction is observable; a direction that is nearly unobservable counts as observable."""
        return all("nearly" in finding.details for finding in self.findings)

    @computed_field
    @property
    def unobservable(self) -> tuple[str, ...]:
        """Unobservable directions in words, e.g. "scale: the camera only rotates about its own centre"."""
        return tuple(unobservable(finding) for finding in self.findings)

    @computed_field
    @property
    def advice(self) -> tuple[str, ...]:
        """Remedy of each unobservable direction, in the order of `unobservable`."""
        return tuple(finding.remedy for finding in self.findings)


@dataclass(frozen=True, kw_only=True)
class RobotNoise(Checked):
    """Robot errors: random noise of the gripper poses, one sigma per axis, and systematic errors."""

    translation: Annotated[Metres, Field(alias="translation_mm")]
    """Random noise of the position (m)."""
    rotation: Annotated[Radians, Field(alias="rotation_deg")]
    """Random noise of the orientation (rad)."""
    estimated: bool
    """Whether the random noise was estimated from the residuals; otherwise it is the given one."""
    given: Annotated[tuple[Metres, Radians] | None, Field(alias="given_mm_deg")] = None
    """Noise given by the user (m, rad), a lower bound on the random noise; None if none was given."""
    systematic: Annotated[Radians, Field(alias="systematic_deg")] = 0.0
    """Size (rad) of the systematic errors: of the joint offsets of a known arm, else of the gripper's rotation."""
    systematic_left: Annotated[tuple[Metres, Radians], Field(alias="systematic_left_mm_deg")] = (0.0, 0.0)
    """Systematic errors of the poses per axis (m, rad), without the part that the hand-eye transform absorbs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        sizes = self.translation, self.rotation, self.systematic, *self.systematic_left, *(self.given or ())
        if not all(np.isfinite(sizes)) or min(sizes) < 0:
            raise InputError("RobotNoise: an error that is negative or not finite; give standard deviations")

    @property
    def together(self) -> tuple[float, float]:
        """Standard deviation per axis (m, rad) of a gripper pose: random and remaining systematic error combined."""
        metres, radians = np.hypot((self.translation, self.rotation), self.systematic_left)
        return float(metres), float(radians)


@dataclass(frozen=True)
class JointOffsets(Checked):
    """Estimated offsets of the arm's joint angles, one for each joint, from the base to the gripper."""

    offset: Numbers
    """True minus reported joint angles (rad)."""
    std: Numbers
    """Standard deviations of the offsets (rad)."""
    prior_std: float
    """Standard deviation of a joint's offset in the prior (rad), the same for all joints."""


@dataclass(frozen=True, kw_only=True)
class Share(Checked):
    """Part of the uncertainty due to one cause: its covariance, and its standard deviations as the rms over the axes."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: PartCovariance7
    """Covariance in COVARIANCE_ORDER; the sum over all causes is the covariance of the calibration."""


def share_of(covariance: Float[ndarray, "7 7"]) -> Share:
    """Return the share of one cause, with standard deviations in mm and degrees, from its covariance."""
    metres, radians = np.sqrt(np.diag(covariance)[:6].reshape(2, 3).mean(1)).tolist()
    degrees = float(np.degrees(radians))
    return Share(translation_mm=1e3 * metres, rotation_deg=degrees, covariance=covariance)


_share = Annotated[
    Share | None,
    AfterValidator(lambda share: np.zeros((7, 7)) if share is None else share.covariance),
    PlainSerializer(share_of, return_type=Share),
]
PartOfBudget = Annotated[Float[ndarray, "7 7"], in_json(_share)]
"""Covariance of one cause in COVARIANCE_ORDER; in files a Share, where null is a covariance of 0."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Uncertainty budget: parts of a calibration's covariance by cause of error; their sum is the covariance."""

    robot_random: PartOfBudget
    """Part due to the random noise of the gripper poses."""
    robot_systematic: PartOfBudget
    """Part due to the systematic errors of the gripper poses."""
    intrinsics: PartOfBudget
    """Part that would vanish if the intrinsics were known exactly."""
    images: PartOfBudget
    """Part due to errors of camera poses and features, and to unobservable directions."""
    faults: PartOfBudget
    """Part due to findings: the shifts that they state, and differences from known lengths."""

    @property
    def main_part(self) -> str | None:
        """Name of the part that is at least half of the translation's variance; None if no part is."""
        variances = {name: float(np.trace(part[:3, :3])) for name, part in vars(self).items()}
        name = max(variances, key=variances.__getitem__)
        return name if 2 * variances[name] >= sum(variances.values()) else None


@dataclass(frozen=True)
class LeaveOneOut(Checked):
    """Mean leave-one-out error: difference of each reported gripper pose from its prediction by the other images."""

    translation_mm: Spread
    """Mean distance between predicted and reported gripper position."""
    rotation_deg: Spread
    """Mean angle between predicted and reported gripper orientation."""
    reprojection_px: Spread | None
    """Median reprojection error with the predicted poses (px); None if the images were not adjusted."""
    how: str
    """Method of the prediction, in words."""

    @property
    def length_m(self) -> float:
        """Translation and rotation error as one length (m): hypot of translation and 0.3 m times the rotation (rad)."""
        from jcr.geometry import ARM  # SciPy, which help need not wait for

        return float(np.hypot(1e-3 * self.translation_mm, ARM * np.radians(self.rotation_deg)))


COVARIANCE_ORDER = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "log_scale")
"""Errors whose covariance is stated: translation and rotation vector r of the step (geometry.retract, gripper axes) from
gripper_from_camera to the true one, R_true = exp(r)·R; and s of the scale, scale_true = exp(s)·scale."""


@dataclass(frozen=True, kw_only=True)
class DepthCheck(Checked):
    """Scale error and noise of a depth camera, measured at features whose depth the calibrated images determine."""

    off_percent: float
    """Relative error of measured depths (percent); positive: measured depths are too large."""
    std_percent: float
    """Standard deviation of `off_percent`, including that of the robot's scale."""
    noise_m: float
    """Constant part a of the noise (m): a depth z without its scale error has the standard deviation hypot(a, b·z²)."""
    noise_per_m: float
    """Factor b (1/m) of the noise that grows with z²."""
    distances_m: tuple[float, float]
    """5 % and 95 % quantile of the features' depths (m); beyond these the noise is extrapolated."""
    images: int
    """Number of depth images that were compared."""
    features: int
    """Number of features that were compared."""

    def std_m(self, depth: Float[ndarray, "*any"] | float) -> Float[ndarray, "*any"] | float:
        """Return the standard deviation (m) of depths z (m, along the optical axis) with corrected scale."""
        common = 0.01 * self.std_percent * depth
        return np.sqrt(self.noise_m**2 + (self.noise_per_m * depth**2) ** 2 + common**2)


@dataclass(frozen=True, kw_only=True)
class PointUncertainty(Checked):
    """Uncertainty of a point that the camera sees: bounds on 95 % of its errors, for exact gripper poses."""

    distance_mm: Spread
    """Distance of the point from the camera along its ray (mm)."""
    within_95_mm: Spread
    """Bound on the position error in three dimensions (mm)."""
    lateral_95_mm: Spread
    """Bound on the position error across the ray (mm)."""
    along_95_mm: Spread
    """Bound on the position error along the ray (mm), for an exact distance."""
    ray_95_deg: Spread
    """Bound on the error of the ray's direction (degrees)."""
    rotation_95_deg: Spread
    """Bound on the orientation error at the point (degrees), including the rotation about the ray."""


@dataclass(frozen=True, kw_only=True)
class PointUncertaintyOverImage(PointUncertainty):
    """Uncertainty of points at the median distance of the scene: at the image centre and at the worst corner."""

    corners: PointUncertainty
    """Point uncertainty at the worst corner of the image."""


@dataclass(frozen=True, kw_only=True)
class SceneUncertainty(Checked):
    """Uncertainty of the reconstructed scene in the base frame, with each point triangulated from all its images."""

    middle_in_base: Numbers3
    """Centre of the scene (m)."""
    covariance: PartCovariance7
    """Covariance of the scene's similarity about `middle_in_base`: m, rad (geometry.retract, base axes), log scale."""
    shape_m: Spread
    """Standard deviation per axis of a point's remaining error, the deformation of the scene (m)."""
    within_95_m: Spread
    """Bound on 95 % of the errors of the median point, including its triangulation (m)."""

    def covariance_at(self, x_in_base: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
        """Return the covariances (m², base axes) of n scene points (m, base frame), without triangulation errors."""
        from jcr.geometry import by_similarity  # SciPy, which help need not wait for

        by = by_similarity(x_in_base - self.middle_in_base)
        return by @ self.covariance @ np.swapaxes(by, 1, 2) + self.shape_m**2 * np.eye(3)


@dataclass(frozen=True, kw_only=True)
class GivenIntrinsicsResult(Checked):
    """Most likely transform, and its covariance, for a user who keeps the given instead of the estimated intrinsics."""

    gripper_from_camera: Matrix
    covariance: Covariance7
    """Covariance in COVARIANCE_ORDER, including the difference from the transform for the estimated intrinsics."""
    intrinsics: Intrinsics
    """Given intrinsics."""
    seen: PointUncertainty
    """Point uncertainty with the given intrinsics, including the effect of their errors."""
    differs_mm: Spread
    """Distance (mm) of one central point's positions by given and estimated intrinsics, each with its transform."""


@dataclass(frozen=True, kw_only=True)
class ModelError(Checked):
    """Camera-model error: distortion that the model cannot express, as a sum of e polynomials of the pixel."""

    likeliest: Numbers
    """Estimated coefficients (e), in image widths."""
    covariance: Square
    """Covariance of the coefficients (e,e)."""
    expressed: Square
    """Matrix (q,e): parameters (camera.parameters) that best fit each polynomial at the points of the images."""
    reach_px: Spread
    """Distance (px) from the principal point within which the images show points; beyond it, distortion is
    extrapolated."""


@dataclass(frozen=True, kw_only=True)
class JointCovariance(Checked):
    """Joint covariance of transform, scale and intrinsics, from which the uncertainty of any pixel's point follows."""

    covariance: Square
    """Covariance with rows and columns in `order`."""
    order: tuple[str, ...]
    """Names of the rows: COVARIANCE_ORDER, then fx, fy, cx, cy and the distortion."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.covariance.shape != 2 * (len(self.order),):
            raise InputError(f"a covariance that is not {len(self.order)} x {len(self.order)}")


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Uncertainty of transform, scale and intrinsics; axes of the gripper, or of the base for a fixed camera."""

    covariance: Covariance7
    """Covariance in COVARIANCE_ORDER."""
    budget: Budget | None = None
    """Parts of the covariance by cause of error; None if they are unknown."""
    joint: JointCovariance | None = None
    """Covariance with the intrinsics; None where the intrinsics were not estimated."""
    model_error: ModelError | None = None
    """Distortion that the model cannot express; None where the intrinsics were not estimated."""
    seen: PointUncertaintyOverImage | None = None
    """Point uncertainty at the working distance; None for the result of `solve_hand_eye`."""
    scene: SceneUncertainty | None = None
    """Uncertainty of the whole reconstruction in the base frame; None where no image was adjusted."""

    @computed_field
    @property
    def order(self) -> tuple[str, ...]:
        """Names of the rows of `covariance`: COVARIANCE_ORDER."""
        return COVARIANCE_ORDER

    @computed_field
    @property
    def translation_std_mm(self) -> list[float]:
        """Standard deviations of the translation's x, y and z (mm), along the axes of the covariance."""
        return (1e3 * self.std[:3]).tolist()

    @computed_field
    @property
    def rotation_std_deg(self) -> list[float]:
        """Standard deviations of the rotation vector's x, y and z (degrees), about the axes of the covariance."""
        return np.degrees(self.std[3:6]).tolist()

    @computed_field
    @property
    def scale_std_percent(self) -> float:
        """Relative standard deviation of the scale (percent)."""
        return float(100 * self.std[6])

    @computed_field
    @property
    def scene_95_mm(self) -> float | None:
        """Bound (mm) on 95 % of the errors of the median reconstructed point in the base frame."""
        return None if self.scene is None else 1e3 * self.scene.within_95_m

    @property
    def std(self) -> Float[ndarray, "7"]:
        """Standard deviations of translation (m), rotation vector (rad) and log scale, in COVARIANCE_ORDER."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def intrinsics_std(self) -> Float[ndarray, " q"] | None:
        """Standard deviations of fx, fy, cx, cy (px) and distortion; None where the intrinsics were not estimated."""
        return None if self.joint is None else np.sqrt(np.diag(self.joint.covariance)[7:])

    @property
    def whole(self) -> Float[ndarray, "j j"]:
        """Covariance of transform and scale in COVARIANCE_ORDER (j = 7), then of the intrinsics if estimated."""
        return self.covariance if self.joint is None else self.joint.covariance

    @property
    def corner(self) -> PointUncertainty | None:
        """Point uncertainty in the worst corner of the image; None where the intrinsics were not estimated."""
        return None if self.seen is None or self.joint is None else self.seen.corners

    def with_error(
        self, added: Float[ndarray, "k k"], cause: Literal["intrinsics", "faults"] = "faults"
    ) -> "Uncertainty":
        """Return the uncertainty after an independent error is added and attributed to `cause` in the budget.

        `added` is the covariance (k,k) of the error: k = 7 in COVARIANCE_ORDER, or as many rows as `joint` has.
        """
        joint, budget, of_transform = self.joint, self.budget, added[:7, :7]
        if joint is not None:
            together = joint.covariance.copy()
            together[: len(added), : len(added)] += added
            joint = replace(joint, covariance=together)
        if budget is not None:
            budget = replace(budget, **{cause: getattr(budget, cause) + of_transform})
        return replace(self, covariance=self.covariance + of_transform, joint=joint, budget=budget)


@dataclass(frozen=True)
class PaperResiduals(Checked):
    """Mean residuals of AX = XB, where A and B are gripper and camera motions between consecutive used images."""

    translation: Spread
    """Mean translation residual δ_t (m)."""
    rotation: Spread
    """Mean rotation residual δ_R, the Frobenius norm of a difference of rotation matrices."""


@dataclass(frozen=True, kw_only=True)
class LengthCheck(Checked):
    """Comparison of a known length, such as a board's size, with its value in the scale of the robot's positions."""

    name: Literal["robot", "board", "depth camera", "network"]
    """Source of the length; "robot": the robot's positions themselves, which no file contains."""
    robot_longer_percent: float
    """Length by the robot's positions minus stated length, in percent of the stated length."""
    std_percent: float
    """Standard deviation of the stated length in percent, without that of the robot."""
    used: bool = False
    """Whether the length is a prior of the scale; none is if two lengths contradict each other."""

    @property
    def off(self) -> float:
        """Logarithm of the ratio: length by the robot's positions over stated length."""
        return float(np.log1p(self.robot_longer_percent / 100))

    @property
    def std(self) -> float:
        """Relative standard deviation of the stated length."""
        return self.std_percent / 100


@dataclass(frozen=True, kw_only=True)
class Attempt(Checked):
    """One attempt to reconstruct and calibrate a capture with one back end: registered images, failure and times."""

    backend: str
    images_registered: int | None
    """Number of registered images; None if the back end failed."""
    reconstruct_s: Spread
    """Time of the reconstruction (s)."""
    calibrate_s: Spread
    """Time of the calibration (s); 0 if the back end failed."""
    why_not: str | None
    """Reason why the run does not keep this attempt; None if it does."""
    features: str | None = None
    """Features that were matched between images; None for back ends without a choice of features."""
