"""Images of a further camera that are registered in the reconstruction, and the rigs that they belong to."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import usable_intrinsics
from jcr.cell.localise import count, distance
from jcr.cell.placement import CameraPlacement
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import CellCamera, Intrinsics
from jcr.sfm.register import Registration


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
        return [count(one) for one in self.found]

    @property
    def distance(self) -> float:
        """Median distance of the scene (recon units)."""
        return float(np.median([distance(one) for one in self.registered.values()]))

    @property
    def intrinsics(self) -> Intrinsics:
        """Given intrinsics, or those of the image with most points."""
        intrinsics, _ = usable_intrinsics(self.camera.intrinsics)
        best = max(self.registered.values(), key=count)
        return intrinsics or best.pose.camera

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
