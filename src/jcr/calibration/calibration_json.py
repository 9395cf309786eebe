"""calibration.json: what a calibration is on disk."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    model_validator,
)

from jcr.calibration.requirement import not_exact_enough
from jcr.calibration.words import more_images_help
from jcr.capture.plain_files import first_fault, read_json, shown
from jcr.errors import InputError, NotTrustedError
from jcr.files import write_text
from jcr.geometry import require_rigid
from jcr.intrinsics_json import IntrinsicsJson, Positive
from jcr.records import (
    COVARIANCE_ORDER,
    AngleRatio,
    Attempt,
    Capture,
    DepthCheck,
    Estimate,
    Finding,
    HandEye,
    HeldOut,
    ImageVerdict,
    Intrinsics,
    Kind,
    Mount,
    PaperResiduals,
    PosePairs,
    Reconstruction,
    Requirement,
    RobotExamined,
    ScaleCheck,
    Severity,
    Verdict,
    strongest_first,
    verdict_of,
)
from jcr.records.findings import RANK
from jcr.records.words import remedy, sentence, text
from jcr.rounding import significant

FORMAT = "jcr.calibration/1"


def _rigid(rows: list[list[float]]) -> list[list[float]]:
    require_rigid(np.array(rows), "the matrix")
    return rows


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    matrix = np.array(rows)
    std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    largest = np.outer(std, std)  # Cauchy-Schwarz; of motions that show little, the last digits are not exact
    if (np.diag(matrix) < 0).any() or not (np.abs(matrix) <= 1.001 * largest + 1e-30).all():
        raise ValueError("no covariance: two errors vary together more than each by itself")
    if not (np.abs(matrix - matrix.T) <= 1e-3 * largest + 1e-30).all():
        raise ValueError("no covariance: not symmetric")
    return rows


def _order(names: list[str]) -> list[str]:
    if tuple(names) != COVARIANCE_ORDER:
        raise ValueError(f"not {', '.join(COVARIANCE_ORDER)}")
    return names


def _with_words(finding: Finding) -> dict[str, Any]:
    return vars(finding) | {"text": text(finding), "remedy": remedy(finding)}


def _without_words(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    # What was changed is a value of Python's, where a strict tuple is no list.
    return {
        name: tuple(part) if isinstance(part, list) else part
        for name, part in value.items()
        if name not in ("text", "remedy")
    }


FindingJson = Annotated[Finding, BeforeValidator(_without_words), PlainSerializer(_with_words)]
"""With its text and remedy, which are for people and made again when it is read."""
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
Spread = Annotated[float, Field(ge=0)]
Spread3 = Annotated[list[Spread], Field(min_length=3, max_length=3)]
Numbers7 = Annotated[list[float], Field(min_length=7, max_length=7)]
Covariance = Annotated[list[Numbers7], Field(min_length=7, max_length=7), AfterValidator(_covariance)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Share(_Part):
    """One sigma per axis, root mean square over the axes: squares of shares add up to that of the whole."""

    translation_mm: Spread
    rotation_deg: Spread
    covariance: Covariance | None = None
    """In the order of `uncertainty`; the parts' sum is the whole."""


class UncertaintyBudget(_Part):
    """What the uncertainty of the camera on the gripper comes from."""

    robot_random: Share
    robot_systematic: Share
    intrinsics: Share
    images: Share
    faults: Share | None = None
    """What findings add; null in files of earlier versions."""


class Uncertainty(_Part):
    """One-sigma uncertainty; axes of the gripper frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    scale_std_percent: Spread
    covariance: Covariance
    order: Annotated[list[str], AfterValidator(_order)]
    worst: str
    """The least certain direction of the translation in words, and its size."""
    budget: UncertaintyBudget | None = None


class Observed(_Part):
    observable: bool
    unobservable: list[str]
    advice: list[str]


class Noise(_Part):
    translation_mm: float
    rotation_deg: float
    estimated: bool


class JointOffset(_Part):
    """True angle of a joint less the reported one."""

    offset_deg: float
    std_deg: Spread


class RobotErrors(_Part):
    """Systematic errors of the gripper poses, as estimated."""

    systematic_deg: Spread
    """Of joint offsets where the arm is known, else of the gripper's rotation."""
    translation_mm: Spread
    """What of them is left in the poses per axis, after the effective hand-eye transform took its part."""
    rotation_deg: Spread
    p: Annotated[float, Field(ge=0, le=1)] | None = None
    """Chance of residuals like these where the robot's errors are random alone."""
    joints: list[JointOffset] | None = None
    """From the base on; null where the arm is not known."""


