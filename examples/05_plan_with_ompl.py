"""Plan an arm past the things on the mapped table without touching them, with OMPL's RRT-Connect.

    jcr run examples/tabletop out/tabletop
    python examples/05_plan_with_ompl.py out/tabletop

Needs `pip install 'jcr-handeye[planning]'`. The arm (arm.urdf) moves its gripper from one side of a carton to the other.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import yourdfpy
from jaxtyping import Bool, Float
from numpy import ndarray
from ompl import base, geometric, util
from scipy.spatial.transform import Rotation

import jcr

ARM = Path(__file__).parent / "arm.urdf"
START = np.array([-0.34, 0.80, -0.66, 1.04, 0.08, 1.10])
"""Joint angles (rad): the gripper points down at (0.46, -0.19), 7 cm above the table."""
GOAL = np.array([0.13, 0.85, -0.71, 1.47, 0.03, 1.10])
"""At (0.45, 0.07), 4 cm above it. The carton stands between them."""
STEP_RAD = 0.01
"""Between the joint values that are checked along a motion; it moves the gripper by at most 8 mm."""


SPHERES = (
    (1, (0, 0, 0.01), (0, 0, 0.05), 3, 0.06),
    (2, (0, 0, -0.005), (0, 0, 0.355), 13, 0.05),
    (3, (0.01, 0, 0), (0.27, 0, 0), 10, 0.042),
    (4, (0.02, 0, 0), (0.06, 0, 0), 3, 0.042),
    (5, (0.01, 0, 0), (0.03, 0, 0), 2, 0.042),
    (6, (0.015, 0, 0), (0.045, 0, 0), 2, 0.037),
    (6, (0.07, 0, 0), (0.11, 0, 0), 3, 0.022),
)
"""Spheres that cover the links: the joint that moves them, the first and last centre on the link (m), number, radius."""


class Clearance:
    """Whether the arm touches the mapped scene at joint values (…,6); its foot is bolted to the table."""

    def __init__(self, scene: jcr.SceneMap) -> None:
        self.scene, arm = scene, yourdfpy.URDF.load(ARM, load_meshes=False)
        self.joints = [arm.joint_map[name] for name in ("mount", *arm.actuated_joint_names)]
        self.radii = np.concatenate([np.full(count, radius) for *_, count, radius in SPHERES])
        self.gripper = np.concatenate([np.full(count, joint == 6) for joint, _, _, count, _ in SPHERES])

    def centers(self, joint_values: Float[ndarray, "*batch 6"]) -> Float[ndarray, "*batch s 3"]:
        """Centres of the spheres in the base frame, m."""
        poses = [np.asarray(self.joints[0].origin)]
        for k, joint in enumerate(self.joints[1:]):
            turn = np.tile(joint.origin, (*joint_values.shape[:-1], 1, 1))
            about = Rotation.from_rotvec(joint_values[..., k].reshape(-1, 1) * joint.axis).as_matrix()
            turn[..., :3, :3] = turn[..., :3, :3] @ about.reshape(turn[..., :3, :3].shape)
            poses.append(poses[-1] @ turn)
        found = []
        for joint, first, last, count, _ in SPHERES:
            rotation, origin = poses[joint][..., :3, :3], poses[joint][..., None, :3, 3]
            found.append(np.linspace(first, last, count) @ np.swapaxes(rotation, -1, -2) + origin)
        return np.concatenate(found, axis=-2)

    def touches(self, joint_values: Float[ndarray, "*batch 6"]) -> Bool[ndarray, "*batch"]:
        """The gripper may go only where someone has looked; the rest of the arm must clear what was seen.

        The images show the table, not the space about the arm's own base.
        """
        centers, mine = self.centers(joint_values), self.gripper
        seen = self.scene.check_spheres(centers, self.radii, unknown="free").any(-1)
        unseen = self.scene.check_spheres(centers[..., mine, :], self.radii[mine], unknown="occupied")
        return np.asarray(seen | unseen.any(-1))


class Motions(base.MotionValidator):
    """Asks for all steps of a motion at once, which takes hardly longer than one of them."""

    def __init__(self, information: base.SpaceInformation, clearance: Clearance) -> None:
        super().__init__(information)
        self.clearance = clearance

    def checkMotion(self, start: Any, end: Any) -> bool:
        """Whether nothing is touched on the straight way from start to end."""
        ends = np.array([joint_values(start), joint_values(end)])
        steps = int(np.ceil(np.linalg.norm(ends[1] - ends[0]) / STEP_RAD)) + 1
        return not self.clearance.touches(np.linspace(*ends, max(steps, 2))).any()


def joint_values(state: Any) -> list[float]:
    """Of a state of OMPL's."""
    return [state[joint] for joint in range(6)]


def plan(
    clearance: Clearance, start: Float[ndarray, "6"], goal: Float[ndarray, "6"], seconds: float = 60.0
) -> Float[ndarray, "n 6"]:
    """Joint values from start to goal, STEP_RAD apart, none of which touches; RuntimeError where none are found."""
    space = base.RealVectorStateSpace(6)
    bounds = base.RealVectorBounds(6)
    for k, joint in enumerate(yourdfpy.URDF.load(ARM, load_meshes=False).actuated_joints):
        bounds.setLow(k, joint.limit.lower)
        bounds.setHigh(k, joint.limit.upper)
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: not clearance.touches(np.array(joint_values(state))))
    setup.getSpaceInformation().setMotionValidator(Motions(setup.getSpaceInformation(), clearance))
    ends = [space.allocState(), space.allocState()]
    for state, values in zip(ends, (start, goal), strict=True):
        for joint, value in enumerate(values):
            state[joint] = float(value)
    setup.setStartAndGoalStates(*ends)
    planner = geometric.RRTConnect(setup.getSpaceInformation())
    planner.setRange(0.2)  # the ways between things are short
    setup.setPlanner(planner)
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        raise RuntimeError("no way was found; give more time, or images of what is still unknown")
    setup.simplifySolution(2.0)
    path = setup.getSolutionPath()
    path.interpolate(max(2, int(np.ceil(path.length() / STEP_RAD))))
    return np.array([joint_values(state) for state in path.getStates()])


def main() -> None:
    """Plan on the map of a run folder and write the joint values."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/tabletop")
    util.RNG.setSeed(1)
    util.setLogLevel(util.LogLevel.LOG_ERROR)
    clearance = Clearance(jcr.load_map(out))
    straight = np.linspace(START, GOAL, 100)
    print(f"straight on: touches at {int(clearance.touches(straight).sum())} of {len(straight)} steps")
    path = plan(clearance, START, GOAL)
    np.savetxt(out / "plan.csv", path, "%.6f", ",", header="joint1..joint6, rad")
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    print(f"planned: {len(path)} steps, {length:.2f} rad, touches at {int(clearance.touches(path).sum())}")
    print(f"wrote {out / 'plan.csv'}")


if __name__ == "__main__":
    main()
