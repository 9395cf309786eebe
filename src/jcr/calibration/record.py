"""Calibration: the result of a hand-eye calibration, in memory and as the file calibration.json."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from jcr.camera import parameter_names
from jcr.capture.plain_files import first_fault, read_json, shown
from jcr.errors import InputError, RejectedError
from jcr.estimation.point_uncertainty import joint_covariance, point_in_base
from jcr.files import write_text
from jcr.findings import (
    Finding,
    FindingKind,
    Verdict,
    doubt_of,
    remedy,
    sentence,
    strongest_first,
    text,
    verdict_of,
    warnings_of,
    without_consequences,
)
from jcr.findings.sentences import worst_direction
from jcr.geometry import Similarity, rotation_log
from jcr.records import (
    COVARIANCE_ORDER,
    Attempt,
    BoardFound,
    Capture,
    DepthCheck,
    Estimate,
    HandEye,
    ImageVerdict,
    InUse,
    LeaveOneOut,
    LengthCheck,
    ModelError,
    Mount,
    PaperResiduals,
    PosePairs,
    Reconstruction,
    Requirement,
    RobotNoise,
    ScaleCheck,
    Seen,
)
from jcr.records.json_fields import (
    Covariance7,
    IntrinsicsAndStd,
    IntrinsicsJson,
    Matrix,
    Numbers,
    Numbers3,
    Numbers7,
    Part,
    PartCovariance7,
    Positive,
    Spread,
    Spread3,
    Square,
)
from jcr.records.notebook import table

FORMAT = "jcr.calibration/2"
OF_HAND_EYE = ("scale", "residuals", "observability", "requirement", "with_given_intrinsics")
"""Fields that a HandEye has by the same names."""
NAMES = {
    "gripper": ("gripper_from_camera", "base_from_recon"),
    "base": ("base_from_camera", "gripper_from_object"),
}
"""Keys of the file for the camera and for the reconstruction, by what the camera is mounted on."""


def as_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as files have it: its fields, its text and its remedy."""
    return vars(finding) | {"text": text(finding), "remedy": remedy(finding)}