class Lens(IntrinsicsJson):
    """With what is known of their errors."""

    std: list[Spread] | None = None
    """Standard deviations of fx, fy, cx, cy and the distortion; null where the intrinsics were not refined."""

    @model_validator(mode="after")
    def _one_of_each(self) -> "Lens":
        if self.std is not None and len(self.std) != 4 + len(self.distortion):
            raise ValueError(
                f"{len(self.std)} standard deviations, but a {self.model} model has "
                f"{4 + len(self.distortion)} parameters"
            )
        return self


class Proposal(_Part):
    """A gripper pose worth adding, and what would then be known."""

    base_from_gripper: Matrix
    like: str
    expected_std: Numbers7
    """In the order of `uncertainty`."""


class CalibrationFile(_Part):
    """The content of calibration.json; everything found is null where nothing was."""

    format: Literal["jcr.calibration/1"] = FORMAT
    gripper_from_camera: Matrix | None
    scale: Positive | None
    base_from_recon: Matrix | None
    converged: bool
    backend: str
    images: list[ImageVerdict]
    residuals: PaperResiduals | None
    uncertainty: Uncertainty | None
    held_out: HeldOut | None
    observability: Observed
    robot_noise: Noise | None
    intrinsics: Lens | None
    findings: list[FindingJson] = []
    """Strongest first."""
    verdict: Verdict | None = None
    """That of the worst finding; null as long as a file of an earlier version is read."""
    warnings: list[str]
    """Findings in words: what rejects first; then what the user must act on."""
    timings_s: dict[str, float]
    version: str
    next_poses: list[Proposal] = []
    scale_check: ScaleCheck | None = None
    robot_errors: RobotErrors | None = None
    angle_ratio: AngleRatio | None = None
    depth_check: DepthCheck | None = None
    requirement: Requirement | None = None
    """None of files of earlier versions, and where nothing was found."""
    attempts: list[Attempt] = []
    """The back ends that were tried, in order; empty where camera poses were given."""
    notes: list[str] = []
    """What the stages did of their own accord, and findings in words that nobody need act on."""
    mount: Mount = "gripper"
    """base: the camera is fixed and watches what the gripper carries; gripper_from_camera and base_from_recon are then
    null, and uncertainty is that of base_from_camera, along axes of the base."""
    base_from_camera: Matrix | None = None
    gripper_from_object: Matrix | None = None
    """Of the frame of the reconstruction, scaled to metres: what the gripper carried."""

    @model_validator(mode="after")
    def _is_whole(self) -> "CalibrationFile":
        of_mount = {"gripper": "gripper_from_camera", "base": "base_from_camera"}
        name_found = of_mount[self.mount]
        found = getattr(self, name_found) is not None
        frame = "base_from_recon" if self.mount == "gripper" else "gripper_from_object"
        for name in ("scale", frame, "residuals", "uncertainty", "robot_noise"):
            if (getattr(self, name) is not None) is not found:
                raise ValueError(f"{name} is null and {name_found} is not, or the other way round")
        other = of_mount["base" if self.mount == "gripper" else "gripper"]
        if getattr(self, other) is not None:
            raise ValueError(f"{other} of a camera whose mount is {self.mount}")
        if self.converged and not found:
            raise ValueError(f"converged without a {name_found}")
        if not self.converged and not self.warnings and self.verdict is None:
            raise ValueError("not converged, and no warning says why")
        if self.verdict is not None and (
            self.verdict != verdict_of(self.findings) or self.converged is (self.verdict == "rejected")
        ):
            raise ValueError("converged, verdict and findings contradict one another")
        return self

    @property
    def parent_from_camera(self) -> list[list[float]] | None:
        """gripper_from_camera, or base_from_camera of a fixed one."""
        return self.gripper_from_camera if self.mount == "gripper" else self.base_from_camera

    @property
    def doubt(self) -> str | None:
        """Why the calibration is rejected, in words; None when it is not."""
        return None if self.converged else sentence(self.findings[0])

    @property
    def short(self) -> Finding | None:
        """That it is not as exact as is required; None where it is."""
        return next((one for one in self.findings if one.kind is Kind.NOT_EXACT_ENOUGH), None)

    @property
    def remarks(self) -> list[str]:
        """What else the user must act on, in words."""
        others = self.findings if self.converged else self.findings[1:]
        return [
            sentence(one)
            for one in others
            if one.severity != "informs" and one.kind is not Kind.NOT_EXACT_ENOUGH
        ]

    def with_findings(self, *findings: Finding) -> "CalibrationFile":
        """The same with more findings, and what is derived of them."""
        together = strongest_first((*self.findings, *findings))
        return self.model_copy(update=_derived(together, self.notes))

    @property
    def images_used(self) -> int:
        """How many images the calibration rests on."""
        return sum(image.used for image in self.images)


