"""calibration.json: what a calibration is on disk."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError, model_validator

from jcr.arrays_json import Covariance7, Matrix, Numbers7, Part, Spread
from jcr.calibration.findings_json import FindingJson, derived, require_one_verdict
from jcr.calibration.uncertainty_json import SeenJson, Uncertainty, mm_and_deg
from jcr.capture.plain_files import first_fault, read_json, shown
from jcr.errors import InputError
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
    without_consequences,
)
from jcr.intrinsics_json import IntrinsicsAndStd, IntrinsicsJson, Positive
from jcr.records import (
    Attempt,
    BoardFound,
    Capture,
    DepthCheck,
    HandEye,
    ImageVerdict,
    LeaveOneOut,
    LengthCheck,
    Mount,
    PaperResiduals,
    PosePairs,
    Reconstruction,
    Requirement,
    RobotExamined,
    ScaleCheck,
)

FORMAT = "jcr.calibration/1"
OF_HAND_EYE = (
    *("gripper_from_camera", "base_from_recon", "scale", "residuals", "observability", "requirement"),
    "with_given_intrinsics",
)
"""Fields of the file that a HandEye has by the same names."""


class Observed(Part):
    observable: bool
    unobservable: list[str]
    advice: list[str]


class Noise(Part):
    translation_mm: float
    rotation_deg: float
    estimated: bool


class JointOffset(Part):
    """True angle of a joint less the reported one."""

    offset_deg: float
    std_deg: Spread


class RobotErrors(Part):
    """Systematic errors of the gripper poses, as estimated."""

    systematic_deg: Spread
    """One sigma of the joint offsets where the arm is known, else of the gripper's rotation."""
    translation_mm: Spread
    """What of them is left in the poses per axis, after the effective hand-eye transform took its part."""
    rotation_deg: Spread
    joints: list[JointOffset] | None = None
    """The joints from the base on; null where the arm is not known."""

    @classmethod
    def of(cls, robot: RobotExamined) -> "RobotErrors":
        """What the residuals show of a robot."""
        offsets, joints = robot.joint_offsets, None
        if offsets is not None:
            degrees = np.degrees([offsets.offset, offsets.std]).T.tolist()
            joints = [JointOffset(offset_deg=offset, std_deg=std) for offset, std in degrees]
        return cls(
            systematic_deg=float(np.degrees(robot.noise.systematic)),
            **mm_and_deg(*robot.noise.systematic_left),
            joints=joints,
        )


class GivenIntrinsicsKept(Part):
    """The transform for who keeps the intrinsics that were given, and how exact that pair is."""

    gripper_from_camera: Matrix
    covariance: Covariance7
    """In the order of `uncertainty`."""
    intrinsics: IntrinsicsJson
    seen: SeenJson
    differs_mm: Spread
    """From where the estimated intrinsics and their transform place a point at the centre of the image."""


class Proposal(Part):
    """A gripper pose worth adding, and what would then be known."""

    base_from_gripper: Matrix
    like: str
    expected_std: Numbers7
    """One standard deviation of each unknown once this pose is added, in the order of `uncertainty`."""
    within_95_mm: Spread | None = None
    """Of a point seen as in `uncertainty.seen`."""
    rotation_95_deg: Spread | None = None


class CalibrationFile(Part):
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
    held_out: LeaveOneOut | None
    observability: Observed
    robot_noise: Noise | None
    intrinsics: IntrinsicsAndStd | None
    findings: list[FindingJson]
    """Findings of the checks, strongest first."""
    verdict: Verdict
    """Severity of the worst finding."""
    warnings: list[str]
    """Findings in words: what rejects first; then what the user must act on."""
    timings_s: dict[str, float]
    version: str
    next_poses: list[Proposal] = []
    scale_check: ScaleCheck | None = None
    robot_errors: RobotErrors | None = None
    depth_check: DepthCheck | None = None
    lengths: list[LengthCheck] = []
    """Every length that was compared with the robot's positions."""
    board: BoardFound | None = None
    """Null where no board took part beside features."""
    requirement: Requirement | None = None
    """Null where nothing was found."""
    attempts: list[Attempt] = []
    """The back ends that were tried, in order; empty where camera poses were given."""
    notes: list[str] = []
    """What the stages did of their own accord, and findings in words that require no action."""
    mount: Mount = "gripper"
    """base: the camera is fixed and watches what the gripper carries; gripper_from_camera and base_from_recon are then
    null, and uncertainty is that of base_from_camera, along axes of the base."""
    with_given_intrinsics: GivenIntrinsicsKept | None = None
    """`gripper_from_camera` belongs to `intrinsics`; this belongs to those that were given. Null where none were."""
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
        require_one_verdict(self.findings, self.verdict, self.converged)
        return self

    @property
    def parent_from_camera(self) -> list[list[float]] | None:
        """gripper_from_camera, or base_from_camera of a fixed one."""
        return self.gripper_from_camera if self.mount == "gripper" else self.base_from_camera

    @property
    def doubt(self) -> str | None:
        """Why the calibration is rejected, in words; None when it is not."""
        return doubt_of(self.findings)

    @property
    def short(self) -> Finding | None:
        """That it is not as exact as is required; None where it is."""
        return next((one for one in self.findings if one.kind is FindingKind.NOT_EXACT_ENOUGH), None)

    @property
    def remarks(self) -> list[str]:
        """What else the user must act on than why it is rejected or short, in words; not what that explains."""
        first = self.short if self.converged else self.findings[0]
        said = without_consequences(self.findings)
        return [sentence(one) for one in said if one.severity != "informs" and one is not first]

    def with_findings(self, *findings: Finding) -> "CalibrationFile":
        """The same with more findings, and what is derived of them."""
        together = strongest_first((*self.findings, *findings))
        return self.model_copy(update=_derived(together, self.notes))

    @property
    def mostly_systematic(self) -> bool:
        """Whether most of ± is systematic errors of the robot, which more images of the same region leave."""
        budget = None if self.uncertainty is None else self.uncertainty.budget
        return budget is not None and budget.mostly_systematic

    @property
    def images_used(self) -> int:
        """How many images the calibration rests on."""
        return sum(image.used for image in self.images)


