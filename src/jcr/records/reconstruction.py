"""Records of a reconstruction (camera poses, tracks, boards, pointmaps) and of its point cloud in the base frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.records.capture import Intrinsics
from jcr.records.field_checks import Checked, require_finite, require_rows
from jcr.records.json_fields import Positive


@dataclass(frozen=True)
class Body(Checked):
    """Rigid board, or single tag, whose corners are points of the tracks."""

    number: int
    """Number of the tag; 0 for a board."""
    point: Int[ndarray, " _"]
    """Indices of the corners in `Tracks.points_in_recon`."""
    x_in_body: Float[ndarray, "_ 3"]
    """Corners as printed, with z = 0, in metres; in units of the side if the side is unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_finite("Body", x_in_body=self.x_in_body)
        if len(self.point) != len(self.x_in_body):
            raise InputError(
                f"Body: {len(self.point)} points for {len(self.x_in_body)} corners; give one each"
            )


@dataclass(frozen=True, kw_only=True)
class Boards(Checked):
    """Board or tags of one `--board` option, as found in the images."""

    spec: str
    """Value of the option `--board`."""
    side: Positive
    """Side of a square or a tag (m); 1 if it is unknown."""
    size_std: Positive | None
    """Relative standard deviation of the stated size, common to all bodies; None: the size is unknown."""
    bodies: tuple[Body, ...]
    """Bodies that two or more images show; empty if there are none."""
    elsewhere: tuple[int, ...] = ()
    """Indices, among the registered images, of those that show a body at another position than most images do; their
    corners are not in the tracks."""
    proposed: str | None = None
    """Value of `--board` that fits the images if no body was found; None if no other board is visible."""
    is_stretched: bool = False
    """Whether a calibration found the print stretched, so that its stretch and size have no prior; not stored."""


@dataclass(frozen=True, kw_only=True)
class Tracks(Checked):
    """Points of a reconstruction and their k observations in the images, for bundle adjustment."""

    image: Int[ndarray, " k"]
    """Index of each observation's image among the registered images (not among those of the capture)."""
    x_px: Float[ndarray, "k 2"]
    """Pixel of each observation in the original, distorted image."""
    point: Int[ndarray, " k"]
    """Index of each observation's point in `points_in_recon`."""
    points_in_recon: Float[ndarray, "p 3"]
    from_pointmaps: bool = False
    """Whether the observations are matches between pointmaps, with correlated errors, and not features of the images."""
    from_board: bool = False
    """Whether all points lie on a board or tags, so that the points do not show the height of the scene."""
    std_px: Float[ndarray, " k"] | None = None
    """Relative standard deviation of each observation's coordinates, up to a common factor; None: equal for all."""
    boards: Boards | None = None
    """Boards or tags whose corners are among the points; None without the option `--board`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_finite("Tracks", x_px=self.x_px, points_in_recon=self.points_in_recon)
        require_rows("Tracks", "point", self.point, len(self.points_in_recon))
        if self.std_px is not None and not (self.std_px > 0).all():
            raise InputError("Tracks: std_px has a standard deviation that is not positive")
        for body in () if self.boards is None else self.boards.bodies:
            require_rows("Tracks", f"point of body {body.number}", body.point, len(self.points_in_recon))

    @property
    def on_board(self) -> Bool[ndarray, " p"]:
        """Mask of the points that are corners of a board or tag."""
        out = np.zeros(len(self.points_in_recon), bool)
        for body in () if self.boards is None else self.boards.bodies:
            out[body.point] = True
        return out

    def only(self, rows: Bool[ndarray, " k"] | Int[ndarray, " n"]) -> "Tracks":
        """Return the tracks with the observations that `rows` selects (mask or indices); all points are kept."""
        std = None if self.std_px is None else self.std_px[rows]
        return replace(self, image=self.image[rows], x_px=self.x_px[rows], point=self.point[rows], std_px=std)


@dataclass(frozen=True)
class CameraEvidence:
    """Camera poses that the images determine without robot poses, with their joint covariance."""

    recon_from_camera: Float[ndarray, "m 4 4"]
    covariance: Float[ndarray, "6*m 6*m"]
    """Covariance of steps of the camera poses (geometry.retract, recon axes), 6 rows per camera. One camera defines the
    recon frame; its rows are 0."""


NO_DEPTH, MATCHED, PRIOR, BOTH = 0, 1, 2, 3
"""Values of Pointmaps.reason, the origin of a pixel's depth. NO_DEPTH: none. MATCHED: matches between images, or a
network. PRIOR: a plane supported by the colours and the matched depths around it. BOTH: MATCHED and PRIOR agree."""


@dataclass(frozen=True, kw_only=True)
class Pointmaps(Checked):
    """Surface point of each pixel (h,w) of the m registered images, in the recon frame."""

    intrinsics: Intrinsics
    """Intrinsics of the pixel grid, a pinhole camera without distortion with images of w x h pixels."""
    points_in_recon: Float[ndarray, "m h w 3"]
    confidence: Float[ndarray, "m h w"]
    """Confidence of each point, at least 0; at 0 there is no estimate, and the point is any finite value."""
    colors: UInt8[ndarray, "m h w 3"]
    """RGB colour of each pixel."""
    reason: UInt8[ndarray, "m h w"] | None = None
    """Origin of each depth: NO_DEPTH, MATCHED, PRIOR or BOTH; None: a network predicted all depths."""
    depth_std: Float[ndarray, "m h w"] | None = None
    """Standard deviation of each depth z (recon units), 0 without a depth; None: unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.confidence.shape[1:] != (self.intrinsics.height, self.intrinsics.width):
            size = f"{self.intrinsics.width}x{self.intrinsics.height}"
            raise InputError(
                f"Pointmaps: confidence of shape {self.confidence.shape}, intrinsics of {size} pixels"
            )
        for name in ("confidence", "depth_std"):
            array = getattr(self, name)
            if array is not None and not (array >= 0).all():
                raise InputError(f"Pointmaps: {name} has values below 0 or NaN; set them to 0")

    @property
    def is_predicted(self) -> bool:
        """Whether the network of the back end predicted the pointmaps; otherwise the stage densify estimated them."""
        return self.reason is None

    def of_rows(self, rows: Int[ndarray, " k"]) -> "Pointmaps":
        """Return the pointmaps of the images of these indices, in their order."""
        return replace(
            self,
            points_in_recon=self.points_in_recon[rows],
            confidence=self.confidence[rows],
            colors=self.colors[rows],
            reason=None if self.reason is None else self.reason[rows],
            depth_std=None if self.depth_std is None else self.depth_std[rows],
        )


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Checked):
    """Reconstruction of a capture: camera poses, tracks and pointmaps in one frame (recon) of any origin and unit."""

    image_index: Int[ndarray, " m"]
    """Rows of the capture of the m registered images, ascending."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    intrinsics: Intrinsics
    """Intrinsics of the capture's original images: given, or estimated by the back end."""
    tracks: Tracks
    backend: str
    """Name of the back end."""
    pointmaps: Pointmaps | None = None
    """Pointmaps, predicted by the back end's network or estimated by the stage densify; None before that stage."""
    is_metric: bool = False
    """Whether the unit is nominally the metre."""
    metric_std: Positive | None = None
    """Relative standard deviation of a metric unit; None: unknown, or the unit is arbitrary."""
    notes: tuple[str, ...] = ()
    """Remarks of the back end, for example on images that were not registered."""
    warnings: tuple[str, ...] = ()
    """Warnings of the back end, for example on a gripper pose that the images contradict."""
    evidence: CameraEvidence | None = None
    """Camera poses from the images alone, in the same frame, for the calibration; None: use `recon_from_camera`."""

    predicted_focal: tuple[float, float] | None = None
    """Focal length that a network predicted (px of the original image), and its relative standard deviation; None: the
    images determine the focal length, or nothing was predicted."""

    def __post_init__(self) -> None:
        super().__post_init__()
        m = len(self.image_index)
        require_finite("Reconstruction", recon_from_camera=self.recon_from_camera)
        if len(self.recon_from_camera) != m or (
            self.pointmaps is not None and len(self.pointmaps.confidence) != m
        ):
            raise InputError(f"Reconstruction: cameras or pointmaps not of {m} images; give one each")
        if m and (self.image_index[0] < 0 or (np.diff(self.image_index) <= 0).any()):
            raise InputError("Reconstruction: image_index does not ascend from 0 or more; sort the images")
        require_rows("Reconstruction", "tracks.image", self.tracks.image, m)
        if self.tracks.boards is not None:
            elsewhere = np.array(self.tracks.boards.elsewhere, int)
            require_rows("Reconstruction", "tracks.boards.elsewhere", elsewhere, m)

    @property
    def dense(self) -> Pointmaps:
        """Pointmaps of a reconstruction that has passed the stage densify; raises AssertionError before it."""
        assert self.pointmaps is not None, "the stage densify comes first"
        return self.pointmaps


