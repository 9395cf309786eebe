"""Records of the placement (pose in the cell) of further cameras and arms, and their file cameras.json."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, ValidationError, model_validator

from jcr.calibration.record import FindingJson, require_one_verdict
from jcr.errors import InputError, first_fault
from jcr.files import write_text
from jcr.findings import Finding, Verdict, doubt_of, strongest_first, verdict_of, warnings_of
from jcr.geometry import skew
from jcr.number_format import significant
from jcr.records import CellCamera, IntrinsicsAndStd, Mount
from jcr.records.json_fields import Covariance6, Matrix, Part, Spread, Spread3
from jcr.records.json_file import read_json

FILE, FORMAT = "cameras.json", "jcr.cameras/1"


class TransformUncertainty(Part):
    """Uncertainty (one sigma) of a transform, along the axes of its parent frame."""

    translation_std_mm: Spread3
    rotation_std_deg: Spread3
    covariance: Covariance6
    """Covariance of the step (geometry.retract) to the true transform: m, then rad, in axes of the parent frame."""
    at_scene_mm: Spread | None = None
    """One sigma, along the worst axis, of a point on the optical axis at `scene_distance_m`."""
    scene_distance_m: Spread | None = None

    @classmethod
    def of(
        cls,
        covariance: Float[ndarray, "6 6"],
        parent_from_camera: Float[ndarray, "4 4"] | None = None,
        scene_distance_m: float | None = None,
    ) -> "TransformUncertainty":
        """Return the record of the covariance (translation in m, then rotation in rad; parent axes) of a transform.

        With `parent_from_camera` and `scene_distance_m`, the record has the uncertainty of a point on the optical axis.
        """
        std, at_scene = np.sqrt(np.diag(covariance)), None
        if parent_from_camera is not None and scene_distance_m is not None:
            by_step = np.hstack([np.eye(3), -skew(scene_distance_m * parent_from_camera[:3, 2])])
            at_scene = 1e3 * float(np.sqrt(np.linalg.eigvalsh(by_step @ covariance @ by_step.T)[-1]))
        return cls(
            translation_std_mm=(1e3 * std[:3]).tolist(),
            rotation_std_deg=np.degrees(std[3:]).tolist(),
            covariance=covariance.tolist(),
            at_scene_mm=at_scene,
            scene_distance_m=scene_distance_m,
        )

    @property
    def in_words(self) -> str:
        """Standard deviations in one line of text."""
        x, y, z = self.translation_std_mm
        rx, ry, rz = self.rotation_std_deg
        scene = ""
        if self.at_scene_mm is not None and self.scene_distance_m is not None:
            scene = f"; ± {significant(self.at_scene_mm)} mm at the scene, {self.scene_distance_m:.2f} m away"
        return f"± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ){scene}"


class ImageUse(Part):
    """Use of one image in the placement of its camera."""

    image: str
    used: bool
    points: int
    """Number of points shared with the images of the capture's own camera."""
    reprojection_px: float | None
    reason: str | None
    """Reason why the image was not used; null for a used image."""


class CameraPlacement(Part):
    """Placement of one camera other than the capture's own: pose, uncertainty, intrinsics, findings.

    The pose is null if the camera could not be placed.
    """

    name: str
    mount: Mount
    arm: str | None
    """Name of the camera's arm; null: the capture's own arm."""
    base_from_camera: Matrix | None = None
    """Pose of a fixed camera; null for one on a gripper."""
    gripper_from_camera: Matrix | None = None
    """Pose of a camera on a gripper; null for a fixed one."""
    uncertainty: TransformUncertainty | None = None
    intrinsics: IntrinsicsAndStd | None = None
    images: list[ImageUse] = Field(alias="pictures")
    findings: list[FindingJson] = []
    """Findings about the camera, the most severe first."""
    verdict: Verdict
    """Verdict of the worst finding."""
    converged: bool
    warnings: list[str]
    """Messages of the findings that reject or warn."""

    @classmethod
    def of(
        cls,
        camera: CellCamera,
        findings: Sequence[Finding],
        points: Sequence[int] = (),
        reasons: Mapping[int, str] = {},
        px: Mapping[int, float] = {},
        **placed: Any,
    ) -> "CameraPlacement":
        """Return the placement of a camera with its findings; `placed` are fields: transform, uncertainty, intrinsics.

        `points` has for each image the number of points shared with the scene. By image number, `px` has the
        reprojection errors (px) of used images, and `reasons` the reasons why other images are not used.
        """
        images = [
            ImageUse(
                image=image,
                used=k in px,
                points=points[k] if points else 0,
                reprojection_px=px.get(k),
                reason=None if k in px else reasons.get(k, "the camera was not placed"),
            )
            for k, image in enumerate(camera.images)
        ]
        found, verdict = strongest_first(findings), verdict_of(findings)
        content = {
            "pictures": images,
            "findings": list(found),
            "warnings": list(warnings_of(found)),
            **placed,
        }
        content |= {"verdict": verdict, "converged": verdict != "rejected"}
        return cls(name=camera.name, mount=camera.mount, arm=camera.arm, **content)

    @model_validator(mode="after")
    def _is_whole(self) -> "CameraPlacement":
        """Check that transform, uncertainty, findings and verdict are consistent; raise ValueError if not."""
        if (self.parent_from_camera is None) is not (self.uncertainty is None):
            raise ValueError("a transform without its uncertainty, or the other way round")
        if self.base_from_camera is not None and self.mount == "gripper":
            raise ValueError("base_from_camera of a camera that moves with the gripper")
        if self.converged and self.parent_from_camera is None:
            raise ValueError("converged without a transform")
        require_one_verdict(self.findings, self.verdict, self.converged)
        return self

    @property
    def parent_from_camera(self) -> Float[ndarray, "4 4"] | None:
        """Pose base_from_camera of a fixed camera, else gripper_from_camera; None if not placed."""
        pose = self.base_from_camera if self.mount == "base" else self.gripper_from_camera
        return None if pose is None else np.array(pose)

    @property
    def covariance(self) -> Float[ndarray, "6 6"] | None:
        """Covariance of `parent_from_camera`: translation (m), rotation (rad); parent axes; None if not placed."""
        return None if self.uncertainty is None else np.array(self.uncertainty.covariance)

    @property
    def doubt(self) -> str | None:
        """Reason of the rejection; None if the placement is accepted."""
        return doubt_of(self.findings)

    @property
    def in_words(self) -> list[str]:
        """Lines of text for the terminal: pose, uncertainty, warnings, unused images."""
        if self.parent_from_camera is None or self.uncertainty is None:
            return [f"{self.name}: not placed: {self.doubt}"]
        arm = "" if self.arm is None else f" of arm {self.arm}"
        name = "base_from_camera" if self.mount == "base" else f"gripper_from_camera{arm}"
        used = [image for image in self.images if image.used]
        points = sum(image.points for image in used)
        first = "rejected: " if self.doubt else ""
        return [
            f"{self.name}: {name} ({len(used)} of {len(self.images)} images, {points} points)",
            *_rows(self.parent_from_camera),
            f"  {self.uncertainty.in_words}",
            *(f"  {'' if k else first}{text}" for k, text in enumerate(self.warnings)),
            *(f"  not used: {image.image}: {image.reason}" for image in self.images if not image.used),
        ]


