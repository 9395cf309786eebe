"""Reconstruction from images alone up to one similarity, and the cloud that is made of it in the base frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.records.capture import Intrinsics


@dataclass(frozen=True)
class Body:
    """A board, or a single tag, among the points of tracks: rigid, and unrelated to other bodies."""

    number: int
    """Number of the tag; 0 for a board."""
    point: Int[ndarray, " _"]
    """Rows of `Tracks.points_in_recon`, its corners."""
    x_in_body: Float[ndarray, "_ 3"]
    """Corners as printed, z = 0; in metres, or in sides where the side is unknown."""


@dataclass(frozen=True, kw_only=True)
class Boards:
    """The boards or tags of one `--board`."""

    spec: str
    """The boards as `--board` names them."""
    side: float
    """Side of a square or a tag, in the unit of `Body.x_in_body`: metres, or 1 where it is unknown."""
    size_std: float | None
    """Relative standard deviation of the stated size, common to all bodies; None: the size is unknown."""
    bodies: tuple[Body, ...]
    """Empty where no two images show one."""
    elsewhere: tuple[int, ...] = ()
    """Rows of the reconstruction whose images show a body at another place than most do: their corners are left out."""
    proposed: str | None = None
    """Value for `--board` that the images seem to show where no body was found; None where they show none."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Observations of common 3D points, for bundle adjustment, whatever back end made them."""

    image: Int[ndarray, " k"]
    """Row of the reconstruction (not of the capture) that each observation belongs to."""
    x_px: Float[ndarray, "k 2"]
    """Pixels of the capture's original image, distorted as the camera made it."""
    point: Int[ndarray, " k"]
    """Row of `points_in_recon`."""
    points_in_recon: Float[ndarray, "p 3"]
    from_pointmaps: bool = False
    """Matched between pointmaps, with errors that neighbours share, instead of found in the images."""
    from_board: bool = False
    """All on a board or tags: the scene rises above them."""
    std_px: Float[ndarray, " k"] | None = None
    """Standard deviation of one coordinate of each observation by its match, up to a factor; None: all are alike."""
    boards: Boards | None = None
    """Boards or tags whose corners are among the points; None: no shape of any point is known."""

    @property
    def on_board(self) -> Bool[ndarray, " p"]:
        """Mask of the points that are corners of `boards`."""
        out = np.zeros(len(self.points_in_recon), bool)
        for body in () if self.boards is None else self.boards.bodies:
            out[body.point] = True
        return out

    def only(self, rows: Bool[ndarray, " k"] | Int[ndarray, " n"]) -> "Tracks":
        """Return these observations; points keep their rows."""
        std = None if self.std_px is None else self.std_px[rows]
        return replace(self, image=self.image[rows], x_px=self.x_px[rows], point=self.point[rows], std_px=std)


@dataclass(frozen=True)
class CameraEvidence:
    """The cameras as the images alone determine them, with their covariance; no robot pose is used."""

    recon_from_camera: Float[ndarray, "m 4 4"]
    covariance: Float[ndarray, "6*m 6*m"]
    """Covariance of steps of the cameras (geometry.retract, recon axes), camera by camera. The recon frame is
    that of one of the cameras, which is therefore exact."""


NO_DEPTH, MATCHED, PRIOR, BOTH = 0, 1, 2, 3
"""Evidence of a depth: none; images that show the same, or a network's prediction; a plane that the colours and the
matched depths around it support; both."""


@dataclass(frozen=True, kw_only=True)
class Pointmaps:
    """A surface point for every pixel of the registered images, a row an image."""

    intrinsics: Intrinsics
    """The undistorted pinhole grid of the pixels (size W x H)."""
    points_in_recon: Float[ndarray, "m h w 3"]
    confidence: Float[ndarray, "m h w"]
    """At least 0; 0 means no estimate (the point may be anything, finite)."""
    colors: UInt8[ndarray, "m h w 3"]
    """RGB at the pixels."""
    reason: UInt8[ndarray, "m h w"] | None = None
    """NO_DEPTH, MATCHED, PRIOR or BOTH; None: a network predicted all of them."""
    depth_std: Float[ndarray, "m h w"] | None = None
    """One sigma of the depth (z) at the pixels, in recon units, 0 without depth; None: unknown."""

    @property
    def is_predicted(self) -> bool:
        """Whether a network predicted them, as part of the reconstruction."""
        return self.reason is None

    def of_rows(self, rows: Int[ndarray, " k"]) -> "Pointmaps":
        """Return the pointmaps of some images, in the order of `rows`."""
        return replace(
            self,
            points_in_recon=self.points_in_recon[rows],
            confidence=self.confidence[rows],
            colors=self.colors[rows],
            reason=None if self.reason is None else self.reason[rows],
            depth_std=None if self.depth_std is None else self.depth_std[rows],
        )


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """Camera poses, tracks and pointmaps in one frame, up to a similarity unless `is_metric`."""

    image_index: Int[ndarray, " m"]
    """Rows of the capture that were registered, ascending."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    intrinsics: Intrinsics
    """The camera of the capture's original images: given, or estimated by the back end."""
    tracks: Tracks
    backend: str
    pointmaps: Pointmaps | None = None
    """Predicted by the back end's network, or estimated by the stage densify; None before it."""
    is_metric: bool = False
    """Whether the unit is meant to be the metre."""
    metric_std: float | None = None
    """Relative standard deviation of its unit from a metre; None: not given."""
    notes: tuple[str, ...] = ()
    """Remarks: images not registered, matches left out."""
    warnings: tuple[str, ...] = ()
    """Warnings: intrinsics that cannot be used, a gripper pose that the images contradict."""
    evidence: CameraEvidence | None = None
    """Evidence in the same frame, where robot poses were used for `recon_from_camera` or cameras err beside them."""

    predicted_focal: tuple[float, float] | None = None
    """Focal length of a network (px of the original image) and its relative standard deviation, where no match in the
    images confirms it; None: the images determine the focal length, or nothing was predicted."""

    @property
    def dense(self) -> Pointmaps:
        """The pointmaps, for what comes after densify."""
        assert self.pointmaps is not None, "the stage densify comes first"
        return self.pointmaps


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Confident points in the base frame, with the rays that saw them."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    confidence: Float[ndarray, " n"]
    margin: Float[ndarray, " n"]
    """One-sigma position uncertainty (m) that the calibration leaves at the point."""
    label: Int[ndarray, " n"]
    """Segment; 0 = none."""
    image: Int[ndarray, " n"]
    """Row of `camera_centers_in_base`."""
    camera_centers_in_base: Float[ndarray, "m 3"]
    label_names: tuple[str, ...] = ("none",)
    reason: UInt8[ndarray, " n"] | None = None
    """MATCHED, PRIOR or BOTH; None: no point is a prior."""
    depth_std: Float[ndarray, " n"] | None = None
    """One sigma (m) of the depth in its image; None: not known."""
    clears: Bool[ndarray, " n"] | None = None
    """Whether the way from the camera to the point counts as seen free; None: every one but to a PRIOR."""

    @property
    def cleared(self) -> Bool[ndarray, " n"]:
        """`clears`, with what None stands for."""
        if self.clears is not None:
            return self.clears
        return np.ones(len(self.image), bool) if self.reason is None else self.reason != PRIOR
