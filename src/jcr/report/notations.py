"""One rigid transform in the notations that robot software reads, each with its uncertainty.

The errors of `COVARIANCE_ORDER` are a rotation vector r about gripper axes, R_true = exp(r)·R; a notation
n(R) has the covariance J C Jᵀ with J = dn/dr at r = 0.
"""

import json
from dataclasses import KW_ONLY, dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.geometry import roll_pitch_yaw, skew

GIMBAL_LOCK = np.radians(89.9)
"""Pitch beyond which roll and yaw rotate about nearly the same axis."""


@dataclass(frozen=True)
class Notation:
    """A transform, or a part of it, as numbers with one-sigma uncertainties in the same unit."""

    name: str
    components: tuple[str, ...]
    unit: str
    value: Float[ndarray, " k"]
    _: KW_ONLY
    std: Float[ndarray, " k"]
    note: str = ""


def notations(
    gripper_from_camera: Float[ndarray, "4 4"], covariance: Float[ndarray, "7 7"]
) -> list[Notation]:
    """Translation and rotation as people write them; `covariance` is in `jcr.records.COVARIANCE_ORDER`."""
    rotation = Rotation.from_matrix(gripper_from_camera[:3, :3])
    quat_xyzw = rotation.as_quat(canonical=True)
    rotvec = rotation.as_rotvec()
    rpy = roll_pitch_yaw(gripper_from_camera[:3, :3])
    noise = covariance[3:6, 3:6]
    std_quat = _std(quaternion_jacobian(quat_xyzw), noise)
    std_rotvec = _std(rotation_vector_jacobian(rotvec), noise)
    fixed_axes = "fixed axes x, y, z: R = Rz(yaw)·Ry(pitch)·Rx(roll)"
    if abs(rpy[1]) > GIMBAL_LOCK:
        std_rpy = np.full(3, np.inf)
        fixed_axes += "; at gimbal lock: only the sum or difference of roll and yaw has a meaning"
    else:
        std_rpy = _std(roll_pitch_yaw_jacobian(rpy), noise)
    angles = "Roll, pitch, yaw", ("roll", "pitch", "yaw")
    x, std_x = gripper_from_camera[:3, 3], np.sqrt(np.diag(covariance)[:3])
    return [
        Notation("Translation", ("x", "y", "z"), "m", x, std=std_x),
        Notation(
            "Quaternion", tuple("xyzw"), "", quat_xyzw, std=std_quat, note="x, y, z, w: the scalar last"
        ),
        Notation(*angles, "rad", rpy, std=std_rpy, note=fixed_axes),
        Notation(*angles, "deg", np.degrees(rpy), std=np.degrees(std_rpy), note=fixed_axes),
        Notation(
            "Rotation vector", ("rx", "ry", "rz"), "rad", rotvec, std=std_rotvec, note="axis times angle"
        ),
    ]


def matrix_json(a_from_b: Float[ndarray, "4 4"]) -> str:
    """The matrix as nested lists, which Python, NumPy, JSON and YAML read, with every digit."""
    return "[" + ",\n ".join(json.dumps(row) for row in a_from_b.tolist()) + "]"


def quaternion_jacobian(quat_xyzw: Float[ndarray, "4"]) -> Float[ndarray, "4 3"]:
    """dq/dr of exp(r)·R: half the quaternion product (r, 0)·q (Solà 2017, eq. 34 and 38)."""
    v, w = quat_xyzw[:3], quat_xyzw[3]
    return 0.5 * np.vstack([w * np.eye(3) - skew(v), -v])


def rotation_vector_jacobian(rotvec: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """d log(exp(r)·R)/dr: the inverse left Jacobian of SO(3) (Solà et al. 2018, eq. 146)."""
    angle = float(np.linalg.norm(rotvec))
    near_zero = angle < 1e-4
    factor = 1 / 12 if near_zero else 1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))
    cross = skew(rotvec)
    return np.eye(3) - 0.5 * cross + factor * cross @ cross


def roll_pitch_yaw_jacobian(rpy: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """d(roll, pitch, yaw)/dr: the axes that each angle rotates about, inverted; singular at gimbal lock."""
    _, pitch, yaw = rpy
    roll_axis = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
    pitch_axis = [-np.sin(yaw), np.cos(yaw), 0.0]
    return np.linalg.inv(np.array([roll_axis, pitch_axis, [0.0, 0.0, 1.0]]).T)


def _std(jacobian: Float[ndarray, "k 3"], covariance: Float[ndarray, "3 3"]) -> Float[ndarray, " k"]:
    return np.sqrt(np.maximum(np.diag(jacobian @ covariance @ jacobian.T), 0.0))
