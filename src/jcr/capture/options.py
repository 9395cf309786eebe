"""Options of reading a capture, on the command line and in Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

MIN_FRAMES = 3
"""Smallest number of frames that can be calibrated."""
MAX_FRAMES = 1000
"""Largest number of frames; images are compared with each other, and so are the errors of all poses."""

FormatName = Literal[
    "auto", "capture", "table", "samples", "bag", "lerobot",
]  # fmt: skip
ConventionName = Literal[
    "auto", "matrix", "quat-xyzw", "quat-wxyz", "rotation-vector", "rpy", "ur", "franka", "xarm", "xarm-axis-angle",
    "kuka", "fanuc", "yaskawa", "abb", "unitree", "realman",
]  # fmt: skip
UnitsName = Literal["auto", "m-rad", "m-deg", "mm-rad", "mm-deg", "cm-rad", "cm-deg"]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading a capture; a capture.json needs none of these."""

    pose_convention: ConventionName = "auto"
    """Notation of the gripper poses (base_from_gripper) in a table; auto: from the names of its columns."""
    pose_units: UnitsName = "auto"
    """Units of a table's positions and angles, or of joint angles; auto: those of the convention or of the columns."""
    pose_inverted: bool = False
    """The poses are gripper_from_base, the base in the gripper frame: invert them."""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of gripper poses; unset: poses.csv, .tsv, .txt, .npy, .yaml or .json beside the images."""
    camera_info: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """ROS camera_info YAML with the intrinsics; unset: camera_info.yaml beside the images, if there is one."""
    format: FormatName = "auto"
    """Format of the capture, if its files do not show it (jcr docs captures)."""
    frames: Annotated[int, tyro.conf.arg(metavar="COUNT")] = 15
    """Number of frames to take from a recording: still, sharp, and chosen to determine the calibration best."""
    base_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Recordings: tf frame or URDF link of the robot's base."""
    gripper_frame: Annotated[str | None, tyro.conf.arg(metavar="FRAME")] = None
    """Recordings: tf frame or URDF link on which the camera is mounted."""
    camera_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Bags: topic of the images. LeRobot: key of the camera, such as observation.images.wrist."""
    joint_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Bags: topic of the joint states, read when --urdf is given. LeRobot: key of the state."""
    urdf: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Robot description, for recordings with joint angles instead of gripper poses."""
    max_gap_ms: Annotated[float, tyro.conf.arg(metavar="MS")] = 100.0
    """Recordings: largest gap between two poses across which one is interpolated; beyond it the image is left out."""
    episode: tuple[int, ...] = (0,)
    """LeRobot: the episode to take frames from. `jcr batch` takes several, each as a capture of its own, and names those
    whose camera moved."""
