"""What was found of a cell's further cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.findings import Finding
from jcr.geometry import skew
from jcr.records import Assessed, CellCamera, Intrinsics, Mount

if TYPE_CHECKING:
    from jcr.estimation.problem import State
    from jcr.estimation.solve import Solution


@dataclass(frozen=True, kw_only=True)
class ImageFound:
    """What became of one image."""

    image: str
    used: bool
    points: int
    """Shared with the images of the capture's own camera."""
    reprojection_px: float | None
    reason: str | None
    """Why it was not used."""


@dataclass(frozen=True, kw_only=True)
class CameraFound(Assessed):
    """Where one camera of the cell is; of one that was not found, a finding rejects it."""

    name: str
    mount: Mount
    arm: str | None
    images: tuple[ImageFound, ...]
    parent_from_camera: Float[ndarray, "4 4"] | None = None
    """base_from_camera or gripper_from_camera, of its own arm; None where it was not found."""
    covariance: Float[ndarray, "6 6"] | None = None
    """Covariance (6,6) of the step that takes the transform to the true one."""
    scene_distance: float | None = None
    """m along the optical axis to what it sees."""
    intrinsics: Intrinsics | None = None
    intrinsics_std: Float[ndarray, " q"] | None = None

    @classmethod
    def not_placed(
        cls, camera: CellCamera, why: tuple[Finding, ...], counts: Sequence[int], reasons: Sequence[str]
    ) -> "CameraFound":
        """A camera that is rejected; of each image the points that it shares, and why it is not used."""
        images = [
            ImageFound(image=image, used=False, points=count, reprojection_px=None, reason=reason)
            for image, count, reason in zip(camera.images, counts, reasons, strict=True)
        ]
        return cls(name=camera.name, mount=camera.mount, arm=camera.arm, images=tuple(images), findings=why)

    @property
    def std_at_scene(self) -> float | None:
        """m: one sigma, along the worst axis, of a point that the camera sees at that distance."""
        if self.parent_from_camera is None or self.covariance is None or self.scene_distance is None:
            return None
        arm = self.scene_distance * self.parent_from_camera[:3, 2]
        j = np.concatenate([np.eye(3), -skew(arm)], axis=1)
        return float(np.sqrt(np.linalg.eigvalsh(j @ self.covariance @ j.T)[-1]))


@dataclass(frozen=True)
class ArmFound:
    """Where another arm stands."""

    name: str
    base_from_other: Float[ndarray, "4 4"]
    """The transform from its base to that of the capture's own arm."""
    covariance: Float[ndarray, "6 6"]


@dataclass(frozen=True)
class CellFound:
    """All that was placed."""

    cameras: tuple[CameraFound, ...]
    arms: tuple[ArmFound, ...]
    answer: "Solution | None"
    """None where no camera could be placed."""
    of: "dict[str, Callable[[State], Float[ndarray, '4 4']]]" = field(default_factory=dict)
    """By camera that was placed: its parent_from_camera, wherever `answer` puts everything."""
