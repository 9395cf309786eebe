"""Points that the images of a further camera share with images of known pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import usable_intrinsics
from jcr.cell.localise import Shared, distance
from jcr.cell.placement import CameraPlacement
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import CellCamera, Intrinsics


@dataclass(frozen=True)
class CameraViews:
    """Points that the images of one camera share with images of known pose, in the order of its images."""

    camera: CellCamera
    shared: tuple[Shared | None, ...]
    counts: tuple[int, ...]
    """Number of shared points of each image."""
    reasons: tuple[str | None, ...]
    """Reason why each image is not used; None for used ones."""

    @staticmethod
    def of(camera: CellCamera, found: Sequence[Shared | int]) -> "CameraViews":
        """Return the views of a camera from the results of localised() for its images."""
        return CameraViews(
            camera,
            tuple(one if isinstance(one, Shared) else None for one in found),
            tuple(len(one.x_px) if isinstance(one, Shared) else one for one in found),
            tuple(
                None if isinstance(one, Shared) else f"shares {one} points with the mapped scene"
                for one in found
            ),
        )

    @property
    def rows(self) -> Int[ndarray, " k"]:
        """Images that were localised."""
        return np.flatnonzero([one is not None for one in self.shared])

    @property
    def places(self) -> Float[ndarray, "k 4 4"]:
        """recon_from_camera of the localised images."""
        return np.stack([one.recon_from_camera for one in self.shared if one is not None])

    @property
    def distance(self) -> float:
        """Median distance of the scene (recon units)."""
        return float(np.median([distance(one) for one in self.shared if one is not None]))

    @property
    def intrinsics(self) -> Intrinsics:
        """Given, or as the image with most points has it."""
        intrinsics, _ = usable_intrinsics(self.camera.intrinsics)
        best = max((one for one in self.shared if one is not None), key=lambda one: len(one.x_px))
        return intrinsics or best.intrinsics

    @property
    def agrees_with_given(self) -> bool:
        """Whether all places were found with intrinsics that were given, and none with a focal length of its own."""
        intrinsics, _ = usable_intrinsics(self.camera.intrinsics)
        return all(one is None or one.intrinsics == intrinsics for one in self.shared)

    def without(self, reasons: Mapping[int, str]) -> "CameraViews":
        """Return the views with the reasons why some images are not used."""
        return replace(self, reasons=tuple(reasons.get(k, before) for k, before in enumerate(self.reasons)))

    def refused(
        self, kind: FindingKind, concerns: Concerns = "none", *images: str, **numbers: Any
    ) -> CameraPlacement:
        """Return the camera rejected for a finding, as Finding.of makes it."""
        return self.not_placed(Finding.of(kind, "rejects", concerns, *images, **numbers))

    def not_placed(self, *why: Finding) -> CameraPlacement:
        """Return the camera with the findings for which it is not placed."""
        return CameraPlacement.rejected(self.camera, why, self.counts, self.reasons)
