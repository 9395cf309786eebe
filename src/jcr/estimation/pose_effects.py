"""Columns of the equations for effects on the gripper poses: slip, drift, delay, moved base, strains, joint offsets."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.hypotheses import Row
from jcr.estimation.kinematics import Arm, Joints, error_jacobian
from jcr.estimation.pose_equations import PoseEquations
from jcr.estimation.robot_noise import most_likely, solve_equations
from jcr.findings import FindingKind
from jcr.geometry import Poses, skew
from jcr.records import JointOffsets

LEAST_PART = 3
"""Images on either side of a change: fewer are single wrong poses."""
MANY_PLACES = 60
"""Largest number of places of a change that are tested; longer captures are sampled evenly."""
UP = np.array([0.0, 0.0, 1.0])
PLAUSIBLE: dict[FindingKind, tuple[float, float]] = {
    FindingKind.SLIP: (0.12, np.radians(45.0)),
    FindingKind.BASE_MOVED: (0.2, np.radians(20.0)),
    FindingKind.DRIFT: (0.03, np.radians(10.0)),
    FindingKind.DELAY: (1.0, 0.0),
    FindingKind.LENGTHS: (0.1, 0.0),
    FindingKind.BASE_LEANS: (0.3, 0.0),
    FindingKind.TOOL_SAGS: (0.3, 0.0),
}
"""Largest estimate that the cause can produce: m and rad of a motion, else the norm of the parameters. A clamped camera
slips by centimetres, and another tool frame is rarely farther away; a delay of a whole interval is a wrong pairing. An
estimate beyond these points to poses that contradict the images."""


def _symmetric(a: int, b: int) -> Float[ndarray, "3 3"]:
    """Return the symmetric shear of two axes, of unit norm."""
    out = np.zeros((3, 3))
    out[a, b] = out[b, a] = 1 / np.sqrt(2)
    return out


STRAINS = np.array(
    [
        np.diag([1.0, -1.0, 0.0]) / np.sqrt(2),
        np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6),
        _symmetric(0, 1),
        _symmetric(0, 2),
        _symmetric(1, 2),
    ]
)
"""Orthonormal basis of the symmetric strains without a common factor, which is the scale and unobservable."""


def order_rows(
    base_from_gripper: Poses, by_x: Float[ndarray, "n 6 6"], by_z: Float[ndarray, "n 6 6"]
) -> Iterator[Row]:
    """Yield the effects that depend on the order of the images.

    `by_x` and `by_z` are the derivatives of the residuals by the hand-eye transform X and by base_from_recon.
    """
    n = len(base_from_gripper)
    count = min(n - 2 * LEAST_PART + 1, MANY_PLACES)
    if count < 1:
        return
    for k in np.unique(np.linspace(LEAST_PART, n - LEAST_PART, count).astype(int)).tolist():
        after = (np.arange(n) >= k).astype(float)[:, None, None]
        yield Row(kind=FindingKind.SLIP, columns=_flat(by_x * after), place=k)
        yield Row(kind=FindingKind.BASE_MOVED, columns=_flat(by_z * after), place=k)
    share = np.linspace(-0.5, 0.5, n)[:, None, None]
    yield Row(kind=FindingKind.DRIFT, columns=_flat(by_x * share))
    yield Row(kind=FindingKind.DELAY, columns=_flat(velocity(base_from_gripper)[..., None]))


def arm_rows(base_from_gripper: Poses) -> Iterator[Row]:
    """Yield the effects of the arm that depend on where its gripper is; n poses, residuals in base axes (m, rad)."""
    position, rotation = base_from_gripper[:, :3, 3], base_from_gripper[:, :3, :3]
    n = len(position)
    strain = np.zeros((n, 6, len(STRAINS)))
    strain[:, :3] = np.einsum("kab,nb->nak", STRAINS, position)
    yield Row(kind=FindingKind.LENGTHS, columns=_flat(strain), prior_std=0.1)
    # The base rotates towards the gripper by 1 rad per metre of horizontal reach.
    lean = np.cross(position, UP)
    yield Row(
        kind=FindingKind.BASE_LEANS,
        columns=_flat(np.concatenate([np.cross(lean, position), lean], axis=1)[..., None]),
        prior_std=0.2,
    )
    # The gripper rotates by its weight at a lever along each of its axes, 1 rad where that lever is level.
    sag = np.zeros((n, 6, 3))
    sag[:, 3:] = -rotation @ skew(rotation[:, 2])
    yield Row(kind=FindingKind.TOOL_SAGS, columns=_flat(sag), prior_std=0.1)


def velocity(base_from_gripper: Poses) -> Float[ndarray, "n 6"]:
    """Return the steps per image interval (base axes; m, rad) of an arm that moves smoothly through all poses."""
    # These imports take as long as all of SciPy that every command needs.
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    moment, little = np.arange(len(base_from_gripper), dtype=float), 1e-3
    position = CubicSpline(moment, base_from_gripper[:, :3, 3])
    rotation = RotationSpline(moment, Rotation.from_matrix(base_from_gripper[:, :3, :3]))
    rotation_between = rotation(moment + little) * rotation(moment - little).inv()
    return np.concatenate([position(moment, 1), rotation_between.as_rotvec() / (2 * little)], axis=1)


def _flat(columns: Float[ndarray, "n 6 d"]) -> Float[ndarray, "s d"]:
    """Return columns with one row per residual, s = 6n."""
    return columns.reshape(-1, columns.shape[2])


def joint_offsets(poses: PoseEquations, arm: Arm, joints: Joints) -> JointOffsets:
    """Return the offset of each joint (rad), true angle less reported one, and its standard deviation.

    Best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at the most likely sizes of the
    errors of the poses. An offset that no pose shows, as of the first joint, keeps the standard deviation of any joint.
    """
    sizes = most_likely(poses.equations)[0]
    solution = solve_equations(poses.equations, sizes)
    size = float(np.sqrt(poses.equations.variances(sizes)[2]))
    columns = _flat(error_jacobian(arm, joints)[:, :, : arm.dof])
    columns = columns - poses.region.by_unknown @ (poses.region.fit @ columns)
    offset = size**2 * columns.T @ solution.weighed_left
    known = np.diag(columns.T @ solution.projection @ columns)
    return JointOffsets(offset, size * np.sqrt(np.maximum(1 - size**2 * known, 0.0)), size)