class ArmPlacement(Part):
    """Placement of another arm: pose of its base in the base frame of the capture's own arm."""

    name: str
    base_from_other_base: Matrix
    """Pose of the other arm's base in the base frame of the capture's own arm."""
    uncertainty: TransformUncertainty


class CamerasFile(Part):
    """Content of the file cameras.json: placements of other arms and of all cameras but the capture's own."""

    format: Literal["jcr.cameras/1"] = FORMAT
    cameras: list[CameraPlacement]
    arms: list[ArmPlacement]
    version: str

    @property
    def rejected(self) -> list[CameraPlacement]:
        """Placements of the rejected cameras."""
        return [camera for camera in self.cameras if not camera.converged]

    def base_from_camera(
        self,
        camera: CellCamera,
        found: CameraPlacement,
        base_from_gripper: Mapping[int, Float[ndarray, "4 4"]],
    ) -> list[Float[ndarray, "4 4"]]:
        """Return base_from_camera of every used image of `camera` (placement `found`), if its gripper pose is known.

        `base_from_gripper` has poses of the capture's own arm by image number of the capture. The list is empty if the
        camera was not placed.
        """
        parent_from_camera = found.parent_from_camera
        names = {image.image for image in found.images if image.used}
        used = [k for k, name in enumerate(camera.images) if name in names]
        if parent_from_camera is None or camera.mount == "base":
            return [] if parent_from_camera is None else [parent_from_camera] * len(used)
        if camera.base_from_gripper is not None:
            base = next(np.array(arm.base_from_other_base) for arm in self.arms if arm.name == camera.arm)
            return [base @ camera.base_from_gripper[k] @ parent_from_camera for k in used]
        rows = [] if camera.frame is None else camera.frame[used].tolist()
        return [base_from_gripper[row] @ parent_from_camera for row in rows if row in base_from_gripper]

    def as_json(self) -> dict[str, Any]:
        """Return the content as a JSON object, with the names of the file."""
        return self.model_dump(by_alias=True)


def write_cameras(folder: Path, content: CamerasFile) -> None:
    """Write cameras.json to a run folder, atomically."""
    write_text(folder / FILE, json.dumps(content.as_json(), indent=2, allow_nan=False) + "\n")


def read_cameras(folder: Path) -> CamerasFile | None:
    """Read cameras.json of a run folder, None if there is no such file; raise InputError if it is damaged."""
    file = folder / FILE
    if not file.is_file():
        return None
    read_json(file)  # raises InputError with the place of a fault
    try:
        return CamerasFile.model_validate_json(file.read_bytes(), strict=True)
    except ValidationError as error:
        raise InputError(
            f"{file}: {first_fault(error)}; place the cameras again (jcr run, jcr add-camera)"
        ) from None


def in_words(content: CamerasFile) -> list[str]:
    """Return lines of text that state each camera's and each further arm's pose (m), uncertainty and warnings."""
    lines = [line for camera in content.cameras for line in camera.in_words]
    for arm in content.arms:
        rows = _rows(np.array(arm.base_from_other_base))
        lines += [f"base_from_{arm.name}_base", *rows, f"  {arm.uncertainty.in_words}"]
    return lines


def _rows(a_from_b: Float[ndarray, "4 4"]) -> list[str]:
    """Return a transform as four indented lines of text."""
    with np.printoptions(precision=6, suppress=True):
        return [f"  {row}" for row in str(a_from_b).splitlines()]
