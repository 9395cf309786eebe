"""Options of a simulated capture."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from jcr.estimation.arms import CHOICES, RobotName
from simulation.poses import Pattern
from simulation.scenes import SceneName, TableName


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Scene, motion, camera and errors of a simulated capture."""

    scene: SceneName = "tabletop"
    """Objects and table: a mix on wood; 8 or 7 items on a plain light table; 7 on a plain dark one; tape,
    box, mug and toolbox for measuring."""
    images: int = 12
    """Number of images; fewer images of the pattern `varied` are the first ones of more (`two` has 2)."""
    pattern: Pattern = "varied"
    """Path of the wrist. All but `varied` leave part of the calibration unobservable: an orbit at one radius,
    pure translation, a turntable, xyz + yaw (SCARA), rotating about a tool point or about the camera's centre,
    two images."""
    robot: Annotated[RobotName | None, tyro.conf.arg(metavar=CHOICES)] = None
    """Arm that carries the camera, the table before it. capture.json then has its joint angles, and gripper poses by
    its nominal kinematics (unset: a gripper without an arm)."""
    joint_offsets: float = 0.0
    """Sigma of the offsets of the robot's joints, in degrees. With this and the next three, reference.json has the
    effective hand-eye transform, and the physical one beside it."""
    link_errors: float = 0.0
    """Sigma of the translations of the robot's joint axes, in mm; of their rotations, 0.19 degrees per mm."""
    gear_errors: float = 0.0
    """Sigma of eccentric gears or encoders, in degrees: amplitudes of sine and cosine of each joint's angle."""
    sag: float = 0.0
    """Sigma of the deflection of each joint under gravity, in degrees with the arm stretched out."""
    seed: int = 0
    """Objects, layout, textures, lamp, intrinsics, hand-eye and poses all follow from it."""
    texture: bool = True
    """Print and grain on the surfaces; without, each has one uniform colour, with nothing for features."""
    table: TableName | None = None
    """Light or dark table top (unset: as the scene has it)."""
    robot_noise: tuple[float, float] = (0.0, 0.0)
    """Sigma per axis, in mm and degrees, of Gaussian errors of the gripper poses in capture.json; the images
    show the true ones."""
    unknown_intrinsics: bool = False
    """Leave the intrinsics out of capture.json. (Known or not, the camera is a pinhole without distortion.)"""
    intrinsics_error: float = 0.0
    """Sigma of the errors of the intrinsics in capture.json, in percent: of the focal length (fx and fy alike), and of
    the image's width for each coordinate of the principal point. The images show the true ones."""
    noise: float = 0.0
    """Sigma of the pixel noise, in grey levels of 255."""
    blur: float = 0.0
    """Sigma of the blur, in pixels."""
    depth: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="PERCENT MM")] = None
    """Depth images as a depth camera takes them: lengths too long by so much, and the sigma of a depth at 1 m, which
    grows with the square of the distance; none at edges."""
    vignetting: float = 0.0
    """Share of light lost in the corners, 0 to 1."""
    jpeg_quality: int | Literal["lossless"] = 90
    """1 to 100, or lossless: PNG."""
    fixed_cameras: int = 0
    """Number of cameras that stand beside the table and see the scene, an image each."""
    wrist_cameras: int = 1
    """1 or 2: a second camera on the gripper, beside the first and with intrinsics of its own."""
    arms: int = 1
    """1 or 2: a second arm on the other side of the table, with a wrist camera of its own. (With --robot, of the same
    make and as exact.)"""
    eye_to_hand: bool = False
    """The camera stands fixed and watches a package that the gripper carries and rotates, before the scene."""
    truth: Literal["full", "scene"] = "full"
    """Write truth/ with depth and labels of every image, or with scene.json alone."""