@dataclass(frozen=True, kw_only=True)
class PointCloud(Checked):
    """Point cloud in the base frame: confident points of the pointmaps, with the centre of the camera that saw each."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    confidence: Float[ndarray, " n"]
    margin: Float[ndarray, " n"] | None
    """Standard deviation of each point's position due to the calibration (m); None: the calibration states none."""
    label: Int[ndarray, " n"]
    """Index of each point's segment in `label_names`; 0: no segment."""
    image: Int[ndarray, " n"]
    """Index of each point's camera in `camera_centers_in_base`."""
    camera_centers_in_base: Float[ndarray, "m 3"]
    label_names: tuple[str, ...] = ("none",)
    reason: UInt8[ndarray, " n"] | None = None
    """Origin of each depth: MATCHED, PRIOR or BOTH; None: no depth is a PRIOR."""
    depth_std: Float[ndarray, " n"] | None = None
    """Standard deviation of each point's depth in its image (m); None: unknown."""
    clears: Bool[ndarray, " n"] | None = None
    """Mask of points whose ray from the camera counts as free space; None: all points but those of reason PRIOR."""

    def __post_init__(self) -> None:
        super().__post_init__()
        numbers = "points_in_base", "confidence", "margin", "depth_std", "camera_centers_in_base"
        require_finite("PointCloud", **{name: getattr(self, name) for name in numbers})
        for name in ("margin", "depth_std"):
            if (sizes := getattr(self, name)) is not None and (sizes < 0).any():
                raise InputError(f"PointCloud: {name} below 0; make the cloud again")
        require_rows("PointCloud", "label", self.label, len(self.label_names))
        require_rows("PointCloud", "image", self.image, len(self.camera_centers_in_base))

    @property
    def cleared(self) -> Bool[ndarray, " n"]:
        """Mask of points whose ray from the camera counts as free space; without `clears`, all but the PRIOR points."""
        if self.clears is not None:
            return self.clears
        return np.ones(len(self.image), bool) if self.reason is None else self.reason != PRIOR
