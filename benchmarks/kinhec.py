"""Hand-eye solvers on KinHEC's tier small by its own protocol.

KinHEC (extra `dev`) generates sequences of gripper and camera poses with known transforms: noise, motions, outliers,
asynchronous clocks, monocular scale, drift and wrong kinematics. Solvers take key frames 5° or 20 mm apart, at most 200.
Errors in mm and degrees are from the nominal transform. Regions are compared with the effective one, which differs if
the kinematics are wrong: a constant error of the last joint turns the gripper's frame, and no pose shows it.
"""

import sys
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from benchmarks.page import apart, squared_distance, table
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.estimation.pose_equations import fit_known_scale
from jcr.extras import extra
from jcr.geometry import Transform, step_between

OURS = "jcr"
REGION = float(chi2.ppf(0.95, 6))
"""Squared Mahalanobis distance within which 95 % of the errors are."""
POSE = "px", "py", "pz", "qw", "qx", "qy", "qz"
"""Components of a pose in the columns of KinHEC's tables."""
MOST_POSES = 200
"""Largest number of poses of a sequence that determine its effective transform."""
TOLERANCE = (1e-3, 2e-3)
"""Errors (m, rad) that weigh the same in the effective transform."""


class Result(NamedTuple):
    """Error of one solver on one sequence."""

    mm: float
    deg: float
    squared: float = np.nan
    """Squared Mahalanobis distance from the effective transform; NaN of a solver without an uncertainty."""
    accepted: bool = True


def run(every: int = 1, seed: int = 0) -> str:
    """Return the page in Markdown: errors of all solvers, and χ² of jcr, for one in `every` sequences of each track.

    `seed` is added to the seed of the tier, from which the random numbers of all sequences follow.
    """
    extra("kinhec.benchmark", "dev", "bench kinhec")
    from kinhec.plans import build_plan, load_tier

    rows, squared, ahead = [], [], 0
    tier, pool = load_tier("small"), ProcessPoolExecutor()
    tier["global_seed"] += seed
    for track, whole in build_plan(tier, None).items():
        plan = whole[::every]
        found: dict[str, list[Result]] = defaultdict(list)
        for name, result in chain.from_iterable(pool.map(_of_sequence, plan)):
            found[name].append(result)
        medians = {name: np.median([one[:2] for one in some], axis=0) for name, some in found.items()}
        own = medians.pop(OURS)
        best = min(medians, key=lambda name, of=medians: of[name][0])
        accepted = [one.squared for one in found[OURS] if one.accepted]
        beyond = f"{100 * np.mean([one > REGION for one in accepted]):.0f} %" if accepted else "–"
        median = f"{np.median(accepted):.1f}" if accepted else "–"
        other = f"{best}: {medians[best][0]:.3g} mm {medians[best][1]:.3g}°"
        sizes = [f"{value:.3g}" for value in own]
        rows.append([track, len(found[OURS]), *sizes, other, len(accepted), beyond, median])
        squared += accepted
        ahead += own[0] <= medians[best][0]
        sys.stderr.write(" | ".join(map(str, rows[-1])) + "\n")
    head = "track | sequences | median mm | ° | best of the others | accepted | beyond 95 % | median χ²"
    which = ["whole" if every == 1 else f"every {every}th sequence of a track"]
    which += [f"drawn with the seed {tier['global_seed']} in place of the published one"] if seed else []
    claim = (
        f"> KinHEC, tier small, {', '.join(which)}: jcr has the smallest median error in {ahead} of {len(rows)} "
        f"tracks; {100 * np.mean([one > REGION for one in squared]):.0f} % of {len(squared)} accepted results are "
        "beyond their 95 % region."
    )
    other_seeds = (
        "`python -m benchmarks kinhec --seed 1` draws other sequences of the tier, any number still others."
    )
    return "\n".join([claim, "", other_seeds, "", *table(head, rows)]) + "\n"


def _of_sequence(config: Any) -> list[tuple[str, Result]]:
    """Generate the sequence of a configuration of KinHEC; return the name of each solver and its result on it."""
    from kinhec.generator import generate_sequence
    from kinhec.io import Sequence as Recorded

    made = generate_sequence(config)
    recorded = Recorded(made.manifest, made.robot_table, made.camera_table)
    effective = _effective_transform(made.robot_table, config.robot, recorded.X)
    return [*_solved(recorded, effective, config.scale["enabled"]).items()]


def _effective_transform(robot_table: Any, robot: str, nominal: Transform) -> Transform:
    """Return the effective hand-eye transform of a sequence: the best fit to its noise-free reported poses.

    The reported poses are those of the nominal kinematics of `robot` at the true joint angles. `nominal` is the true
    transform (gripper_from_camera), and the result for a robot without joints.
    """
    from kinhec.kinematics import forward_kinematics_batch
    from kinhec.robots import get_robot
    from kinhec.se3 import pq_to_pose

    rows = np.linspace(0, robot_table.num_rows - 1, min(robot_table.num_rows, MOST_POSES)).astype(int)
    some = robot_table.take(rows)
    joints = np.array(some["q_gt"].to_pylist())
    if joints.size == 0:
        return nominal
    reported = forward_kinematics_batch(get_robot(robot), joints)
    true = pq_to_pose(np.stack([some[f"base_ee_gt_{name}"] for name in POSE], axis=1))
    return fit_known_scale(reported, true @ nominal, (nominal, np.eye(4)), TOLERANCE).gripper_from_camera


def _solved(recorded: object, effective: Transform, monocular: bool) -> dict[str, Result]:
    """Return the result of each solver on one sequence; empty where there are fewer than three key frames.

    `effective` is the effective hand-eye transform (gripper_from_camera), with which the region of jcr is compared.
    """
    from kinhec.benchmark import KEYFRAME_MIN_ROT_DEG, KEYFRAME_MIN_TRANS_M, MAX_KEYFRAMES, SOLVERS
    from kinhec.motions import motion_pairs, select_keyframes
    from kinhec.se3 import relative_motions

    gripper, camera = recorded.axyb_poses()  # type: ignore[attr-defined]
    rows = select_keyframes(gripper, KEYFRAME_MIN_ROT_DEG, KEYFRAME_MIN_TRANS_M, MAX_KEYFRAMES)
    if len(rows) < 3:
        return {}
    gripper, camera = gripper[rows], camera[rows]
    pairs = motion_pairs(len(rows), "consecutive")
    data = gripper, camera, relative_motions(gripper, pairs), relative_motions(camera, pairs)
    true = recorded.X  # type: ignore[attr-defined]
    # Camera poses of boards are in metres.
    own = solve_hand_eye(gripper, camera, scale=None if monocular else 1.0)
    squared = squared_distance(step_between(own.gripper_from_camera, effective), own.covariance[:6, :6])
    found = {OURS: Result(*apart(own.gripper_from_camera, true), float(squared), own.converged)}
    for name, solve in SOLVERS.items():
        try:
            found[name] = Result(*apart(solve(data, np.random.default_rng(0))["X"], true))
        except (np.linalg.LinAlgError, ValueError):
            found[name] = Result(np.inf, np.inf)
    return found
