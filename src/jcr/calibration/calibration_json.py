"""calibration.json: what a calibration is on disk."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr.capture.plain_files import read_json
from jcr.errors import InputError
from jcr.files import write_text
from jcr.geometry import require_rigid
from jcr.handeye.equation import ASSUMED_NOISE
from jcr.handeye.next_poses import NextPose, next_poses
from jcr.records import (
    COVARIANCE_ORDER,
    Capture,
    HandEye,
    ImageVerdict,
    Intrinsics,
    PosePairs,
    Reconstruction,
)
from jcr.rounding import significant

FORMAT = "jcr.calibration/1"
PROPOSED = 2
"""Gripper poses proposed after a calibration."""
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Residuals(_Part):
    """The paper's residuals over consecutive used images."""

    translation: float
    rotation: float


class Uncertainty(_Part):
    """One-sigma uncertainty; axes of the gripper frame."""

    translation_std_mm: list[float]
    rotation_std_deg: list[float]
    scale_std_percent: float
    covariance: list[list[float]]
    order: list[str]
    worst: str


class HeldOutError(_Part):
    translation_mm: float
    rotation_deg: float
    reprojection_px: float | None
    how: str


class Observed(_Part):
    observable: bool
    unobservable: list[str]
    advice: list[str]


class Noise(_Part):
    translation_mm: float
    rotation_deg: float
    estimated: bool


class Image(_Part):
    image: str
    used: bool
    reason: str | None
    translation_residual_mm: float | None
    rotation_residual_deg: float | None
    reprojection_px: float | None = None


class Lens(_Part):
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float]
    width: int
    height: int


class NetworkScale(_Part):
    """How far a metric network's own lengths are from the robot's (positive: too long), and how sure that is."""

    off_percent: float
    std_percent: float


class Proposal(_Part):
    """A gripper pose worth adding, and what would then be known."""

    base_from_gripper: Matrix
    like: str
    expected_std: list[float]
    """In the order of `uncertainty`."""


class CalibrationFile(_Part):
    """The content of calibration.json; everything found is null where nothing was."""

    format: Literal["jcr.calibration/1"] = FORMAT
    gripper_from_camera: Matrix | None
    scale: float | None
    base_from_recon: Matrix | None
    converged: bool
    backend: str
    images: list[Image]
    residuals: Residuals | None
    uncertainty: Uncertainty | None
    held_out: HeldOutError | None
    observability: Observed
    robot_noise: Noise | None
    intrinsics: Lens | None
    warnings: list[str]
    timings_s: dict[str, float]
    version: str
    next_poses: list[Proposal] = []
    scale_check: NetworkScale | None = None


def calibration_file(
    capture: Capture | PosePairs,
    reconstruction: Reconstruction | PosePairs,
    hand_eye: HandEye,
    timings_s: dict[str, float],
    version: str,
) -> CalibrationFile:
    """The file of a calibration of `capture`; poses that were given are capture and reconstruction in one."""
    std = np.sqrt(np.diag(hand_eye.covariance))
    held_out, check = hand_eye.held_out, hand_eye.scale_check
    names = [capture.images[row] for row in reconstruction.image_index[hand_eye.inliers]]
    return CalibrationFile(
        gripper_from_camera=hand_eye.gripper_from_camera.tolist(),
        scale=hand_eye.scale,
        base_from_recon=hand_eye.base_from_recon.tolist(),
        converged=hand_eye.converged,
        backend=reconstruction.backend,
        images=[
            Image(**vars(verdict), reprojection_px=pixels)
            for verdict, pixels in image_verdicts(capture, reconstruction, hand_eye)
        ],
        residuals=Residuals(translation=hand_eye.residual_translation, rotation=hand_eye.residual_rotation),
        uncertainty=Uncertainty(
            translation_std_mm=(1e3 * std[:3]).tolist(),
            rotation_std_deg=np.degrees(std[3:6]).tolist(),
            scale_std_percent=float(100 * std[6]),
            covariance=hand_eye.covariance.tolist(),
            order=list(COVARIANCE_ORDER),
            worst=worst_direction(hand_eye),
        ),
        held_out=None if held_out is None else HeldOutError(**vars(held_out)),
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
        intrinsics=_lens(hand_eye.intrinsics),
        warnings=[*hand_eye.warnings, *reconstruction.notes],
        timings_s=timings_s,
        version=version,
        next_poses=[
            Proposal(
                base_from_gripper=pose.base_from_gripper.tolist(),
                like=names[pose.like],
                expected_std=pose.expected_std.tolist(),
            )
            for pose in _proposals(capture, reconstruction, hand_eye)
        ],
        scale_check=None if check is None else NetworkScale(**vars(check)),
    )


def _proposals(
    capture: Capture | PosePairs, reconstruction: Reconstruction | PosePairs, hand_eye: HandEye
) -> list[NextPose]:
    """The poses that would shrink the reported uncertainty most; an X that is not trusted is not used.

    What they would leave is the reported standard deviation, less by the share by which their information shrinks
    that expected of the poses alone: bundle adjustment, lens and correlated errors make the two differ. No views make
    up for a given lens that is wrong, nor for a robot that is worse than assumed.
    """
    used = capture.base_from_gripper[reconstruction.image_index[hand_eye.inliers]]
    noise = (hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation)
    by_lens = np.zeros(7) if hand_eye.lens_shift is None else hand_eye.lens_shift
    if hand_eye.converged:
        expected, proposed = next_poses(used, PROPOSED, hand_eye.gripper_from_camera, noise)
        share = np.sqrt(np.diag(hand_eye.covariance) - by_lens**2) / expected
    else:
        at_least = max(noise[0], ASSUMED_NOISE[0]), max(noise[1], ASSUMED_NOISE[1])
        _, proposed = next_poses(used, PROPOSED, noise=at_least)
        share = 1.0
    return [replace(pose, expected_std=np.hypot(pose.expected_std * share, by_lens)) for pose in proposed]


