"""Systematic errors of an arm: their covariance over gripper poses, and the effective transform that they leave.

Joint offsets and link errors change the reported poses, by similar amounts for near poses, and more images do not
average them away. A constant error of the first joint rotates the base and one of the last joint the gripper: no pose
shows it, and it does no harm to a user of these reported poses. The result is therefore the *effective* hand-eye
transform: of all (X, base_from_recon) the one that best predicts the camera from the reported poses over the workspace
of the capture, where 1 mm and 2 mrad count alike. Its systematic residuals e' = (I − J A) e are what that fit leaves
of e, A = (JᵀWJ)⁻¹JᵀW.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.equation import SCALE
from jcr.estimation.inverse_kinematics import required_posture
from jcr.estimation.kinematics import Arm, Joints, error_jacobian, error_std, with_tool
from jcr.estimation.mounting import mounted_arm
from jcr.geometry import Poses, rotation_angle

REACH = 0.45
"""Typical lever (m) between an arm's joint and its gripper, by which an error of rotation shows in the position."""
ALIKE = 1.0
"""Distance (rad, with REACH for lengths) of gripper poses that share e^(−1/2) of their errors."""
EFFECTIVE_WEIGHT = np.repeat([1 / 1e-3, 1 / 2e-3], 3)
"""Weights of errors of position (1/m) and rotation (1/rad) in the effective transform."""
LINK_PER_JOINT = 3e-3 / np.radians(1.0)
"""Error of a link (m) for each rad of a joint offset: more exact arms are so in both, 0.03° and 0.1 mm, 0.1° and 0.3
mm, 0.3° and 1 mm."""
LEAST_FREE = 0.4
"""Least value of one minus the leverage of a pose: a fit to three or four images nearly follows each of them."""


def posed(arm: Arm, joints: Joints | None, base_from_gripper: Poses) -> tuple[Arm, Joints]:
    """Return the arm with its tool, and its joint angles at the poses, computed where `joints` is None.

    Raise InputError where poses, joints and arm do not fit.
    """
    if joints is not None:
        return mounted_arm(arm, joints, base_from_gripper), joints
    posture = required_posture(arm, base_from_gripper)
    return with_tool(arm, posture.flange_from_tool), posture.joints


def smooth_errors(base_from_gripper: Poses) -> Float[ndarray, "s s"]:
    """Return the covariance (6n,6n) of errors that vary smoothly over gripper poses, of 1 rad per axis and REACH m.

    They are a Gaussian random field over poses, of steps of geometry.retract: half of an error keeps its direction in
    the base, half of it rotates with the gripper.
    """
    n = len(base_from_gripper)
    rotation, position = base_from_gripper[:, :3, :3], base_from_gripper[:, :3, 3]
    between = rotation[:, None] @ np.swapaxes(rotation, 1, 2)[None]
    apart = np.linalg.norm(position[:, None] - position, axis=-1) / REACH
    share = np.exp(-(rotation_angle(between) ** 2 + apart**2) / (2 * ALIKE**2))[..., None, None]
    alike = share * (np.eye(3) + between) / 2
    out = np.zeros((n, n, 6, 6))
    out[..., :3, :3], out[..., 3:, 3:] = REACH**2 * alike, alike
    return out.swapaxes(1, 2).reshape(6 * n, 6 * n)


def arm_errors(arm: Arm, joints: Joints) -> Float[ndarray, "s s"]:
    """Return the covariance (6n,6n) of the errors of an arm with joint offsets of 1 rad and link errors in proportion.

    `joints` (n,dof) are its angles in rad.
    """
    columns = error_jacobian(arm, joints) * error_std(arm, 1.0, LINK_PER_JOINT)
    stacked = columns.reshape(-1, columns.shape[2])
    return stacked @ stacked.T


@dataclass(frozen=True)
class Region:
    """Fit of an effective transform to the poses of a capture, s = 6n; the scale is not part of it."""

    by_unknown: Float[ndarray, "s u"]
    """J, without the scale: 12 unknowns, and of further arms 12 each."""
    fit: Float[ndarray, "u s"]
    """A = (JᵀWJ)⁻¹JᵀW; zero for poses that are not used."""
    unknowns: int = 13
    """Number of unknowns of the whole problem, which begin as those of equation.py."""

    @staticmethod
    def of_unknowns(by_unknown: Float[ndarray, "s u"], unknowns: int) -> "Region":
        """Return the region of residuals with this derivative by the unknowns of the effective transform."""
        root = np.tile(EFFECTIVE_WEIGHT, len(by_unknown) // 6)
        fit = np.linalg.pinv(root[:, None] * by_unknown, rcond=1e-9) * root
        return Region(by_unknown, fit, unknowns)

    def left(self, systematic: Float[ndarray, "s s"]) -> Float[ndarray, "s s"]:
        """Return the covariance of the part of a systematic error that the effective transform leaves."""
        # (I − J A) S (I − J A)ᵀ, without a product of two matrices of the residuals' size.
        half = systematic - self.by_unknown @ (self.fit @ systematic)
        return half - (half @ self.fit.T) @ self.by_unknown.T

    def spread(self, second_moment: Float[ndarray, "*k m 6 6"]) -> Float[ndarray, "*k p p"]:
        """Return the covariance of the unknowns for other poses of the region, from E[e'e'ᵀ] of each used pose.

        The poses of the capture are a sample of the region: a regression on them differs from one on the region by
        what their residuals show, corrected for each pose's own leverage (MacKinnon and White, J. Econometrics 29,
        1985, "HC3").
        """
        own, m = self._corrected, second_moment.shape[-3]
        spread = (m - 1) / m * (own @ second_moment @ own.swapaxes(1, 2)).sum(-3)
        out = np.zeros((*spread.shape[:-2], self.unknowns, self.unknowns))
        rows = np.delete(np.arange(1 + self.by_unknown.shape[1]), SCALE)
        out[..., rows[:, None], rows] = spread
        return out

    @cached_property
    def _corrected(self) -> Float[ndarray, "m u 6"]:
        """Gain with which each pose's residuals pass into the unknowns, without the pose's own leverage."""
        m = len(self.by_unknown) // 6
        u = self.by_unknown.shape[1]
        own = self.fit.reshape(u, m, 6).swapaxes(0, 1)
        leverage = EFFECTIVE_WEIGHT[:, None] * (self.by_unknown.reshape(m, 6, u) @ own) / EFFECTIVE_WEIGHT
        values, vectors = np.linalg.eigh((leverage + leverage.swapaxes(1, 2)) / 2)
        vectors = vectors / EFFECTIVE_WEIGHT[:, None]
        return own @ (vectors / np.maximum(1 - values, LEAST_FREE)[:, None] @ np.linalg.inv(vectors))
