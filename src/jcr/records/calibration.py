"""Parts of the record of a calibration (calibration/record.py), each as it is in memory and in calibration.json.

Arrays are lists in the file, and lengths and angles have the unit that their key states.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import AfterValidator, Field, PlainSerializer, computed_field, model_validator

from jcr.findings import Finding, remedy, unobservable
from jcr.records.capture import Intrinsics
from jcr.records.json_fields import (
    Covariance7,
    Matrix,
    Numbers,
    Numbers3,
    Numbers7,
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
class ImageVerdict:
    """Use and residuals of one image of the capture."""

    image: str
    """Path relative to the folder of the capture; the name of the sample where poses were given."""
    used: bool
    reason: str | None
    """Why it was not used; None when it was."""
    translation_residual_mm: float | None = None
    """Distance of the reported gripper from where the fit puts it (mm); None of an image that is not registered."""
    rotation_residual_deg: float | None = None
    """Angle of the reported gripper from where the fit puts it (degrees)."""
    reprojection_px: float | None = None
    """Median reprojection error (px); None of an image that was not adjusted."""


@dataclass(frozen=True)
class Observability:
    """Directions of (translation, rotation, scale) that the motions determine."""

    findings: Annotated[tuple[Finding, ...], Field(exclude=True)] = ()
    """One of kind UNOBSERVABLE per direction that is unobservable, or nearly so."""

    @computed_field
    @property
    def observable(self) -> bool:
        """Whether every direction is observed, however weakly."""
        return all("nearly" in finding.details for finding in self.findings)

    @computed_field
    @property
    def unobservable(self) -> tuple[str, ...]:
        """Unobservable directions in words, e.g. "scale: every view rotates about one point fixed to the gripper"."""
        return tuple(unobservable(finding) for finding in self.findings)

    @computed_field
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

    base_from_gripper: Matrix
    like: str
    """Image whose gripper pose is the nearest to it."""
    expected_std: Numbers7
    """One standard deviation of each unknown once this pose is added, in COVARIANCE_ORDER."""
    within_95_mm: Spread
    """Bound on 95 % of the errors of a seen point (mm), as Seen has it."""
    rotation_95_deg: Spread
    """Bound on 95 % of the errors of directions there."""
    moved_m: Annotated[Metres, Field(alias="moved_mm")] = 0.0
    """Distance of the gripper's origin from its place at `like` (m)."""
    rotation_rad: Annotated[Radians, Field(alias="rotated_deg")] = 0.0
    """Angle of the rotation from that pose (rad)."""


@dataclass(frozen=True, kw_only=True)
class RobotNoise:
    """One-sigma noise of the gripper poses per axis."""

    translation: Annotated[Metres, Field(alias="translation_mm")]
    rotation: Annotated[Radians, Field(alias="rotation_deg")]
    estimated: bool
    given: Annotated[tuple[Metres, Radians] | None, Field(alias="given_mm_deg")] = None
    """m, rad: what the user gave; used where the residuals determine no more."""
    systematic: Annotated[Radians, Field(alias="systematic_deg")] = 0.0
    """rad: size of the systematic errors; of joint offsets where the arm is known, else of the gripper's rotation."""
    systematic_left: Annotated[tuple[Metres, Radians], Field(alias="systematic_left_mm_deg")] = (0.0, 0.0)
    """m, rad: systematic errors of these poses per axis, after the effective hand-eye transform took its part."""

    @property
    def together(self) -> tuple[float, float]:
        """m, rad: random and systematic errors of a gripper pose per axis."""
        metres, radians = np.hypot((self.translation, self.rotation), self.systematic_left)
        return float(metres), float(radians)


