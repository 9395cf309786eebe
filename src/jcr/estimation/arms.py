"""Kinematic models of named arms from their makers' publications; frames and signs are those of the controller."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray, pi
from scipy.spatial.transform import Rotation

from jcr.errors import InputError, did_you_mean
from jcr.estimation.kinematics import Arm
from jcr.geometry import Transform, transform

Limits = Sequence[tuple[float, float]] | Float[ndarray, "n 2"]
Numbers = Sequence[float | int]
TWICE = (-2 * pi, 2 * pi)
"""Limits (rad) of a joint with a full rotation in each direction."""


def _arm(
    name: str,
    origins: Float[ndarray, "n 6"] | str,
    limits: Limits,
    rest: Sequence[float],
    last_from_gripper: Transform | None = None,
) -> Arm:
    """Return an arm whose joints rotate about z; row i of `origins` is joint i's frame in that of the previous joint.

    Each row is x, y, z (m), roll, pitch, yaw (degrees), as the `origin` of a URDF; the first is relative to the base.
    One more row is the gripper's frame in that of the last joint, unless `last_from_gripper` is given. A text has the
    numbers row by row. `limits` are (lowest, highest) angles, `rest` is the rest posture (rad).
    """
    rows = np.array(origins.split() if isinstance(origins, str) else origins, float).reshape(-1, 6)
    frames = transform(Rotation.from_euler("xyz", rows[:, 3:], degrees=True).as_matrix(), rows[:, :3])
    return Arm(
        name=name,
        parent_from_joint=frames[: len(limits)],
        axes=np.tile([0.0, 0.0, 1.0], (len(limits), 1)),
        last_from_gripper=frames[-1] if last_from_gripper is None else last_from_gripper,
        limits=np.array(limits, float),
        rest=np.array(rest, float),
    )


def _dh(a: Numbers, d: Numbers, alpha_deg: Numbers) -> Float[ndarray, "n 6"]:
    """Return the `origins` of `_arm` from Denavit-Hartenberg parameters a (m), d (m), α (degrees), one row per frame.

    Row 0 is the transform before joint 1, row i the transform between the rotations of joints i and i + 1. Line i of a
    standard table is row i. Line i of a modified table (Craig) has its d in row i, and its a and α in row i − 1.
    """
    none = np.zeros(len(a))
    return np.stack([a, none, d, alpha_deg, none, none], axis=1)


def _ur(name: str, d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> Arm:
    """Return an arm of the Universal Robots e-Series, by standard Denavit-Hartenberg parameters d and a (m).

    Source: Universal Robots, "DH Parameters for calculations of kinematics and dynamics"; the same numbers are in
    ur_description/config/*/default_kinematics.yaml of ros-industrial/universal_robot. The base is that of the
    controller, rotated by 180° about z from base_link of ROS; the gripper is tool0. Limits: joint_limits.yaml.
    """
    rows = _dh((0, 0, a2, a3, 0, 0, 0), (0, d1, 0, 0, d4, d5, d6), (0, 90, 0, 0, 90, -90, 0))
    # At zero the arm reaches along -x of the controller's base; the table is at +x.
    rest = (pi, -1.6, 1.9, -1.9, -pi / 2, 0.0)
    return _arm(name, rows, [TWICE, TWICE, (-pi, pi), TWICE, TWICE, TWICE], rest)


def _franka(name: str, limits: Limits) -> Arm:
    """Return a Franka Panda (FER) or Research 3, by modified Denavit-Hartenberg parameters; the gripper is the flange.

    `limits` are (lowest, highest) joint angles (rad). Source: Franka Control Interface documentation, "Robot and
    interface specifications"; robots/fer/kinematics.yaml and robots/fr3/joint_limits.yaml of
    frankaemika/franka_description.
    """
    a, d = (0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0), (0, 0.333, 0, 0.316, 0, 0.384, 0, 0.107)
    rows = _dh(a, d, (0, -90, 90, 90, -90, 90, 90, 0))
    return _arm(name, rows, limits, (0.0, -pi / 4, 0.0, -3 * pi / 4, 0.0, pi / 2, pi / 4))


def _iiwa(name: str, base: float, upper: float) -> Arm:
    """Return a KUKA LBR iiwa 7 R800 or 14 R820, by its lengths (m); the gripper is the media flange "basic".

    Source: KUKA, "LBR iiwa: Specification" (lengths and limits); iiwa_description/urdf/iiwa7.xacro and iiwa14.xacro of
    IFL-CAMP/iiwa_stack (signs and the 126 mm from wrist to flange).
    """
    d, alpha = (0, base, 0, upper, 0, 0.4, 0, 0.126), (0, -90, 90, 90, -90, -90, 90, 0)
    limits = [(-limit, limit) for limit in np.radians([170, 120, 170, 120, 170, 120, 175])]
    return _arm(name, _dh([0] * 8, d, alpha), limits, (0.0, 0.4, 0.0, -1.6, 0.0, 1.1, 0.0))


# Source of the xArms: xarm_description/config/kinematics/default/*.yaml and urdf/*/*.urdf.xacro of
# xArm-Developer/xarm_ros; the gripper is link_eef, the flange.
XARM6 = """
0 0 0.267 0 0 0
0 0 0 -90 0 0
0.0535 -0.2845 0 0 0 0
0.0775 0.3425 0 -90 0 0
0 0 0 90 0 0
0.076 0.097 0 -90 0 0
0 0 0 0 0 0"""
XARM7 = """
0 0 0.267 0 0 0
0 0 0 -90 0 0
0 -0.293 0 90 0 0
0.0525 0 0 90 0 0
0.0775 -0.3425 0 90 0 0
0 0 0 90 0 0
0.076 0.097 0 -90 0 0
0 0 0 0 0 0"""


