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

import jcr

ARM = Path(__file__).parent / "arm.urdf"
START = np.array([-0.34, 0.80, -0.66, 1.04, 0.08, 1.10])
"""Joint angles (rad): the gripper points down at (0.46, -0.19), 7 cm above the table."""
GOAL = np.array([0.13, 0.85, -0.71, 1.47, 0.03, 1.10])
"""At (0.45, 0.07), 4 cm above it. The carton stands between them."""
STEP_RAD = 0.01
"""Between the joint values that are checked along a motion; it moves the gripper by at most 8 mm."""


class Clearance:
    """Whether the arm touches the mapped scene at joint values (…,6)."""

    def __init__(self, scene: jcr.SceneMap, arm: jcr.RobotSpheres) -> None:
        self.scene = scene
        self.arm = arm.without(("foot",))  # bolted to the table
        self.gripper = arm.without(tuple(link for link in arm.links if link != "gripper"))

    def touches(self, joint_values: Float[ndarray, "*batch 6"]) -> Bool[ndarray, "*batch"]:
        """The gripper may go only where someone has looked; the rest of the arm must clear what was seen.

        The images show the table, not the space about the arm's own base.
        """
        seen = self.scene.check_robot(self.arm, joint_values, unknown="free")
        return np.asarray(seen | self.scene.check_robot(self.gripper, joint_values, unknown="occupied"))


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
    clearance = Clearance(jcr.load_map(out), jcr.load_robot(ARM))
    straight = np.linspace(START, GOAL, 100)
    print(f"straight on: touches at {int(clearance.touches(straight).sum())} of {len(straight)} steps")
    path = plan(clearance, START, GOAL)
    np.savetxt(out / "plan.csv", path, "%.6f", ",", header="joint1..joint6, rad")
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    print(f"planned: {len(path)} steps, {length:.2f} rad, touches at {int(clearance.touches(path).sum())}")
    print(f"wrote {out / 'plan.csv'}")


if __name__ == "__main__":
    main()
