"""Images of a further camera: their registration in the reconstruction of the capture's own camera, and their rigs."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import usable_intrinsics
from jcr.cell.placement import CameraPlacement
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import CellCamera, Intrinsics
from jcr.sfm.register import GATE_PX, KnownImages, Registration, features, registration, shared_points

FOCAL_OF_WIDTH = 0.9
"""Initial focal length of a camera without given intrinsics, in widths of the image."""
CLEARLY_MORE = 1.1
"""Factor of the points that agree with given intrinsics, from which RANSAC alone does not explain more."""


def localise(known: KnownImages, image: UInt8[ndarray, "h w 3"], camera: CellCamera) -> Registration | int:
    """Return the registration of an image, or the number of points that it shares where these are too few.

    A focal length is estimated where none is given, or where another one explains clearly more points: wrong intrinsics
    leave the points that agree with a wrong pose.
    """
    given, _ = usable_intrinsics(camera.intrinsics)
    width, height = camera.image_size
    focal = FOCAL_OF_WIDTH * max(width, height)
    start = given or Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    gate_px = 2 * GATE_PX * max(1.0, start.width / 1600)
    shared = shared_points(known, features(image, start))
    free = registration(shared, start, "free", gate_px)
    if given is None:
        return free
    found = registration(shared, start, "given", gate_px)
    return free if _count(free) > CLEARLY_MORE * _count(found) else found


def _count(found: Registration | int) -> int:
    """Return the number of shared points."""
    return len(found.x_px) if isinstance(found, Registration) else found


@dataclass(frozen=True, kw_only=True)
class CameraViews:
    """Images of one camera in their order, and where those that are used belong among the rigs."""

    camera: CellCamera
    found: tuple[Registration | int, ...]
    """Registration of each image, or the number of points that it shares with the scene where too few."""
    reasons: Mapping[int, str] = field(default_factory=dict)
    """Reasons why registered images are not used, by their numbers."""
    rig: Int[ndarray, " k"] | None = None
    """Rig of each image, -1 where it is not used; None before the camera is mounted."""
    rig_from_camera: Float[ndarray, "4 4"] | None = None
    """Pose on the rig; None for the rig's first camera."""
    arm: int | None = None
    """Number of its arm; None for a fixed camera."""
    findings: tuple[Finding, ...] = ()

    @property
    def registered(self) -> dict[int, Registration]:
        """Registered images by their numbers."""
        return {k: one for k, one in enumerate(self.found) if isinstance(one, Registration)}

    @property
    def used(self) -> dict[int, Registration]:
        """Images that are used, by their numbers."""
        assert self.rig is not None
        return {k: one for k, one in self.registered.items() if self.rig[k] >= 0}

    @property
    def rows(self) -> Int[ndarray, " k"]:
        """Numbers of the registered images."""
        return np.array(list(self.registered), dtype=int)

    @property
    def places(self) -> Float[ndarray, "k 4 4"]:
        """recon_from_camera of the registered images."""
        return np.stack([one.pose.a_from_camera for one in self.registered.values()])

    @property
    def covariances(self) -> Float[ndarray, "k 6 6"]:
        """Covariances of the steps of `places`."""
        return np.stack([one.pose.covariance[:6, :6] for one in self.registered.values()])

    @property
    def counts(self) -> list[int]:
        """Number of shared points of each image."""
        return [_count(one) for one in self.found]

    @property
    def intrinsics(self) -> Intrinsics:
        """Given intrinsics, or those of the image with most points."""
        intrinsics, _ = usable_intrinsics(self.camera.intrinsics)
        return intrinsics or max(self.registered.values(), key=_count).pose.camera

    def reason(self, image: int) -> str | None:
        """Return the reason why an image is not used; None for one that is."""
        if image in self.registered:
            return self.reasons.get(image)
        return f"shares {self.found[image]} points with the mapped scene"

    def without(self, reasons: Mapping[int, str]) -> "CameraViews":
        """Return the views with the reasons why further images are not used."""
        return replace(self, reasons={**self.reasons, **reasons})

    def refused(
        self, kind: FindingKind, concerns: Concerns = "none", *images: str, **numbers: Any
    ) -> CameraPlacement:
        """Return the camera rejected for a finding, as Finding.of makes it."""
        return self.not_placed(Finding.of(kind, "rejects", concerns, *images, **numbers))

    def not_placed(self, *why: Finding) -> CameraPlacement:
        """Return the camera with the findings for which it is not placed."""
        reasons = [self.reason(k) for k in range(len(self.found))]
        return CameraPlacement.rejected(self.camera, why, self.counts, reasons)