def failed_file(
    capture: Capture, backend: str, reason: str, timings_s: dict[str, float], version: str
) -> CalibrationFile:
    """The file of a capture whose images gave no camera poses at all."""
    return CalibrationFile(
        gripper_from_camera=None,
        scale=None,
        base_from_recon=None,
        converged=False,
        backend=backend,
        images=[
            Image(
                image=name,
                used=False,
                reason="not registered",
                translation_residual_mm=None,
                rotation_residual_deg=None,
            )
            for name in capture.images
        ],
        residuals=None,
        uncertainty=None,
        held_out=None,
        observability=Observed(
            observable=False, unobservable=["everything: no camera poses"], advice=[reason]
        ),
        robot_noise=None,
        intrinsics=_lens(capture.intrinsics),
        warnings=[reason],
        timings_s=timings_s,
        version=version,
    )


def image_verdicts(
    capture: Capture | PosePairs, reconstruction: Reconstruction | PosePairs, hand_eye: HandEye
) -> list[tuple[ImageVerdict, float | None]]:
    """What became of every image of the capture, with its median reprojection error."""
    row_of = {int(row): k for k, row in enumerate(reconstruction.image_index)}
    verdicts = []
    for row, name in enumerate(capture.images):
        k = row_of.get(row)
        if k is None:
            verdicts.append(
                (ImageVerdict(name, False, f"not registered by {reconstruction.backend}", None, None), None)
            )
            continue
        verdict = ImageVerdict(
            name,
            bool(hand_eye.inliers[k]),
            hand_eye.reasons[k],
            1e3 * float(hand_eye.translation_residual_m[k]),
            float(np.degrees(hand_eye.rotation_residual_rad[k])),
        )
        pixels = None if hand_eye.reprojection_px is None else float(hand_eye.reprojection_px[k])
        verdicts.append((verdict, None if pixels is None or np.isnan(pixels) else pixels))
    return verdicts


def worst_direction(hand_eye: HandEye) -> str:
    """The least certain direction of the offset in words, e.g. "along the optical axis: ±4.0 mm"."""
    variance, vectors = np.linalg.eigh(hand_eye.covariance[:3, :3])
    direction = vectors[:, 2]
    std_mm = 1e3 * float(np.sqrt(variance[2]))
    named = {
        "the optical axis": hand_eye.gripper_from_camera[:3, 2],
        "the image's x axis": hand_eye.gripper_from_camera[:3, 0],
        "the image's y axis": hand_eye.gripper_from_camera[:3, 1],
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
    try:
        content = json.loads(file.read_bytes().decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: damaged ({error}); run the calibration again") from None
    kind = content.get("format") if isinstance(content, dict) else None
    if kind != FORMAT:
        raise InputError(f"{file}: format {kind!r}, this version reads {FORMAT!r}; use the jcr that wrote it")
    try:
        parsed = CalibrationFile.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {place}: {first['msg']}; run the calibration again") from None
    if parsed.gripper_from_camera is not None:
        require_rigid(np.array(parsed.gripper_from_camera), f"{file}: gripper_from_camera")
    return parsed


def read_hand_eye(path: Path) -> tuple[Float[ndarray, "4 4"], Float[ndarray, "7 7"] | None]:
    """gripper_from_camera, and its covariance where the file has one; InputError where there is neither."""
    file = path
    if path.is_dir():
        names = ("calibration.json", "reference.json")
        file = next((path / name for name in names if (path / name).is_file()), path / names[0])
    if not file.is_file():
        raise InputError(f"{path}: no calibration.json or reference.json there; name a run folder or a file")
    content = read_json(file)
    matrix = content.get("gripper_from_camera") if isinstance(content, dict) else None
    if isinstance(content, dict) and content.get("format", FORMAT) != FORMAT:
        raise InputError(f"{file}: format {content['format']!r}, this version reads {FORMAT!r}; update jcr")
    if matrix is None:
        raise InputError(f"{file}: has no gripper_from_camera; the calibration it is from found none")
    try:
        transform = require_rigid(
            np.array(matrix, dtype=np.float64).reshape(4, 4), f"{file}: gripper_from_camera"
        )
    except (TypeError, ValueError) as error:
        raise InputError(str(error) if isinstance(error, InputError) else f"{file}: no 4x4 matrix") from None
    uncertainty = content.get("uncertainty")
    covariance = None if not uncertainty else np.array(uncertainty["covariance"], dtype=np.float64)
    return transform, covariance


def _lens(intrinsics: Intrinsics | None) -> Lens | None:
    if intrinsics is None:
        return None
    return Lens.model_validate(vars(intrinsics) | {"distortion": list(intrinsics.distortion)})


def intrinsics_of(lens: Lens) -> Intrinsics:
    """The record of a file's lens."""
    k1, k2, p1, p2, k3 = lens.distortion
    return Intrinsics(lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, (k1, k2, p1, p2, k3))