# Unitree Z1: robots/z1_description/xacro of unitreerobotics/unitree_ros, link dimensions of its z1.urdf; the gripper is
# where its own is mounted (gripperStator), x forward.
Z1 = """
0 0 0.0585 0 0 0
0 0 0.045 0 0 0
-0.35 0 0 0 0 0
0.218 0 0.057 0 0 0
0.07 0 0 0 0 0
0.0492 0 0 0 0 0
0.051 0 0 0 0 0"""


# SO-101 follower, five joints without the jaw: Simulation/SO101/so101_new_calib.urdf of TheRobotStudio/SO-ARM100 (zero
# in the middle of each range); the gripper is gripper_frame_link, at the jaw's tip.
SO101_TIP = transform(np.diag([-1.0, 1.0, -1.0]), np.array([-0.0079, -0.000218121, -0.0981274]))
SO101 = """
0.0388353 0 0.0624 180 0 -180
-0.0303992 -0.0182778 -0.0542 -90 -90 0
-0.11257 -0.028 0 0 0 90
-0.1349 0.0052 0 0 0 -90
0 -0.0611 0.0181 90 2.789129898807091 180"""

RobotName = Literal[
    "ur3e", "ur5e", "ur10e", "panda", "fr3", "iiwa7", "iiwa14", "xarm6", "xarm7", "z1", "so101"
]

# fmt: off
_PANDA = [(-2.8973, 2.8973), (-1.7628, 1.7628), (-2.8973, 2.8973), (-3.0718, -0.0698), (-2.8973, 2.8973),
          (-0.0175, 3.7525), (-2.8973, 2.8973)]
_FR3 = [(-2.7437, 2.7437), (-1.7837, 1.7837), (-2.9007, 2.9007), (-3.0421, -0.1518), (-2.8065, 2.8065),
        (0.5445, 4.5169), (-3.0159, 3.0159)]
_Z1 = np.radians([(-150, 150), (0, 170), (-165, 0), (-87, 87), (-77, 77), (-160, 160)])
_SO101 = [(-1.91986, 1.91986), (-1.74533, 1.74533), (-1.69, 1.69), (-1.65806, 1.65806), (-2.74385, 2.84121)]
_XARM6 = [TWICE, (-2.059, 2.0944), (-3.927, 0.19198), TWICE, (-1.69297, pi), TWICE]
_XARM7 = [TWICE, (-2.059, 2.0944), TWICE, (-0.19198, 3.927), TWICE, (-1.69297, pi), TWICE]
# fmt: on
_ARMS: dict[RobotName, Callable[[], Arm]] = {
    "ur3e": lambda: _ur("ur3e", 0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": lambda: _ur("ur5e", 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": lambda: _ur("ur10e", 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "panda": lambda: _franka("panda", _PANDA),
    "fr3": lambda: _franka("fr3", _FR3),
    "iiwa7": lambda: _iiwa("iiwa7", 0.34, 0.4),
    "iiwa14": lambda: _iiwa("iiwa14", 0.36, 0.42),
    "xarm6": lambda: _arm("xarm6", XARM6, _XARM6, (0.0, -0.3, -0.9, 0.0, 1.2, 0.0)),
    "xarm7": lambda: _arm("xarm7", XARM7, _XARM7, (0.0, -0.3, 0.0, 0.9, 0.0, 1.2, 0.0)),
    "z1": lambda: replace(
        _arm("z1", Z1, _Z1, (0.0, 1.6, -1.2, 0.9, 0.0, 0.0)),
        axes=np.eye(3)[[2, 1, 1, 1, 2, 0]],
        forward=np.array([1.0, 0.0, 0.0]),
    ),
    "so101": lambda: _arm("so101", SO101, _SO101, (0.0, -0.8, 0.5, 1.25, 0.0), SO101_TIP),
}
ROBOT_NAMES: tuple[RobotName, ...] = get_args(RobotName)
CHOICES = f"{{{','.join(ROBOT_NAMES)}}}"
"""Names of the arms as the help of a command-line option shows them."""


def arm_named(name: str) -> Arm:
    """Return the arm with this name; raise InputError with the list of names if there is none."""
    for known, make in _ARMS.items():
        if known == name:
            return make()
    like = did_you_mean(name, ROBOT_NAMES)
    raise InputError(
        f"robot {name}: not known{like}; choose one of {', '.join(ROBOT_NAMES)}, or leave it out and state "
        "another arm's urdf and joints in capture.json (jcr docs captures)"
    )