def _derived(findings: Sequence[Finding], notes: Sequence[str]) -> dict[str, Any]:
    """Findings as the fields of a file that hold them."""
    said = {severity: [sentence(one) for one in findings if one.severity == severity] for severity in RANK}
    more = [note for note in said["informs"] if note not in notes]
    return {
        "findings": list(findings),
        "verdict": verdict_of(findings),
        "converged": not said["rejects"],
        "warnings": [*said["rejects"], *said["warns"]],
        "notes": [*notes, *more],
    }


def calibration_file(
    capture: Capture | PosePairs,
    reconstruction: Reconstruction | PosePairs,
    hand_eye: HandEye,
    timings_s: dict[str, float],
    version: str,
    attempts: Sequence[Attempt] = (),
) -> CalibrationFile:
    """The file of a calibration of `capture`; poses that were given are capture and reconstruction in one."""
    names = [capture.images[row] for row in reconstruction.image_index[hand_eye.inliers]]
    mount = capture.mount if isinstance(capture, Capture) else "gripper"
    camera, recon = hand_eye.gripper_from_camera.tolist(), hand_eye.base_from_recon.tolist()
    return CalibrationFile(
        mount=mount,
        gripper_from_camera=camera if mount == "gripper" else None,
        base_from_recon=recon if mount == "gripper" else None,
        base_from_camera=camera if mount == "base" else None,
        gripper_from_object=recon if mount == "base" else None,
        scale=hand_eye.scale,
        backend=reconstruction.backend,
        images=image_verdicts(capture, reconstruction, hand_eye),
        residuals=hand_eye.residuals,
        uncertainty=_uncertainty(hand_eye.estimate),
        held_out=hand_eye.held_out,
        observability=Observed(
            observable=hand_eye.observability.observable,
            unobservable=list(hand_eye.observability.unobservable),
            advice=list(hand_eye.observability.advice),
        ),
        robot_noise=Noise(
            translation_mm=1e3 * hand_eye.robot_noise.translation,
            rotation_deg=float(np.degrees(hand_eye.robot_noise.rotation)),
            estimated=hand_eye.robot_noise.estimated,
        ),
        intrinsics=_lens(hand_eye.intrinsics, hand_eye.estimate.intrinsics_covariance),
        **_derived(hand_eye.findings, reconstruction.notes),
        timings_s=timings_s,
        version=version,
        next_poses=[
            Proposal(
                base_from_gripper=pose.base_from_gripper.tolist(),
                like=names[pose.like],
                expected_std=pose.expected_std.tolist(),
            )
            for pose in hand_eye.next_poses
        ],
        scale_check=hand_eye.scale_evidence.network,
        robot_errors=_robot_errors(hand_eye.robot),
        angle_ratio=hand_eye.robot.angle_ratio,
        depth_check=hand_eye.scale_evidence.depth,
        requirement=hand_eye.requirement,
        attempts=list(attempts),
    )


def _uncertainty(estimate: Estimate) -> Uncertainty:
    std = np.sqrt(np.diag(estimate.covariance))
    parts = None if estimate.budget is None else vars(estimate.budget)
    return Uncertainty(
        translation_std_mm=(1e3 * std[:3]).tolist(),
        rotation_std_deg=np.degrees(std[3:6]).tolist(),
        scale_std_percent=float(100 * std[6]),
        covariance=estimate.covariance.tolist(),
        order=list(COVARIANCE_ORDER),
        worst=worst_direction(estimate),
        budget=None
        if parts is None
        else UncertaintyBudget(**{name: _share(part) for name, part in parts.items()}),
    )


