"""`benchmarks kinhec`: KinHEC's tier small by its own protocol, beside its solvers.

KinHEC (extra `dev`) generates sequences of gripper and camera poses with known transforms: noise, motions, outliers,
asynchronous clocks, monocular scale, drift and wrong kinematics. Solvers take key frames 5° or 20 mm apart, at most 200.
"""

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import chi2

from benchmarks.page import table
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.extras import extra
from jcr.geometry import rotation_angle, step_between

OURS = "jcr"
EVERY = 10
"""One sequence in this many is measured."""
REGION = float(chi2.ppf(0.95, 6))
"""Squared Mahalanobis distance within which 95 % of the errors are."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """Error of one solver on one sequence."""

    mm: float
    deg: float
    squared: float = np.nan
    """Squared Mahalanobis distance from the truth; NaN of a solver without an uncertainty."""
    accepted: bool = True


def run() -> str:
    """Return the page in Markdown: errors of all solvers, and χ² of jcr, per track."""
    extra("kinhec.benchmark", "dev", "bench kinhec")
    results = measure()
    accepted = [one for found in results.values() for one in found[OURS] if one.accepted]
    beyond = np.mean([one.squared > REGION for one in accepted])
    ahead = sum(_median(found[OURS]) <= min(map(_median, found.values())) for found in results.values())
    claim = (
        f"> KinHEC, tier small, every {EVERY}th sequence: jcr has the smallest median error in {ahead} of "
        f"{len(results)} tracks; {100 * beyond:.0f} % of {len(accepted)} accepted results are beyond their 95 % region."
    )
    return f"{claim}\n\n{page(results)}"


def _median(results: Sequence[Result]) -> float:
    """Return the median error in mm."""
    return float(np.median([one.mm for one in results]))


def measure(tracks: Sequence[str] = (), every: int = EVERY) -> dict[str, dict[str, list[Result]]]:
    """Return the results of all solvers, by track and solver, on every `every`-th sequence of the tracks."""
    from kinhec.generator import generate_sequence
    from kinhec.io import Sequence as Recorded
    from kinhec.plans import build_plan, load_tier

    results: dict[str, dict[str, list[Result]]] = {}
    for track, plan in build_plan(load_tier("small"), list(tracks) or None).items():
        found: dict[str, list[Result]] = defaultdict(list)
        for config in plan[::every]:
            made = generate_sequence(config)
            recorded = Recorded(made.manifest, made.robot_table, made.camera_table)
            for name, result in _solved(recorded, config.scale["enabled"]).items():
                found[name].append(result)
        results[track] = found
        sys.stderr.write(f"{track}: {len(plan[::every])} sequences\n")
    return results


def _solved(recorded: object, monocular: bool) -> dict[str, Result]:
    """Return the result of each solver on one sequence; empty where there are fewer than three key frames."""
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
    found = {OURS: _own_result(gripper, camera, true, monocular)}
    for name, solve in SOLVERS.items():
        try:
            found[name] = _result(solve(data, np.random.default_rng(0))["X"], true)
        except (np.linalg.LinAlgError, ValueError):
            found[name] = Result(mm=np.inf, deg=np.inf)
    return found


def _own_result(
    gripper: Float[ndarray, "n 4 4"],
    camera: Float[ndarray, "n 4 4"],
    true: Float[ndarray, "4 4"],
    monocular: bool,
) -> Result:
    """Return the result of this project; camera poses of boards are in metres."""
    solved = solve_hand_eye(gripper, camera, scale=None if monocular else 1.0)
    off, covariance = step_between(solved.gripper_from_camera, true), solved.covariance[:6, :6]
    plain = _result(solved.gripper_from_camera, true)
    squared = float(off @ np.linalg.solve(covariance, off))
    return Result(mm=plain.mm, deg=plain.deg, squared=squared, accepted=solved.converged)


def _result(x: Float[ndarray, "4 4"], true: Float[ndarray, "4 4"]) -> Result:
    """Return the error of a transform."""
    deg = np.degrees(rotation_angle(x[:3, :3].T @ true[:3, :3]))
    return Result(mm=1e3 * float(np.linalg.norm(x[:3, 3] - true[:3, 3])), deg=float(deg))


def page(results: dict[str, dict[str, list[Result]]]) -> str:
    """Return the results as a Markdown table."""
    rows = []
    for track, found in results.items():
        own = found[OURS]
        accepted = [one for one in own if one.accepted]
        medians = {name: np.median([(one.mm, one.deg) for one in row], axis=0) for name, row in found.items()}
        best = min((name for name in medians if name != OURS), key=lambda name, of=medians: of[name][0])
        beyond = np.mean([one.squared > REGION for one in accepted]) if accepted else np.nan
        rows.append(
            [
                track,
                f"{len(own)}",
                *(f"{medians[OURS][k]:.3g}" for k in range(2)),
                f"{best}: {medians[best][0]:.3g} mm {medians[best][1]:.3g}°",
                f"{len(accepted)}",
                f"{100 * beyond:.0f} %",
                f"{np.median([one.squared for one in accepted]):.1f}" if accepted else "–",
            ]
        )
    head = "track | sequences | median mm | ° | best of the others | accepted | beyond 95 % | median χ²"
    return "\n".join(table(head, rows)) + "\n"
