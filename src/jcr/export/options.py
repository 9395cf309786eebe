"""Export formats, their options and the notes in exported files, without the writers, so that help loads fast."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jcr import __version__

ExportName = Literal[
    "ros2", "moveit", "urdf", "easy_handeye2", "camera_info", "ply", "glb", "octomap", "esdf", "spheres",
    "nerfstudio", "colmap", "depth", "lerobot", "mjcf", "usd", "rerun",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Frames, resolution and images of an exported file; an option that does not concern the format is refused."""

    parent_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """The gripper frame of the capture's poses; by default the one that the capture names."""
    child_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """The camera's optical frame (x right, y down, z forward); by default the one that the capture names, otherwise
    camera_color_optical_frame."""
    base_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """The robot's base frame, which is that of the map; by default the one that the capture names, otherwise base."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Another camera of the cell (cameras.json), for formats with one camera. By default it is the run's own camera;
    ros2 and urdf contain all cameras. The parent of a fixed camera is the base frame."""
    to_root: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Link to which the transform is exported instead: the root of the camera's own frames (e.g. camera_link)."""
    root_from_optical: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X Y Z QX QY QZ QW"),
    ] = None
    """Pose of the optical frame in the link --to-root: x y z (m) qx qy qz qw, as `ros2 run tf2_ros tf2_echo LINK
    OPTICAL` prints it. By default both have the same origin, and the link has the axes of REP-103."""
    intrinsics: Literal["estimated", "given"] = "estimated"
    """Intrinsics with which you use the camera: estimated by the run, or given by the capture. Each of the two has
    a transform of its own; every file states its intrinsics."""
    voxel_size: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Voxel size (m) for octomap and esdf; by default the map's cell."""
    unknown: Literal["occupied", "free"] | None = None
    """State of unseen space; by default it is occupied in esdf, and free (without spheres) in spheres."""
    excess: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Metres by which spheres may extend into free space; by default two cells of the map."""
    into: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """URDF or xacro of a robot that format urdf copies with a new origin of the camera's joint. Its child is the
    camera's frame (--child-frame, --to-root). All else is kept."""
    float_depth: bool = False
    """Write the images of format depth as .npy in metres (float32) instead of 16-bit PNG in millimetres."""
    undistort: bool = False
    """Resample the images of nerfstudio and colmap to a pinhole camera."""
    force: bool = False
    """Export a rejected calibration; the file then contains the reason."""
    overwrite: bool = False
    """Replace a file with other content at the path."""
    link_images: bool = False
    """Link to the capture's images instead of copying them."""


def provenance(frame: str, doubt: str | None = None) -> dict[str, str]:
    """Return notes for an exported file, by key: frame, unit, version, and a warning with the reason `doubt`, if any."""
    about = {"frame": frame, "unit": "m", "made_by": f"jcr {__version__}"}
    return about if doubt is None else about | {"warning": f"REJECTED: {' '.join(doubt.split())}"}
