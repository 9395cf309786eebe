"""Record of a hand-eye calibration, in memory and as calibration.json: verdict, transform, uncertainty, findings."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.typing import ArrayLike
from pydantic import (
    ConfigDict,
    Field,
    PlainSerializer,
    TypeAdapter,
    ValidationError,
    computed_field,
)

import jcr
from jcr.capture.checks import far_faults
from jcr.errors import InputError, RejectedError, first_fault, shown
from jcr.estimation.point_uncertainty import point_in_base
from jcr.files import written_whole
from jcr.findings import (
    Finding,
    FindingKind,
    Verdict,
    doubt_of,
    sentence,
    strongest_first,
    verdict_of,
    warnings_of,
    without_consequences,
)
from jcr.geometry import Similarity, require_rigid
from jcr.number_format import significant
from jcr.records import (
    Attempt,
    Capture,
    DepthCheck,
    FrameNames,
    GivenIntrinsicsResult,
    ImageVerdict,
    Intrinsics,
    IntrinsicsAndStd,
    JointOffsets,
    LeaveOneOut,
    LengthCheck,
    Mount,
    Observability,
    PaperResiduals,
    PosePairs,
    Reconstruction,
    Requirement,
    RobotNoise,
    Uncertainty,
)
from jcr.records.field_checks import require_fields
from jcr.records.json_fields import Matrix, Positive, rounded
from jcr.records.json_file import read_json
from jcr.records.reconstruction_npz import read_npz, write_npz

FORMAT = "jcr.calibration/2"
UNCERTAINTY, ARRAYS = "uncertainty.npz", "jcr.uncertainty/1"
"""File beside calibration.json with the arrays that only programs read, and its format."""
APART = ("model_error", "scene")
"""Parts of the uncertainty that are in uncertainty.npz alone; that file also has the covariances of the budget."""
LINE = 210
"""Most characters of a line of calibration.json; the entry of an image has 200."""
NAMES = {
    "gripper": ("gripper_from_camera", "base_from_recon"),
    "base": ("base_from_camera", "gripper_from_object"),
}
"""Names of the two transforms of a calibration, for a camera on the gripper and for one fixed in the base frame."""
FARTHEST_DEPTH = 30.0
"""Largest depth of a point, as a multiple of the calibration's working distance: a depth in mm is 1000 times too large,
and 30 is about the geometric mean of 1 and 1000, so ± 50 % changes nothing."""


def as_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as a JSON object: its fields, and its message (key `text`) and remedy in words."""
    return vars(finding) | {"text": finding.text, "remedy": finding.remedy}


FindingJson = Annotated[Finding, PlainSerializer(as_json)]
"""Finding whose JSON also holds text and remedy, for people; reading ignores both."""


def require_one_verdict(findings: Sequence[Finding], verdict: object, converged: object) -> None:
    """Raise ValueError if the `verdict` or `converged` that a file states contradicts the findings in the file.

    The values are of any type, because they are read from JSON.
    """
    if verdict != verdict_of(findings) or converged is not (verdict != "rejected"):
        raise ValueError("converged, verdict and findings contradict one another")


def mm_and_deg(metres: float, radians: float) -> dict[str, float]:
    """Return a translation (m) and a rotation (rad) as the JSON fields translation_mm and rotation_deg."""
    return {"translation_mm": rounded(1e3 * metres), "rotation_deg": rounded(np.degrees(radians))}


