"""Options of reading a capture, on the command line and in Python."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jcr.errors import InputError
from jcr.records.capture import Mount

MIN_FRAMES = 3
"""Smallest number of frames that can be calibrated."""
MAX_FRAMES = 1000
"""Largest number of frames; images are compared with each other, and so are the errors of all poses."""

FormatName = Literal["auto", "capture", "table", "samples", "bag", "lerobot"]
UnitsName = Literal["auto", "m-rad", "m-deg", "mm-rad", "mm-deg", "cm-rad", "cm-deg"]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading a capture; a capture.json needs none of these."""

    pose_convention: str = "auto"
    """Notation of the rotations in a pose file: matrix, matrix:columns, quat:xyzw, quat:wxyz, rotvec, euler:SEQUENCE
    (xyz about fixed axes, ZYX about moving ones), or a maker: ur, franka, kuka, fanuc, abb, … (jcr docs captures).
    auto decides by names and numbers, otherwise by the images."""
    pose_units: UnitsName = "auto"
    """Units of positions and angles in a pose file, or of joint angles; auto decides by names and sizes of numbers."""
    pose_inverted: bool = False
    """Invert the poses; this is needed if they are gripper_from_base (the base in the gripper frame)."""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of gripper poses, or folder with one file for each image; by default found in the capture."""
    pose_columns: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """First part of the names of the columns with the gripper poses, if a file has several poses."""
    camera_info: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File with the intrinsics (OpenCV, ROS, Kalibr, RealSense, COLMAP, a 3x3 matrix); by default the capture's."""
    mount: Mount = "gripper"
    """Body that the camera is mounted on: the gripper, or the base for a camera beside the robot that sees the gripper.
    A capture.json states it itself."""
    format: FormatName = "auto"
    """Format of the capture, if its files do not show it (jcr docs captures)."""
    frames: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 15
    """Number of frames to take from a recording. They are sharp, at rest, and determine the calibration best."""
    base_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Name of the robot's base frame; in recordings, the tf frame or URDF link."""
    gripper_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Name of the frame of the gripper poses, such as tool0 or flange; in recordings, the tf frame or URDF link on which
    the camera is mounted."""
    camera_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the images in a bag, or key of the camera in a LeRobot data set (observation.images.wrist)."""
    joint_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the joint states (with --urdf) or of the gripper's PoseStamped in a bag, or key of the state in a LeRobot
    data set."""
    urdf: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Robot description for recordings with joint angles instead of gripper poses."""
    max_gap_ms: Annotated[float, tyro.conf.arg(metavar="MS")] = 100.0
    """Largest gap between two poses of a recording for interpolation; images in larger gaps are not used."""
    episode: tuple[int | Literal["all"], ...] = (0,)
    """Episode of a LeRobot data set. `jcr batch` and `jcr verify` take several or all, each as a capture of its own; of
    more than 200 they take 200 at even steps."""


def chosen_name(names: Sequence[str], asked: str | None, usual: Sequence[str], what: str, option: str) -> str:
    """Return the topic, key or frame `asked` by the user; if that is None, the only entry of `usual`, the likely names.

    Raises InputError that lists all `names` if `asked` is not one of them, or if `usual` has not one entry. In the
    message, `what` describes the choice and `option` is its command-line option.
    """
    if asked in names:
        return str(asked)
    if asked is None and len(usual) == 1:
        return usual[0]
    wrong = "" if asked is None else f"{asked} is not there; "
    raise InputError(f"{what}: {wrong}choose one with {option}: {', '.join(names) or 'there are none'}")


def tolerated(count: int) -> int:
    """Return the number of faulty frames among `count` that may be left out: a quarter, rounded down, at least one."""
    return max(1, count // 4)