@dataclass(frozen=True)
class JointOffsets:
    """Estimated offset of each joint of the arm, from the base on."""

    offset: Numbers
    """rad: true angle less the reported one."""
    std: Numbers
    """rad."""
    prior_std: float
    """rad: of any joint, before its own poses are asked."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """Part of the uncertainty: one sigma, root mean square over the axes; squares of the parts add up to the whole."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: PartCovariance7
    """Covariance in the order of `uncertainty`; the parts' sum is the whole."""


def share_of(covariance: Float[ndarray, "7 7"]) -> Share:
    """Return a part of the covariance with its size."""
    metres, radians = np.sqrt(np.diag(covariance)[:6].reshape(2, 3).mean(1)).tolist()
    degrees = float(np.degrees(radians))
    return Share(translation_mm=1e3 * metres, rotation_deg=degrees, covariance=covariance)


def _covariance_of(share: Share | None) -> Float[ndarray, "7 7"]:
    return np.zeros((7, 7)) if share is None else share.covariance


_share = Annotated[Share | None, AfterValidator(_covariance_of), PlainSerializer(share_of, return_type=Share)]
PartOfBudget = Annotated[Float[ndarray, "7 7"], in_json(_share)]
"""Covariance in COVARIANCE_ORDER; in files a Share."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Parts of the covariance of a calibration, by cause, in COVARIANCE_ORDER; their sum is the covariance."""

    robot_random: PartOfBudget
    robot_systematic: PartOfBudget
    intrinsics: PartOfBudget
    """Part that would vanish if the intrinsics were known."""
    images: PartOfBudget
    """Camera poses and features; and what is unobservable."""
    faults: PartOfBudget
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
    """Point uncertainty: bounds on 95 % of the errors of a point that the camera sees, exact gripper poses assumed."""

    distance_mm: Spread
    """Distance of the point from the camera along its ray (mm)."""
    within_95_mm: Spread
    """Distance of the point from where it is, in three dimensions."""
    lateral_95_mm: Spread
    """Across the ray."""
    along_95_mm: Spread
    """95 % bound of the error along the ray (mm), for a distance that was measured in the reconstruction."""
    ray_95_deg: Spread
    """Direction of the ray."""
    rotation_95_deg: Spread
    """Bound on directions there, the rotation about the ray included."""


@dataclass(frozen=True, kw_only=True)
class SeenAndCorners(Seen):
    """Point uncertainty at the centre of the image, at the median distance of the scene, and at its worst corner."""

    corners: Seen