AnyOutcome = TypeVar("AnyOutcome", bound="Outcome")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Outcome:
    """Base class of Calibration, FailedCalibration and PublishedCalibration, with the fields of calibration.json.

    Each class states which of the fields that may be None here are always set.

    With mount "gripper" the camera is on the gripper, and the reconstructed scene rests in the base frame. With mount
    "base" the camera is fixed, and the gripper carries the reconstructed object. `parent_from_camera` is
    gripper_from_camera or base_from_camera.
    """

    __pydantic_config__ = ConfigDict(allow_inf_nan=False)
    format: Literal["jcr.calibration/2"] = FORMAT
    mount: Mount = "gripper"
    """Body that the camera is mounted on."""
    on_gripper: Annotated[Matrix | None, Field(alias="gripper_from_camera")] = None
    """Pose of a camera on the gripper (m); None for a fixed camera."""
    on_base: Annotated[Matrix | None, Field(alias="base_from_camera")] = None
    """Pose of a fixed camera (m); None for a camera on the gripper."""
    resting: Annotated[Matrix | None, Field(alias="base_from_recon")] = None
    """Rigid transform of recon coordinates times `scale` (m) to the base frame; None for a fixed camera."""
    carried: Annotated[Matrix | None, Field(alias="gripper_from_object")] = None
    """Rigid transform of the carried object's scaled recon coordinates (m) to the gripper; None for a camera on it."""
    method: Literal["default", "paper"] = "default"
    """Method of the calibration: that of this package, or the published one, which checks nothing."""
    backend: str = ""
    """Name of the back end that reconstructed the images."""
    images: tuple[ImageVerdict, ...]
    """Use of every image of the capture, in its order; of every pose pair, for a calibration from given poses."""
    intrinsics: IntrinsicsAndStd | None = None
    """Intrinsics to use together with the transform (px); None for a calibration from given poses."""
    intrinsics_source: Literal["given", "estimated"] | None = None
    """Source of `intrinsics`: given, or adjusted from given ones; or estimated, also where given ones did not fit the
    images. None: not recorded."""
    scale: Positive | None = None
    """Metres per unit of the reconstruction."""
    uncertainty: Uncertainty | None = None
    """Uncertainty of transform and scale, along axes of the gripper, or of the base for a fixed camera."""
    source: Literal["images", "poses"] | None = None
    """images: result of a bundle adjustment with the gripper poses; poses: result of a fit to camera poses."""
    residuals: PaperResiduals | None = None
    """Residuals δ_t and δ_R of the paper (eq. 16); small ones do not prove accuracy."""
    robot_noise: RobotNoise | None = None
    joint_offsets: JointOffsets | None = None
    """Estimated joint offsets; None where the arm is not known."""
    held_out: LeaveOneOut | None = None
    """Leave-one-out error; None where too few images are used."""
    requirement: Requirement | None = None
    """Required and reached accuracy; None if none is required, and for the result of `solve_hand_eye`."""
    with_given_intrinsics: GivenIntrinsicsResult | None = None
    """Transform to use with the given intrinsics; None if none were given, or if the images were not adjusted."""
    depth_check: DepthCheck | None = None
    """Scale and noise of the depth images; None without them, or if too few features have a depth."""
    lengths: tuple[LengthCheck, ...] = ()
    """Known lengths, each compared with the robot's positions."""
    findings: tuple[FindingJson, ...] = ()
    """Findings of the checks: first those that reject, then warnings, then remarks; causes before consequences."""
    frame_names: FrameNames = FrameNames()
    """Names of the frames of base, gripper and camera in the robot's software; null where unknown."""
    notes: tuple[str, ...] = ()
    """Remarks of the stages, and findings that require no action, in words."""
    attempts: tuple[Attempt, ...] = ()
    """Reconstructions that were tried, first to last; empty for a calibration from given poses."""
    timings_s: dict[str, float] = field(default_factory=dict)
    """Seconds of each stage."""
    version: str = field(default_factory=lambda: jcr.__version__)

    @computed_field
    @property
    def verdict(self) -> Verdict:
        """Result of all checks: accepted; accepted, but not as exact as needed; not checked; or rejected."""
        return verdict_of(self.findings)

    @computed_field
    @property
    def converged(self) -> bool:
        """Whether no finding rejects the calibration, which may be less exact than needed."""
        return self.verdict != "rejected"

    @computed_field
    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that reject or warn."""
        return warnings_of(self.findings)

    @computed_field
    @property
    def observability(self) -> Observability:
        """Directions of translation, rotation and scale that the motions leave unobservable."""
        return Observability(tuple(one for one in self.findings if one.kind is FindingKind.UNOBSERVABLE))

    @computed_field
    @property
    def robot_errors(self) -> dict[str, Any] | None:
        """Systematic robot errors as JSON: `systematic_deg`, `translation_mm` and `rotation_deg`, and `joints`.

        `systematic_deg` is their size (`RobotNoise.systematic`); `translation_mm` and `rotation_deg` are the part per
        axis that the fit leaves. `joints` lists the offset and standard deviation of each joint (degrees); null for an
        unknown arm. None where the errors are unknown.
        """
        if self.robot_noise is None:
            return None
        offsets, joints = self.joint_offsets, None
        if offsets is not None:
            degrees = np.degrees([offsets.offset, offsets.std]).T.tolist()
            joints = [{"offset_deg": offset, "std_deg": std} for offset, std in degrees]
        systematic, left = rounded(np.degrees(self.robot_noise.systematic)), self.robot_noise.systematic_left
        return {"systematic_deg": systematic, **mm_and_deg(*left), "joints": joints}

    @property
    def parent_from_camera(self) -> Float[ndarray, "4 4"] | None:
        """gripper_from_camera, or base_from_camera of a fixed camera; None for a failed calibration."""
        return self.on_gripper if self.mount == "gripper" else self.on_base

    @property
    def gripper_from_camera(self) -> Float[ndarray, "4 4"]:
        """Pose (m) of a camera on the gripper; raises InputError for a fixed one, RejectedError without calibration."""
        return self._require(self.on_gripper, "gripper")

    @property
    def base_from_camera(self) -> Float[ndarray, "4 4"]:
        """Pose (m) of a fixed camera; raises InputError for one on the gripper, RejectedError without calibration."""
        return self._require(self.on_base, "base")

    def _require_transforms(self) -> None:
        """Raise InputError unless the fields are possible and exactly the two transforms of the mount are set."""
        require_fields(self)
        own, other = (self.on_gripper, self.resting), (self.on_base, self.carried)
        own, other = (own, other) if self.mount == "gripper" else (other, own)
        if any(one is None for one in own) or any(one is not None for one in other):
            raise InputError(f"the transforms are not those of the mount {self.mount}")

    def _require(self, matrix: Float[ndarray, "4 4"] | None, mount: Mount) -> Float[ndarray, "4 4"]:
        """Return `matrix`; raise InputError if the camera's mount is not `mount`, RejectedError if `matrix` is None."""
        if self.mount != mount:
            raise InputError(f"the camera's mount is {self.mount}: read {' and '.join(NAMES[self.mount])}")
        if matrix is None:
            raise RejectedError(f"no calibration was found: {self.doubt}")
        return matrix

    @property
    def doubt(self) -> str | None:
        """Reason of the rejection in words; None for an accepted calibration."""
        return doubt_of(self.findings)

    @property
    def short(self) -> Finding | None:
        """Finding that the required accuracy is not reached; None if it is."""
        return next((one for one in self.findings if one.kind is FindingKind.NOT_EXACT_ENOUGH), None)

    @property
    def remarks(self) -> list[str]:
        """Warnings in words, without a missed accuracy, the reason of a rejection, and warnings that follow from it.

        Further findings that reject are included.
        """
        first = self.short if self.converged else self.findings[0]
        said = without_consequences(self.findings)
        return [sentence(one) for one in said if one.severity != "informs" and one is not first]

    @property
    def images_used(self) -> int:
        """Number of images that the calibration uses."""
        return sum(image.used for image in self.images)

    def __repr__(self) -> str:
        """Return the class, and the calibration in short."""
        return f"<{type(self).__name__}: {self.in_short}>"

    @property
    def in_short(self) -> str:
        """Verdict and number of used images, on one line."""
        return f"{self.verdict}, {self.images_used} of {len(self.images)} images"

    def with_findings(self: AnyOutcome, *findings: Finding) -> AnyOutcome:
        """Return the calibration with more findings, all of them sorted by `strongest_first`; its covariance stays."""
        return replace(self, findings=strongest_first((*self.findings, *findings)))

    def with_notes(self: AnyOutcome, *notes: str) -> AnyOutcome:
        """Return the calibration with `notes` added, and its findings of severity "informs" added as notes."""
        informs = (sentence(one) for one in self.findings if one.severity == "informs")
        return replace(self, notes=tuple(dict.fromkeys([*self.notes, *notes, *informs])))

    def as_json(self) -> dict[str, Any]:
        """Return the content of calibration.json as a dict."""
        return adapter(type(self)).dump_python(self, by_alias=True, mode="json")

    def __eq__(self, other: object) -> bool:
        """Compare two records by their JSON, because a comparison of arrays is no single truth value."""
        return isinstance(other, Outcome) and self.as_json() == other.as_json()

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Calibration(Outcome):
    """Result of a hand-eye calibration: transform, scale, uncertainty, robot errors, and accuracy; see also Outcome."""

    scale: Positive = field()
    uncertainty: Uncertainty = field()
    source: Literal["images", "poses"] = "poses"
    residuals: PaperResiduals = PaperResiduals(0.0, 0.0)
    robot_noise: RobotNoise = field()

    def __post_init__(self) -> None:
        """Raise InputError unless the scale is possible and exactly the two transforms of the mount are set."""
        self._require_transforms()

    @property
    def parent_from_camera(self) -> Float[ndarray, "4 4"]:
        """gripper_from_camera, or base_from_camera of a fixed camera."""
        return self.gripper_from_camera if self.mount == "gripper" else self.base_from_camera

    @property
    def in_short(self) -> str:
        """Verdict, number of used images, and the error that 95 % of the points stay below, on one line."""
        seen = self.uncertainty.seen
        point = "" if seen is None else f", a point within {significant(seen.within_95_mm)} mm (95 %)"
        return super().in_short + point

    @property
    def base_from_recon(self) -> Similarity:
        """Similarity from recon coordinates (any unit) to the base frame (m); raises InputError for a fixed camera."""
        return Similarity(self._require(self.resting, "gripper"), self.scale)

    @property
    def body_from_recon(self) -> Similarity:
        """Similarity from recon coordinates to the body that holds the scene: base_from_recon or gripper_from_object."""
        return self.base_from_recon if self.mount == "gripper" else self.gripper_from_object

    @property
    def gripper_from_object(self) -> Similarity:
        """Similarity from recon coordinates (any unit) of the carried object to the gripper frame (m).

        Raises InputError for a camera on the gripper.
        """
        return Similarity(self._require(self.carried, "base"), self.scale)

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance of the translation (m), rotation vector (rad) and log scale, as in records.COVARIANCE_ORDER.

        Axes are those of the gripper, or of the base for a fixed camera.
        """
        return self.uncertainty.covariance

    @property
    def inliers(self) -> Bool[ndarray, " m"]:
        """Mask of the used images among the registered ones, in the order of the reconstruction."""
        registered = (one for one in self.images if one.translation_residual_mm is not None)
        return np.array([image.used for image in registered], bool)

    def of_capture(
        self, capture: Capture | PosePairs, reconstruction: Reconstruction | PosePairs
    ) -> "Calibration":
        """Return the calibration with a verdict on every image of the capture, and with the notes of reconstruction.

        The images of `self` must be those that `reconstruction` registered; the others are added as unused. For given
        camera poses, both arguments are the same PosePairs.
        """
        own = dict(zip(reconstruction.image_index.tolist(), self.images, strict=True))
        why = f"not registered by {reconstruction.backend}"
        images = tuple(
            own.get(row) or ImageVerdict(image=name, used=False, reason=why)
            for row, name in enumerate(capture.images)
        )
        made = replace(self, images=images, backend=reconstruction.backend, notes=())
        return made.with_notes(*reconstruction.notes)

    def point_in_base(
        self, pixel: ArrayLike, depth_m: ArrayLike | float, base_from_gripper: ArrayLike
    ) -> tuple[Float[ndarray, "*points 3"], Float[ndarray, "*points 3 3"]]:
        """Return the base-frame coordinates (m) of points given by pixel and depth, and their covariances (m²).

        `pixel` (…,2) are pixels (x, y) of the distorted image, `depth_m` (…) the z coordinates in the camera frame.
        `base_from_gripper` (4,4) is the reported gripper pose of the image. The covariances include the errors of
        intrinsics, transform and reported gripper pose, but not those of `pixel` and `depth_m`: add the variance of your
        depth along the ray. Raises InputError for a fixed camera, without intrinsics, for a pixel outside of the image,
        and for a depth or pose that cannot be.
        """
        x = self.gripper_from_camera
        if self.intrinsics is None:
            raise InputError("the calibration has no intrinsics: it was made from camera poses alone")
        pixel, depth_m, pose = (np.asarray(one, float) for one in (pixel, depth_m, base_from_gripper))
        if pose.shape != (4, 4):
            raise InputError(f"base_from_gripper: shape {pose.shape}; give one 4×4 gripper pose")
        if pixel.shape[-1:] != (2,) or depth_m.shape not in ((), pixel.shape[:-1]):
            raise InputError(
                f"pixel of shape {pixel.shape}, depth_m of {depth_m.shape}; give x and y, and one depth for each pixel"
            )
        self._require_visible(self.intrinsics, pixel, depth_m)
        pose = require_rigid(pose, "base_from_gripper")
        far_faults(pose[None, :3, 3], "base_from_gripper", ["the pose"])
        return point_in_base(x, self.uncertainty, self.intrinsics, self.robot_noise, pixel, depth_m, pose)

    def _require_visible(
        self, camera: Intrinsics, pixel: Float[ndarray, "..."], depth_m: Float[ndarray, "..."]
    ) -> None:
        """Raise InputError for a pixel (x, y) outside of the image, and for a depth (m) that no wrist camera has."""
        size = np.array([camera.width, camera.height])
        outside = ~((pixel >= -0.5) & (pixel <= size - 0.5)).all(-1)
        if outside.any():
            first = pixel[outside][0].tolist()
            raise InputError(
                f"pixel {first}: outside of the image of {size[0]}x{size[1]}; give x, then y, from 0"
            )
        seen = self.uncertainty.seen
        farthest = np.inf if seen is None else FARTHEST_DEPTH * 1e-3 * seen.distance_mm
        wrong = ~((depth_m > 0) & (depth_m < farthest))
        if wrong.any():
            where = (
                ""
                if seen is None
                else f"; the calibration's images are {seen.distance_mm / 1e3:.2g} m from the scene"
            )
            raise InputError(
                f"depth_m {depth_m[wrong][0]:g}: no depth in metres{where}; convert it, or leave that pixel out"
            )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FailedCalibration(Outcome):
    """Result for a capture that could not be reconstructed; its findings are the reasons.

    Fields that only a calibration has, such as `scale`, are None here and null in the file.
    """

    def __post_init__(self) -> None:
        """Raise InputError unless a finding states why there is no calibration."""
        if self.verdict != "rejected":
            raise InputError("no finding states why there is no calibration")

    @computed_field
    @property
    def observability(self) -> Observability:
        """Observability of a failed calibration: nothing is observable; the remedy is that of the first finding."""
        advice = self.findings[0].remedy or self.findings[0].text
        kind, motion = FindingKind.UNOBSERVABLE, "no camera poses"
        return Observability((Finding.of(kind, "rejects", "motion", motion=motion, advice=advice),))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PublishedCalibration(Outcome):
    """Result of the published method: transform, scale and residuals, without covariance and without checks.

    Other fields of a Calibration, such as `uncertainty`, are None here and null in the file.
    """

    scale: Positive = field()
    residuals: PaperResiduals = field()

    def __post_init__(self) -> None:
        """Raise InputError unless the scale is possible and exactly the two transforms of the mount are set."""
        self._require_transforms()

    @property
    def parent_from_camera(self) -> Float[ndarray, "4 4"]:
        """gripper_from_camera; the published method calibrates a camera on the gripper."""
        return self.gripper_from_camera

    @property
    def base_from_recon(self) -> Similarity:
        """Similarity from recon coordinates (any unit) to the base frame (m)."""
        return Similarity(self._require(self.resting, "gripper"), self.scale)


AnyCalibration = Calibration | FailedCalibration | PublishedCalibration


@cache
def adapter(kind: type[Outcome]) -> TypeAdapter:
    """Return the pydantic adapter that reads and writes a class of records as JSON."""
    return TypeAdapter(kind)


def write_calibration(path: Path, content: Outcome) -> None:
    """Write a result as calibration.json, and the arrays that only programs read as uncertainty.npz beside it.

    A failed write leaves existing files unchanged. The first file states the digest of the second.
    """
    made, arrays = content.as_json(), dict[str, ndarray]()
    if (uncertainty := made.get("uncertainty")) is not None:
        _take_arrays(uncertainty, arrays)
    if arrays:
        made["uncertainty"]["arrays"] = digest_of(arrays)
    # Both files are replaced when both are written.
    with written_whole(path) as temporary:
        temporary.write_bytes(f"{as_text(made)}\n".encode())
        if arrays:
            write_npz(path.with_name(UNCERTAINTY), {"format": ARRAYS}, arrays)
        else:
            path.with_name(UNCERTAINTY).unlink(missing_ok=True)


def _take_arrays(uncertainty: dict[str, Any], arrays: dict[str, ndarray]) -> None:
    """Move model error, scene, and the covariances of the budget and of the intrinsics from JSON to arrays."""
    if (joint := uncertainty.get("joint")) is not None:
        arrays["joint"] = np.array(joint.pop("covariance"))
    for part in APART:
        for name, value in (uncertainty.pop(part, None) or {}).items():
            arrays[f"{part}.{name}"] = np.array(value)
    for cause, share in (uncertainty.get("budget") or {}).items():
        arrays[f"budget.{cause}"] = np.array(share.pop("covariance"))


def _with_arrays(content: dict[str, Any], file: Path, is_needed: bool) -> dict[str, Any]:
    """Return the content of a calibration.json, `file`, with the arrays of uncertainty.npz beside it.

    Without this file the parts with arrays are left out; raises InputError then if it `is_needed`, or if it belongs to
    another calibration.
    """
    uncertainty = content.get("uncertainty")
    if not isinstance(uncertainty, dict) or "arrays" not in uncertainty:
        return content
    stated, beside = uncertainty["arrays"], file.with_name(UNCERTAINTY)
    whole = {name: value for name, value in uncertainty.items() if name not in ("arrays", "budget", "joint")}
    if not is_needed and not beside.is_file():
        return content | {"uncertainty": whole}
    with read_npz(beside, ARRAYS) as (_, found):
        arrays = {name: found[name] for name in found if name != "about"}
        if digest_of(arrays) != stated:
            raise InputError(
                f"{beside}: belongs to another calibration than {file}; run the calibration again"
            )
    for part in APART:
        names = [name for name in arrays if name.startswith(f"{part}.")]
        if names:
            whole[part] = {name.removeprefix(f"{part}."): arrays[name].tolist() for name in names}
    budget, joint = uncertainty.get("budget"), uncertainty.get("joint")
    if isinstance(joint, dict) and "joint" in arrays:
        whole["joint"] = joint | {"covariance": arrays["joint"].tolist()}
    if isinstance(budget, dict):
        whole["budget"] = {
            cause: {**share, "covariance": arrays[f"budget.{cause}"].tolist()}
            for cause, share in budget.items()
            if isinstance(share, dict) and f"budget.{cause}" in arrays
        }
    return content | {"uncertainty": whole}


def digest_of(arrays: Mapping[str, ndarray]) -> str:
    """Return a SHA-256 hash of the names and values of arrays."""
    parts = (name.encode() + np.ascontiguousarray(arrays[name], float).tobytes() for name in sorted(arrays))
    return hashlib.sha256(b"".join(parts)).hexdigest()


def as_text(value: Any, indent: int = 0) -> str:
    """Return JSON as text in which what fits on a line stays on it, as rows of a matrix and images of a list do."""
    line = json.dumps(value, allow_nan=False)
    if len(line) + 2 * indent <= LINE or not isinstance(value, dict | list):
        return line
    inner, outer = "\n" + (indent + 1) * "  ", "\n" + indent * "  "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {as_text(one, indent + 1)}" for key, one in value.items()]
        return f"{{{inner}{f',{inner}'.join(parts)}{outer}}}"
    return f"[{inner}{f',{inner}'.join(as_text(one, indent + 1) for one in value)}{outer}]"


def read_calibration(path: Path) -> AnyCalibration:
    """Read a calibration.json, given as a file or as its run folder, with the uncertainty.npz beside it.

    Raises InputError if a file is missing, damaged, or of another format or calibration.
    """
    file = path / "calibration.json" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: no such file; run `jcr calibrate` or `jcr run` first")
    return validated(read_content(file), file, with_arrays=True)


def read_content(file: Path) -> dict[str, object]:
    """Return the top-level object of a JSON file; raise InputError if the file is damaged or holds no object."""
    try:
        content = read_json(file)
    except InputError as error:
        what = str(error).removeprefix(f"{file}: ")
        raise InputError(f"{file}: damaged ({what}); run the calibration again") from None
    if not isinstance(content, dict):
        raise InputError(f"{file}: no JSON object; run the calibration again")
    return content


def validated(content: dict[str, object], file: Path, with_arrays: bool = False) -> AnyCalibration:
    """Return the calibration that the content of `file` describes; raise InputError, naming the file, if invalid.

    `with_arrays`: the file uncertainty.npz beside it is needed; otherwise it is used if it is there.
    """
    kind = content.get("format")
    if kind != FORMAT:
        raise InputError(
            f"{file}: format {shown(kind)}, this version reads {FORMAT!r}; run the calibration again"
        )
    content = _with_arrays(content, file, with_arrays)
    is_empty = content.get("scale") is None and content.get("uncertainty") is None
    of_method = PublishedCalibration if content.get("method") == "paper" else Calibration
    record = FailedCalibration if is_empty else of_method
    try:
        # Strict validation accepts lists for tuples and arrays only in JSON text, not in Python values.
        found = adapter(record).validate_json(json.dumps(content), strict=True)
        require_one_verdict(found.findings, content.get("verdict"), content.get("converged"))
    except ValueError as error:
        fault = first_fault(error) if isinstance(error, ValidationError) else error
        raise InputError(f"{file}: {fault}; run the calibration again") from None
    if unknown := content.keys() - found.as_json().keys():
        raise InputError(f"{file}: {min(unknown)}: no such key; run the calibration again")
    return found