def _robot_errors(robot: RobotExamined) -> RobotErrors:
    offsets, joints = robot.joint_offsets, None
    if offsets is not None:
        degrees = np.degrees([offsets.offset, offsets.std]).T.tolist()
        joints = [JointOffset(offset_deg=offset, std_deg=std) for offset, std in degrees]
    return RobotErrors(
        systematic_deg=float(np.degrees(robot.noise.systematic)),
        translation_mm=1e3 * robot.noise.systematic_left[0],
        rotation_deg=float(np.degrees(robot.noise.systematic_left[1])),
        p=robot.systematic_p,
        joints=joints,
    )


def failed_file(
    capture: Capture,
    backend: str,
    error: NotTrustedError,
    timings_s: dict[str, float],
    version: str,
    attempts: Sequence[Attempt] = (),
) -> CalibrationFile:
    """The file of a capture whose images gave no camera poses at all."""
    return CalibrationFile(
        mount=capture.mount,
        gripper_from_camera=None,
        scale=None,
        base_from_recon=None,
        backend=backend,
        images=[ImageVerdict(image=name, used=False, reason="not registered") for name in capture.images],
        residuals=None,
        uncertainty=None,
        held_out=None,
        observability=Observed(
            observable=False,
            unobservable=["everything: no camera poses"],
            advice=list(error.remedies) or [error.what],
        ),
        robot_noise=None,
        intrinsics=_lens(capture.intrinsics),
        **_derived(_no_reconstruction(error), ()),
        timings_s=timings_s,
        version=version,
        attempts=list(attempts),
    )


def _no_reconstruction(error: NotTrustedError) -> list[Finding]:
    said = {"text": error.what, "remedy": "; ".join(error.remedies)}
    also = [
        Finding(kind=Kind.RECONSTRUCTION, severity="warns", details={"text": more}) for more in error.also
    ]
    failed = Finding(kind=Kind.NO_RECONSTRUCTION, severity="rejects", mend="reconstruction", details=said)
    return [failed, *also]


def image_verdicts(
    capture: Capture | PosePairs, reconstruction: Reconstruction | PosePairs, hand_eye: HandEye
) -> list[ImageVerdict]:
    """What became of every image of the capture."""
    row_of = {int(row): k for k, row in enumerate(reconstruction.image_index)}
    images, verdicts = hand_eye.images, []
    for row, name in enumerate(capture.images):
        k = row_of.get(row)
        if k is None:
            why = f"not registered by {reconstruction.backend}"
            verdicts.append(ImageVerdict(image=name, used=False, reason=why))
            continue
        pixels = np.nan if images.reprojection_px is None else float(images.reprojection_px[k])
        verdicts.append(
            ImageVerdict(
                image=name,
                used=bool(images.inliers[k]),
                reason=images.reasons[k],
                translation_residual_mm=1e3 * float(images.translation_residual_m[k]),
                rotation_residual_deg=float(np.degrees(images.rotation_residual_rad[k])),
                reprojection_px=None if np.isnan(pixels) else pixels,
            )
        )
    return verdicts


def _share(covariance: Float[ndarray, "7 7"]) -> Share:
    metres, radians = np.sqrt(np.diag(covariance)[:6].reshape(2, 3).mean(1))
    return Share(
        translation_mm=1e3 * float(metres),
        rotation_deg=float(np.degrees(radians)),
        covariance=covariance.tolist(),
    )


def worst_direction(estimate: Estimate) -> str:
    """The least certain direction of the translation in words, e.g. "along the optical axis: ±4.0 mm"."""
    variance, vectors = np.linalg.eigh(estimate.covariance[:3, :3])
    direction = vectors[:, 2]
    std_mm = 1e3 * float(np.sqrt(variance[2]))
    named = {
        "the optical axis": estimate.gripper_from_camera[:3, 2],
        "the image's x axis": estimate.gripper_from_camera[:3, 0],
        "the image's y axis": estimate.gripper_from_camera[:3, 1],
    }
    name, axis = max(named.items(), key=lambda item: abs(item[1] @ direction))
    if abs(axis @ direction) < np.cos(np.radians(30)):
        name = f"({', '.join(f'{x:.2f}' for x in direction)}) of the gripper"
    # An offset that no motion shows may be uncertain by metres.
    size = f"{significant(std_mm)} mm" if std_mm < 1000 else f"{significant(std_mm / 1e3)} m"
    return f"along {name}: ±{size}"