def _derived(findings: Sequence[Finding], notes: Sequence[str]) -> dict[str, Any]:
    """Findings as the fields of a file that hold them."""
    informs = [sentence(one) for one in findings if one.severity == "informs"]
    return derived(findings) | {"notes": [*notes, *(note for note in informs if note not in notes)]}


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
    proposals = [vars(pose) | {"like": names[pose.like]} for pose in hand_eye.next_poses]
    noise, measured = hand_eye.robot_noise, hand_eye.scale_evidence
    content = {
        "mount": "gripper",
        **{name: getattr(hand_eye, name) for name in OF_HAND_EYE},
        "backend": reconstruction.backend,
        "images": image_verdicts(capture, reconstruction, hand_eye),
        "uncertainty": Uncertainty.of(hand_eye.estimate, hand_eye.in_use),
        "held_out": hand_eye.leave_one_out,
        "robot_noise": mm_and_deg(noise.translation, noise.rotation) | {"estimated": noise.estimated},
        "intrinsics": IntrinsicsAndStd.of(hand_eye.intrinsics, hand_eye.estimate.intrinsics_std),
        "timings_s": timings_s,
        "version": version,
        "next_poses": [{name: pose[name] for name in Proposal.model_fields} for pose in proposals],
        "scale_check": measured.network,
        "robot_errors": RobotErrors.of(hand_eye.robot),
        "depth_check": measured.depth,
        "lengths": list(measured.lengths),
        "board": measured.board,
        "attempts": list(attempts),
    }
    if isinstance(capture, Capture) and capture.mount == "base":
        # Of a fixed camera the transform is another one, and there is no name for it with the given intrinsics.
        fixed = {"mount": "base", "base_from_camera": hand_eye.gripper_from_camera}
        fixed |= {"gripper_from_object": hand_eye.base_from_recon, "with_given_intrinsics": None}
        content |= fixed | {"gripper_from_camera": None, "base_from_recon": None}
    return CalibrationFile.model_validate(content | _derived(hand_eye.findings, reconstruction.notes))


def failed_file(
    capture: Capture,
    backend: str,
    findings: Sequence[Finding],
    timings_s: dict[str, float],
    version: str,
    attempts: Sequence[Attempt] = (),
) -> CalibrationFile:
    """The file of a capture whose images gave no camera poses at all; `findings` are the reasons, strongest first."""
    nothing = (
        "gripper_from_camera",
        "base_from_recon",
        "scale",
        "residuals",
        "uncertainty",
        "held_out",
        "robot_noise",
    )
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
    return CalibrationFile.model_validate(content | _derived(findings, ()))


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


def write_calibration(path: Path, content: CalibrationFile) -> None:
    """Write calibration.json whole or not at all."""
    write_text(path, json.dumps(content.model_dump(), indent=2, allow_nan=False) + "\n")


def read_calibration(path: Path) -> CalibrationFile:
    """A calibration.json (or the one in a run folder); InputError when it is none, or of another format."""
    file = path / "calibration.json" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"{file}: no such file; run `jcr calibrate` or `jcr run` first")
    return validated(read_content(file), file)


def read_content(file: Path) -> dict[str, object]:
    """The object in a calibration's file; InputError where there is none."""
    try:
        content = read_json(file)
    except InputError as error:
        what = str(error).removeprefix(f"{file}: ")
        raise InputError(f"{file}: damaged ({what}); run the calibration again") from None
    if not isinstance(content, dict):
        raise InputError(f"{file}: no JSON object; run the calibration again")
    return content


def validated(content: dict[str, object], file: Path) -> CalibrationFile:
    """A calibration of its file's content; InputError when it is none, or of another format."""
    kind = content.get("format")
    if kind != FORMAT:
        raise InputError(
            f"{file}: format {shown(kind)}, this version reads {FORMAT!r}; run the calibration again"
        )
    try:
        # As JSON again: there, and not among Python's values, a list may stand for a record of numbers.
        return CalibrationFile.model_validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; run the calibration again") from None