@dataclass(frozen=True, kw_only=True)
class SceneUncertainty:
    """Uncertainty of the reconstructed scene in the base frame, every point by all images that see it."""

    middle_in_base: Numbers3
    """Middle of the scene (m)."""
    covariance: PartCovariance7
    """Covariance of steps of the scene as a whole (geometry.retract) about its middle, along axes of the base, and
    of the logarithm of its size."""
    shape_m: Spread
    """One sigma per axis of what else moves a point: the scene is bent."""
    within_95_m: Spread
    """Distance that 95 % of a point's errors stay below, the median point; its own triangulation included."""

    def covariance_at(self, x_in_base: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
        """Return the covariances of points (m²), without their own triangulation."""
        from jcr.geometry import by_similarity  # SciPy, which help need not wait for

        by = by_similarity(x_in_base - self.middle_in_base)
        return by @ self.covariance @ np.swapaxes(by, 1, 2) + self.shape_m**2 * np.eye(3)


@dataclass(frozen=True, kw_only=True)
class WithGivenIntrinsics:
    """Transform for the intrinsics that were given: the likeliest one where these are exact."""

    gripper_from_camera: Matrix
    covariance: Covariance7
    """Covariance in COVARIANCE_ORDER, with the distance from the transform of the estimated intrinsics."""
    intrinsics: Intrinsics
    seen: Seen
    """Uncertainty of a seen point with these intrinsics, what they place wrongly included."""
    differs_mm: Spread
    """Distance between the places of a point at the image centre by the two pairs (mm)."""


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """Distortion beyond the model: polynomials over the image, in its widths (estimation/intrinsics_prior.py)."""

    likeliest: Numbers
    covariance: Square
    expressed: Square
    """By how much the parameters (camera.parameters) express each polynomial where the images have points, (q,e)."""


@dataclass(frozen=True, kw_only=True)
class JointCovariance:
    """Covariance of transform, scale and intrinsics together, from which the uncertainty of any point follows."""

    covariance: Square
    order: tuple[str, ...]
    """Names of the rows: COVARIANCE_ORDER, then fx, fy, cx, cy and the distortion."""

    @model_validator(mode="after")
    def _is_square(self) -> "JointCovariance":
        if self.covariance.shape != 2 * (len(self.order),):
            raise ValueError(f"a covariance that is not {len(self.order)} x {len(self.order)}")
        return self


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """One-sigma uncertainty of transform, scale and intrinsics; axes of the gripper, of the base for a fixed camera."""

    covariance: Covariance7
    """Covariance in COVARIANCE_ORDER."""
    budget: Budget | None = None
    """Parts of the covariance by cause; None where it was not divided."""
    joint: JointCovariance | None = None
    """None where the intrinsics were not estimated."""
    model_error: ModelError | None = None
    """Distortion that the model cannot express; None where the intrinsics were not estimated."""
    seen: SeenAndCorners | None = None
    """Point uncertainty at the working distance; None of a fit outside the stage calibrate."""
    scene: SceneUncertainty | None = None
    """Uncertainty of the whole reconstruction in the base frame; None where no image was adjusted."""

    @computed_field
    @property
    def order(self) -> tuple[str, ...]:
        """Names of the rows of the covariance."""
        return COVARIANCE_ORDER

    @computed_field
    @property
    def translation_std_mm(self) -> list[float]:
        """Standard deviations of the translation (mm)."""
        return (1e3 * self.std[:3]).tolist()

    @computed_field
    @property
    def rotation_std_deg(self) -> list[float]:
        """Standard deviations of the rotation vector (degrees)."""
        return np.degrees(self.std[3:6]).tolist()

    @computed_field
    @property
    def scale_std_percent(self) -> float:
        """Relative standard deviation of the scale (percent)."""
        return float(100 * self.std[6])

    @computed_field
    @property
    def scene_95_mm(self) -> float | None:
        """Bound on 95 % of the errors of reconstructed points in the base frame (mm), at the median point."""
        return None if self.scene is None else 1e3 * self.scene.within_95_m

    @property
    def std(self) -> Float[ndarray, "7"]:
        """Standard deviations in COVARIANCE_ORDER."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def intrinsics_std(self) -> Float[ndarray, " q"] | None:
        """Standard deviation of each parameter of the intrinsics; None where they were not estimated."""
        return None if self.joint is None else np.sqrt(np.diag(self.joint.covariance)[7:])

    @property
    def whole(self) -> Float[ndarray, "j j"]:
        """Covariance of COVARIANCE_ORDER and, where they were estimated, of the intrinsics."""
        return self.covariance if self.joint is None else self.joint.covariance

    @property
    def corner(self) -> Seen | None:
        """Point uncertainty in the worst corner of the image; None where the intrinsics were not estimated."""
        return None if self.seen is None or self.joint is None else self.seen.corners

    def with_error(
        self, added: Float[ndarray, "k k"], cause: Literal["intrinsics", "faults"] = "faults"
    ) -> "Uncertainty":
        """Return the uncertainty with another error, whose covariance has 7 rows or those of `joint`."""
        joint, budget, of_transform = self.joint, self.budget, added[:7, :7]
        if joint is not None:
            together = joint.covariance.copy()
            together[: len(added), : len(added)] += added
            joint = replace(joint, covariance=together)
        if budget is not None:
            budget = replace(budget, **{cause: getattr(budget, cause) + of_transform})
        return replace(self, covariance=self.covariance + of_transform, joint=joint, budget=budget)


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