def write_calibration(path: Path, content: CalibrationFile) -> None:
    """Write calibration.json whole or not at all."""
    write_text(path, json.dumps(content.model_dump(), indent=2, allow_nan=False) + "\n")


def read_calibration(path: Path) -> CalibrationFile:
    """A calibration.json (or the one in a run folder); InputError when it is none, or of a newer format."""
    file = path / "calibration.json" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: no such file; run `jcr calibrate` or `jcr run` first")
    return _validated(_content(file), file)


@dataclass(frozen=True)
class Known:
    """A calibration as a file of anybody's states it."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"] | None
    """Of the first six of COVARIANCE_ORDER; None where the file has none."""
    parts: dict[str, Float[ndarray, "6 6"]]
    """Of the covariance, by cause; empty where the file names none."""


def read_hand_eye(path: Path) -> Known:
    """gripper_from_camera, and its covariance where the file has one; InputError where there is no transform.

    A reference.json may state `std_mm` and `std_deg`, along the axes of the gripper.
    """
    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = _content(file)
    if "format" in content:
        _validated(content, file)
    try:
        found = _Transform.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; correct it there") from None
    if found.gripper_from_camera is None:
        raise InputError(f"{file}: has no gripper_from_camera; that calibration failed")
    transform = require_rigid(np.array(found.gripper_from_camera), f"{file}: gripper_from_camera")
    if (uncertainty := found.uncertainty) is not None:
        budget = {} if uncertainty.budget is None else vars(uncertainty.budget)
        parts = {name: share.covariance for name, share in budget.items() if share is not None}
        return Known(
            transform,
            np.array(uncertainty.covariance)[:6, :6],
            {name: np.array(part)[:6, :6] for name, part in parts.items() if part is not None},
        )
    if found.std_mm is not None and found.std_deg is not None:
        std = np.r_[np.array(found.std_mm) / 1e3, np.radians(found.std_deg)]
        return Known(transform, np.diag(std**2), {})
    return Known(transform, None, {})


class _Known(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)
    covariance: Covariance
    budget: UncertaintyBudget | None = None


class _Transform(BaseModel):
    """What is asked of a file that somebody else wrote."""

    model_config = ConfigDict(allow_inf_nan=False)
    gripper_from_camera: Matrix | None = None
    uncertainty: _Known | None = None
    std_mm: Spread3 | None = None
    std_deg: Spread3 | None = None


def _content(file: Path) -> dict[str, object]:
    try:
        content = read_json(file)
    except InputError as error:
        what = str(error).removeprefix(f"{file}: ")
        raise InputError(f"{file}: damaged ({what}); run the calibration again") from None
    if not isinstance(content, dict):
        raise InputError(f"{file}: no JSON object; run the calibration again")
    return content


def _validated(content: dict[str, object], file: Path) -> CalibrationFile:
    kind = content.get("format")
    if kind != FORMAT:
        raise InputError(
            f"{file}: format {shown(kind)}, this version reads {FORMAT!r}; use the version of jcr that wrote it"
        )
    try:
        # As JSON again: there, and not among Python's values, a list may stand for a record of numbers.
        found = CalibrationFile.model_validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; run the calibration again") from None
    return _of_earlier_version(found) if found.verdict is None else found


def _of_earlier_version(found: CalibrationFile) -> CalibrationFile:
    """With its warnings as findings; only their words are known."""
    first: Severity = "warns" if found.converged else "rejects"
    findings = [
        Finding(
            kind=Kind.EARLIER_VERSION, severity="warns" if k else first, details={"text": said, "remedy": ""}
        )
        for k, said in enumerate(found.warnings)
    ]
    if found.converged and found.requirement is not None:
        budget = None if found.uncertainty is None else found.uncertainty.budget
        short = not_exact_enough(found.requirement, budget is not None and not more_images_help(budget))
        findings += [] if short is None else [short]
    return found.model_copy(update=_derived(strongest_first(findings), found.notes))


def _lens(intrinsics: Intrinsics | None, covariance: Float[ndarray, "q q"] | None = None) -> Lens | None:
    if intrinsics is None:
        return None
    std = None if covariance is None else np.sqrt(np.diag(covariance)).tolist()
    return Lens.model_validate(vars(intrinsics) | {"distortion": list(intrinsics.distortion), "std": std})