def _without_words(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    numbers = {name: part for name, part in value.items() if name not in ("text", "remedy")}
    try:
        # As JSON again: there, and not among Python's values, a dict may stand for a record and a list for a tuple.
        return _FINDING.validate_json(json.dumps(numbers), strict=True)
    except ValidationError as error:
        raise ValueError(first_fault(error)) from None


_FINDING = TypeAdapter(Finding)
FindingJson = Annotated[Finding, BeforeValidator(_without_words), PlainSerializer(as_json)]
"""Finding with its text and remedy, which are for people and made again when it is read."""


def derived(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the fields of a file that hold findings, strongest first."""
    verdict = verdict_of(findings)
    return {
        "findings": list(findings),
        "verdict": verdict,
        "converged": verdict != "rejected",
        "warnings": list(warnings_of(findings)),
    }


def require_one_verdict(findings: Sequence[Finding], verdict: Verdict, converged: bool) -> None:
    """Raise ValueError where the verdict contradicts the findings."""
    if verdict != verdict_of(findings) or converged is (verdict == "rejected"):
        raise ValueError("converged, verdict and findings contradict one another")


def mm_and_deg(metres: float, radians: float) -> dict[str, float]:
    """Return a translation and a rotation in the units of the file."""
    return {"translation_mm": 1e3 * float(metres), "rotation_deg": float(np.degrees(radians))}


def _order(names: list[str]) -> list[str]:
    if tuple(names) != COVARIANCE_ORDER:
        raise ValueError(f"not {', '.join(COVARIANCE_ORDER)}")
    return names


class Share(Part):
    """Part of the uncertainty: one sigma, root mean square over the axes; squares of the parts add up to the whole."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: PartCovariance7 | None = None
    """Covariance in the order of `uncertainty`; the parts' sum is the whole."""

    @classmethod
    def of(cls, covariance: Float[ndarray, "7 7"]) -> "Share":
        """Return the size of a part of the covariance, without the negative rounding that degenerate motions leave."""
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        values, vectors = np.linalg.eigh(covariance / np.outer(*[np.where(std > 0, std, np.inf)] * 2))
        covariance = (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(std, std)
        metres, radians = np.sqrt((std[:6] ** 2).reshape(2, 3).mean(1))
        return cls(**mm_and_deg(metres, radians), covariance=covariance)


class UncertaintyBudget(Part):
    """Parts of the uncertainty, by cause."""

    robot_random: Share
    robot_systematic: Share
    intrinsics: Share
    images: Share
    faults: Share | None = None
    """Share of the findings."""


def _sizes(found: Seen) -> Seen:
    if min(size for size in vars(found).values() if isinstance(size, float)) < 0:
        raise ValueError("a size below 0")
    return found


SeenJson = Annotated[Seen, AfterValidator(_sizes)]


@dataclass(frozen=True, kw_only=True)
class SeenAndCorners(Seen):
    """Point uncertainty at the centre of the image, and at its worst corner."""

    corners: SeenJson


class Joint(Part):
    """Covariance of transform, scale and intrinsics together, from which the uncertainty of any point follows."""

    covariance: Square
    order: list[str]
    """Names of the rows: those of `uncertainty`, then fx, fy, cx, cy and the distortion."""

    @model_validator(mode="after")
    def _is_square(self) -> "Joint":
        if np.shape(self.covariance) != 2 * (len(self.order),):
            raise ValueError(f"a covariance that is not {len(self.order)} x {len(self.order)}")
        return self


class ModelErrorJson(Part):
    """ModelError in the file."""

    likeliest: Numbers
    covariance: Square
    expressed: Square


class SceneJson(Part):
    """SceneUncertainty in the file."""

    middle_in_base: Numbers3
    covariance: PartCovariance7
    shape_m: Spread
    within_95_m: Spread


class Uncertainty(Part):
    """One-sigma uncertainty; axes of the gripper frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    scale_std_percent: Spread
    covariance: Covariance7
    order: Annotated[list[str], AfterValidator(_order)]
    worst: str
    """The least certain direction of the translation in words, and its size."""
    budget: UncertaintyBudget | None = None
    seen: Annotated[SeenAndCorners, AfterValidator(_sizes)] | None = None
    """Point uncertainty at the working distance."""
    scene_95_mm: Spread | None = None
    """95 % of the errors of points of the reconstruction in the base frame are smaller, at the median point."""
    joint: Joint | None = None
    """Null where the intrinsics were not estimated."""
    model_error: "ModelErrorJson | None" = None
    """Distortion that the model cannot express; null where the intrinsics were not estimated."""
    scene: "SceneJson | None" = None
    """Uncertainty of the whole reconstruction in the base frame; null where no image was adjusted."""

    @property
    def corner(self) -> Seen | None:
        """Point uncertainty in the worst corner of the image; None where the intrinsics were not estimated."""
        return None if self.seen is None or self.joint is None else self.seen.corners

    @classmethod
    def of(cls, estimate: Estimate, in_use: InUse | None) -> "Uncertainty":
        """Return the uncertainty of an estimate, in general and at the working distance."""
        std, camera = np.sqrt(np.diag(estimate.covariance)), estimate.intrinsics
        parts = {} if estimate.budget is None else vars(estimate.budget)
        scene = None if in_use is None else in_use.scene
        joint = None
        if camera is not None and estimate.intrinsics_cross is not None:
            order = [*COVARIANCE_ORDER, *parameter_names(camera)]
            joint = Joint.model_validate({"covariance": joint_covariance(estimate), "order": order})
        content = {
            "translation_std_mm": 1e3 * std[:3],
            "rotation_std_deg": np.degrees(std[3:6]),
            "scale_std_percent": float(100 * std[6]),
            "covariance": estimate.covariance,
            "order": list(COVARIANCE_ORDER),
            "worst": worst_direction(estimate.gripper_from_camera, estimate.covariance),
            "budget": {name: Share.of(part) for name, part in parts.items()} or None,
            "seen": in_use and SeenAndCorners(**vars(in_use.seen), corners=in_use.corners),
            "scene_95_mm": None if scene is None else 1e3 * scene.within_95_m,
            "joint": joint,
            "model_error": estimate.model_error,
            "scene": scene,
        }
        return cls.model_validate(content)


class MotionObservability(Part):
    """Observability of the motions."""

    observable: bool
    unobservable: list[str]
    advice: list[str]


class PoseNoise(Part):
    """Random noise of the gripper poses, one sigma per axis."""

    translation_mm: float
    rotation_deg: float
    estimated: bool

    def record(self, errors: "EstimatedRobotErrors | None") -> RobotNoise:
        """Return the noise with the systematic errors that are left in the poses."""
        left = (
            (0.0, 0.0) if errors is None else (errors.translation_mm / 1e3, np.radians(errors.rotation_deg))
        )
        return RobotNoise(
            translation=self.translation_mm / 1e3,
            rotation=float(np.radians(self.rotation_deg)),
            estimated=self.estimated,
            systematic_left=left,
        )


class JointOffset(Part):
    """True angle of a joint less the reported one."""

    offset_deg: float
    std_deg: Spread


class EstimatedRobotErrors(Part):
    """Systematic errors of the gripper poses, as estimated."""

    systematic_deg: Spread
    """One sigma of the joint offsets where the arm is known, else of the gripper's rotation."""
    translation_mm: Spread
    """Part that is left in the poses per axis, after the effective hand-eye transform took its own."""
    rotation_deg: Spread
    joints: list[JointOffset] | None = None
    """The joints from the base on; null where the arm is not known."""

    @classmethod
    def of(cls, robot: HandEye) -> "EstimatedRobotErrors":
        """Return the errors of a robot that the residuals show."""
        offsets, joints = robot.joint_offsets, None
        if offsets is not None:
            degrees = np.degrees([offsets.offset, offsets.std]).T.tolist()
            joints = [JointOffset(offset_deg=offset, std_deg=std) for offset, std in degrees]
        return cls(
            systematic_deg=float(np.degrees(robot.robot_noise.systematic)),
            **mm_and_deg(*robot.robot_noise.systematic_left),
            joints=joints,
        )


class GivenIntrinsicsPair(Part):
    """Transform for the intrinsics that were given, and the accuracy of that pair."""

    gripper_from_camera: Matrix
    covariance: Covariance7
    """Covariance in the order of `uncertainty`."""
    intrinsics: IntrinsicsJson
    seen: SeenJson
    differs_mm: Spread
    """Distance between the places of a point at the image centre by this pair and by the estimated one (mm)."""


class Proposal(Part):
    """Proposed gripper pose, and the accuracy expected once it is added."""

    base_from_gripper: Matrix
    like: str
    expected_std: Numbers7
    """One standard deviation of each unknown once this pose is added, in the order of `uncertainty`."""
    within_95_mm: Spread | None = None
    """Point uncertainty, as in `uncertainty.seen`."""
    rotation_95_deg: Spread | None = None


class Calibration(Part):
    """Result of a hand-eye calibration, and the content of calibration.json; what was not found is null.

    The camera is mounted on the gripper, and the scene rests in the base frame; or the camera is mounted on the base,
    and the reconstruction is of an object in the gripper. `parent_from_camera` is the transform of either.
    """

    format: Literal["jcr.calibration/2"] = FORMAT
    mount: Mount = "gripper"
    """Body that the camera is mounted on."""
    on_gripper: Matrix | None = Field(default=None, alias="gripper_from_camera")
    on_base: Matrix | None = Field(default=None, alias="base_from_camera")
    scene: Matrix | None = Field(default=None, alias="base_from_recon")
    """Rigid; maps recon coordinates multiplied by `scale` (m) to the base frame."""
    carried: Matrix | None = Field(default=None, alias="gripper_from_object")
    """Rigid; maps coordinates of the reconstructed object multiplied by `scale` (m) to the gripper frame."""
    scale: Positive | None
    """Metres per unit of the reconstruction."""
    converged: bool
    verdict: Verdict
    """Severity of the worst finding."""
    backend: str
    images: list[ImageVerdict]
    residuals: PaperResiduals | None
    uncertainty: Uncertainty | None
    """Along axes of the gripper; of a fixed camera along axes of the base."""
    held_out: LeaveOneOut | None
    observability: MotionObservability
    robot_noise: PoseNoise | None
    intrinsics: IntrinsicsAndStd | None
    """Intrinsics that belong to the transform."""
    findings: list[FindingJson]
    """Findings of the checks, strongest first."""
    warnings: list[str]
    """Findings that reject or warn, in words."""
    timings_s: dict[str, float]
    version: str
    next_poses: list[Proposal] = []
    scale_check: ScaleCheck | None = None
    robot_errors: EstimatedRobotErrors | None = None
    depth_check: DepthCheck | None = None
    lengths: list[LengthCheck] = []
    """Every length that was compared with the robot's positions."""
    board: BoardFound | None = None
    """Null where no board took part beside features."""
    requirement: Requirement | None = None
    """Null where nothing was found."""
    attempts: list[Attempt] = []
    """Back ends that were tried, in order; empty where camera poses were given."""
    notes: list[str] = []
    """Remarks of the stages, and findings in words that require no action."""
    with_given_intrinsics: GivenIntrinsicsPair | None = None
    """Transform for the intrinsics that were given; null where none were."""

    @model_validator(mode="after")
    def _is_whole(self) -> "Calibration":
        """Check that transform, uncertainty and findings belong together."""
        found = self.parent_from_camera is not None
        for name in ("scale", "residuals", "uncertainty", "robot_noise"):
            if (getattr(self, name) is not None) is not found:
                raise ValueError(f"{name} is null and the transform is not, or the other way round")
        own, other = (self.scene, self.carried) if self.mount == "gripper" else (self.carried, self.scene)
        if (own is not None) is not found or other is not None:
            raise ValueError(f"the reconstruction's frame does not fit the mount {self.mount}")
        if (self.on_base if self.mount == "gripper" else self.on_gripper) is not None:
            raise ValueError(f"a transform that does not fit the mount {self.mount}")
        if self.converged and not found:
            raise ValueError(f"converged without a {self.mount}_from_camera")
        require_one_verdict(self.findings, self.verdict, self.converged)
        return self

    def as_json(self) -> dict[str, Any]:
        """Return the content as it is written."""
        return self.model_dump(by_alias=True)

    @property
    def parent_from_camera(self) -> Float[ndarray, "4 4"] | None:
        """gripper_from_camera, or base_from_camera of a fixed camera; None where nothing was found."""
        return self.on_gripper if self.mount == "gripper" else self.on_base

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """Transform of a camera on the gripper; InputError of a fixed one, RejectedError where nothing was found."""
        return self._require(self.on_gripper, "gripper")

    @property
    def base_from_camera(self) -> Float[ndarray, "4 4"]:
        """Transform of a fixed camera; InputError of one on the gripper, RejectedError where nothing was found."""
        return self._require(self.on_base, "base")

    @property
    def base_from_recon(self) -> Similarity:
        """Similarity from the reconstruction to the base frame; raises as `gripper_from_camera`."""
        return Similarity(self._require(self.scene, "gripper"), self.scale or 1.0)

    @property
    def gripper_from_object(self) -> Similarity:
        """Similarity from the reconstruction of what the gripper carries to its frame; raises as `base_from_camera`."""
        return Similarity(self._require(self.carried, "base"), self.scale or 1.0)

    def _require(self, matrix: Float[ndarray, "4 4"] | None, mount: Mount) -> Float[ndarray, "4 4"]:
        """Return a transform of this calibration; raise where the camera has the other mount, or nothing was found."""
        if self.mount != mount:
            raise InputError(f"the camera's mount is {self.mount}: read {' and '.join(NAMES[self.mount])}")
        if matrix is None:
            raise RejectedError(f"no calibration was found: {self.doubt}")
        return matrix

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance in records.COVARIANCE_ORDER; RejectedError where nothing was found."""
        if self.uncertainty is None:
            raise RejectedError(f"no calibration was found: {self.doubt}")
        return self.uncertainty.covariance

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        return self.as_html()

    def as_html(self, note: str = "") -> str:
        """Return the transform with its standard deviations, the verdict and the warnings as a table, `note` below."""
        uncertainty, matrix = self.uncertainty, self.parent_from_camera
        if uncertainty is None or matrix is None:
            raise RejectedError(f"no calibration was found: {self.doubt}")
        degrees = np.degrees(rotation_log(matrix[:3, :3]))
        rows = [("", "translation", "rotation vector")] + [
            (
                axis,
                f"{1e3 * matrix[k, 3]:.2f} ± {uncertainty.translation_std_mm[k]:.2f} mm",
                f"{degrees[k]:.3f} ± {uncertainty.rotation_std_deg[k]:.3f}°",
            )
            for k, axis in enumerate("xyz")
        ]
        used = f"{self.images_used} of {len(self.images)} images used"
        verdict = ": ".join(filter(None, (self.verdict, "; ".join(self.warnings))))
        heading = f"{self.mount}_from_camera, {verdict}; {used}"
        return table(heading, rows, f"1σ, {self.mount} axes. {note}")

    def point_in_base(
        self, pixel: ArrayLike, depth_m: ArrayLike | float, base_from_gripper: ArrayLike
    ) -> tuple[Float[ndarray, "*points 3"], Float[ndarray, "*points 3 3"]]:
        """Return the base-frame coordinates (m) of points that the camera shows, and their covariances (m²).

        `pixel` (…,2) are pixels of the distorted image, `depth_m` (…) the z coordinates in the camera frame. The
        covariance includes intrinsics, transform, and the errors of the reported gripper pose; errors of the pixel and
        of a measured depth are the caller's to add. Raises InputError for a fixed camera or without intrinsics,
        RejectedError where nothing was found.
        """
        self._require(self.on_gripper, "gripper")
        if self.intrinsics is None or self.robot_noise is None:
            raise InputError("the calibration has no intrinsics: it was made from camera poses alone")
        return point_in_base(
            as_estimate(self),
            self.robot_noise.record(self.robot_errors),
            np.asarray(pixel, float),
            np.asarray(depth_m, float),
            np.asarray(base_from_gripper, float),
        )

    @property
    def doubt(self) -> str | None:
        """Reason of the rejection in words; None where it is accepted."""
        return doubt_of(self.findings)

    @property
    def short(self) -> Finding | None:
        """Finding that the requirement is not met; None where it is."""
        return next((one for one in self.findings if one.kind is FindingKind.NOT_EXACT_ENOUGH), None)

    @property
    def remarks(self) -> list[str]:
        """Remaining warnings in words, without those that the reason of the rejection explains."""
        first = self.short if self.converged else self.findings[0]
        said = without_consequences(self.findings)
        return [sentence(one) for one in said if one.severity != "informs" and one is not first]

    def with_findings(self, *findings: Finding) -> "Calibration":
        """Return the calibration with more findings."""
        together = strongest_first((*self.findings, *findings))
        return self.model_copy(update=_derived(together, self.notes))

    @property
    def images_used(self) -> int:
        """Number of images that the calibration uses."""
        return sum(image.used for image in self.images)


def as_estimate(calibration: Calibration) -> Estimate:
    """Return transform, scale and intrinsics with their joint covariance; RejectedError where nothing was found."""
    covariance, uncertainty = calibration.covariance, calibration.uncertainty
    assert uncertainty is not None
    scale, intrinsics = calibration.scale, calibration.intrinsics
    resting = calibration.scene if calibration.mount == "gripper" else calibration.carried
    assert calibration.parent_from_camera is not None and scale is not None and resting is not None
    joint, model_error = uncertainty.joint, uncertainty.model_error
    return Estimate(
        gripper_from_camera=calibration.parent_from_camera,
        scale=scale,
        base_from_recon=resting,
        covariance=covariance,
        intrinsics=None if intrinsics is None else intrinsics.record(),
        intrinsics_cross=None if joint is None else joint.covariance[:7, 7:],
        intrinsics_covariance=None if joint is None else joint.covariance[7:, 7:],
        model_error=None if model_error is None else ModelError(**dict(model_error)),
    )


def _derived(findings: Sequence[Finding], notes: Sequence[str]) -> dict[str, Any]:
    """Return the fields that follow from the findings."""
    informs = [sentence(one) for one in findings if one.severity == "informs"]
    return derived(findings) | {"notes": [*notes, *(note for note in informs if note not in notes)]}


def calibration_of(
    capture: Capture | PosePairs,
    reconstruction: Reconstruction | PosePairs,
    hand_eye: HandEye,
    timings_s: dict[str, float],
    version: str,
    attempts: Sequence[Attempt] = (),
) -> Calibration:
    """Return the calibration of `capture`; poses that were given are capture and reconstruction in one."""
    names = [capture.images[row] for row in reconstruction.image_index[hand_eye.inliers]]
    proposals = [vars(pose) | {"like": names[pose.like]} for pose in hand_eye.next_poses]
    mount = capture.mount if isinstance(capture, Capture) else "gripper"
    used = reconstruction.intrinsics if isinstance(reconstruction, Reconstruction) else None
    intrinsics = hand_eye.intrinsics or used
    camera, resting = NAMES[mount]
    noise = hand_eye.robot_noise
    content = {
        "mount": mount,
        camera: hand_eye.gripper_from_camera,
        resting: hand_eye.base_from_recon,
        **{name: getattr(hand_eye, name) for name in OF_HAND_EYE},
        "backend": reconstruction.backend,
        "images": image_verdicts(capture, reconstruction, hand_eye),
        "uncertainty": Uncertainty.of(hand_eye, hand_eye.in_use),
        "held_out": hand_eye.leave_one_out,
        "robot_noise": mm_and_deg(noise.translation, noise.rotation) | {"estimated": noise.estimated},
        "intrinsics": IntrinsicsAndStd.of(intrinsics, hand_eye.intrinsics_std),
        "timings_s": timings_s,
        "version": version,
        "next_poses": [{name: pose[name] for name in Proposal.model_fields} for pose in proposals],
        "scale_check": hand_eye.network,
        "robot_errors": EstimatedRobotErrors.of(hand_eye),
        "depth_check": hand_eye.depth,
        "lengths": list(hand_eye.lengths),
        "board": hand_eye.board,
        "attempts": list(attempts),
    }
    if mount == "base":
        content["with_given_intrinsics"] = None  # a pair that is estimated for a camera on the gripper only
    return Calibration.model_validate(content | _derived(hand_eye.findings, reconstruction.notes))


def failed_calibration(
    capture: Capture,
    backend: str,
    findings: Sequence[Finding],
    timings_s: dict[str, float],
    version: str,
    attempts: Sequence[Attempt] = (),
) -> Calibration:
    """Return the result for a capture whose images gave no camera poses; `findings` are the reasons, strongest first."""
    nothing = ("scale", "residuals", "uncertainty", "held_out", "robot_noise")
    advice = remedy(findings[0]) or text(findings[0])
    unseen = {"observable": False, "unobservable": ["everything: no camera poses"], "advice": [advice]}
    content = dict.fromkeys(nothing) | {
        "mount": capture.mount,
        "backend": backend,
        "images": [ImageVerdict(image=name, used=False, reason="not registered") for name in capture.images],
        "observability": unseen,
        "intrinsics": IntrinsicsAndStd.of(capture.intrinsics),
        "timings_s": timings_s,
        "version": version,
        "attempts": list(attempts),
    }
    return Calibration.model_validate(content | _derived(findings, ()))


def image_verdicts(
    capture: Capture | PosePairs, reconstruction: Reconstruction | PosePairs, hand_eye: HandEye
) -> list[ImageVerdict]:
    """Return the use and the residuals of every image of the capture."""
    row_of = {int(row): k for k, row in enumerate(reconstruction.image_index)}
    verdicts = []
    for row, name in enumerate(capture.images):
        k = row_of.get(row)
        if k is None:
            why = f"not registered by {reconstruction.backend}"
            verdicts.append(ImageVerdict(image=name, used=False, reason=why))
            continue
        pixels = np.nan if hand_eye.reprojection_px is None else float(hand_eye.reprojection_px[k])
        verdicts.append(
            ImageVerdict(
                image=name,
                used=bool(hand_eye.inliers[k]),
                reason=hand_eye.reasons[k],
                translation_residual_mm=1e3 * float(hand_eye.translation_residual_m[k]),
                rotation_residual_deg=float(np.degrees(hand_eye.rotation_residual_rad[k])),
                reprojection_px=None if np.isnan(pixels) else pixels,
            )
        )
    return verdicts


def write_calibration(path: Path, content: Calibration) -> None:
    """Write calibration.json whole or not at all."""
    write_text(path, json.dumps(content.as_json(), indent=2, allow_nan=False) + "\n")


def read_calibration(path: Path) -> Calibration:
    """Read calibration.json, or the one in a run folder; raise InputError where there is none, or of another format."""
    file = path / "calibration.json" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: no such file; run `jcr calibrate` or `jcr run` first")
    return validated(read_content(file), file)


def read_content(file: Path) -> dict[str, object]:
    """Return the object in a JSON file; raise InputError where there is none."""
    try:
        content = read_json(file)
    except InputError as error:
        what = str(error).removeprefix(f"{file}: ")
        raise InputError(f"{file}: damaged ({what}); run the calibration again") from None
    if not isinstance(content, dict):
        raise InputError(f"{file}: no JSON object; run the calibration again")
    return content


def validated(content: dict[str, object], file: Path) -> Calibration:
    """Return the calibration of a file's content; raise InputError where it is none, or of another format."""
    kind = content.get("format")
    if kind != FORMAT:
        raise InputError(
            f"{file}: format {shown(kind)}, this version reads {FORMAT!r}; run the calibration again"
        )
    try:
        # As JSON again: there, and not among Python's values, a list may stand for a record of numbers.
        return Calibration.model_validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; run the calibration again") from None
