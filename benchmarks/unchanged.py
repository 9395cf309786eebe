"""`python -m benchmarks.unchanged`: estimates of stored and simulated captures before and after a change of the code.

`measure CAPTURES RUNS OUT.json` calibrates the captures below CAPTURES from the reconstructions in the run folders of
the same names below RUNS, and forty simulated problems. `compare BEFORE.json AFTER.json` lists differences of
verdicts, findings and results in standard deviations.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np

from benchmarks.cameras import COUNT, answered, wanted
from benchmarks.faults import IMAGES, OBSERVED, calibrated
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.capture.read import read_capture
from jcr.estimation.arms import arm_named
from jcr.geometry import step_between
from jcr.records.reconstruction_npz import read_reconstruction
from simulation.boards import Sheet, with_sheet
from simulation.cells import Kind, cell_problem
from simulation.faults import Faults, faulty_capture, reconstructed
from simulation.problems import bent_problem, hand_eye_problem

Record = dict[str, Any]
COUNTED = (("jcr.estimation.image_equations", "without_points"), ("jcr.estimation.solve", "pose_equations"))
"""Functions whose calls are counted as linearisations, by module."""
ARMS = (("panda", "typical", 12), ("ur5e", "low-cost", 8), ("iiwa7", "white", 30))
TOLERANCE = 0.05
"""Largest accepted change of a result, in standard deviations of the state before."""


def cases(captures: Path, runs: Path) -> Iterator[tuple[str, Callable[[], Calibration | Record]]]:
    """Yield the name of each problem and a function that solves it."""
    for folder in sorted(path.parent for path in runs.glob("*/reconstruction.npz")):
        yield f"capture {folder.name}", partial(_stored, captures / folder.name, folder)
    for k, case in enumerate(OBSERVED):
        assert isinstance(case.fault, Faults)
        solve = partial(calibrated, case.fault, 0, given=case.given)
        yield f"fault {k} {case.what}", lambda solve=solve: solve()[1]
    for seed in range(3):
        images, given = (8, 12, 20)[seed], seed % 2 == 0
        yield f"clean {seed}", lambda s=seed, n=images, g=given: calibrated(Faults(), 1000 + s, n, given=g)[1]
    yield "sheet, bent", partial(_with_sheet, Sheet(bend_m=2e-3))
    yield "sheet, size 1 % off", partial(_with_sheet, Sheet(size_error=0.01))
    for arm, preset, count in ARMS:
        yield f"arm {arm} {preset} {count}", partial(_arm, arm, preset, count)
    yield "poses with camera covariance", _weighed_poses
    for kind in get_args(Kind):
        yield f"cell {kind}", partial(_cell, kind)


def measure(captures: Path, runs: Path, out: Path) -> None:
    """Solve all problems and write their records as JSON."""
    calls = [0]
    for module, name in COUNTED:
        _count_calls(import_module(module), name, calls)
    records: dict[str, Record] = {}
    for name, solve in cases(captures, runs):
        calls[0], start = 0, time.process_time()
        try:
            found = solve()
            record = found if isinstance(found, dict) else _record(found)
        except Exception as error:  # noqa: BLE001 (a failure is a result to compare)
            record = {"verdict": f"failed: {type(error).__name__}", "findings": [], "x": None, "std": None}
        record |= {"linearisations": calls[0], "seconds": round(time.process_time() - start, 3)}
        records[name] = record
        sys.stderr.write(f"{name}: {record['verdict']}, {record['seconds']:.1f} s\n")
    out.write_text(json.dumps(records, indent=1) + "\n")


def compare(before: Path, after: Path) -> int:
    """Print each difference and the totals; return the number of problems that differ."""
    old, new = json.loads(before.read_text()), json.loads(after.read_text())
    both = [name for name in old if name in new]
    different = {name: found for name in both if (found := list(_differences(old[name], new[name])))}
    for name, found in different.items():
        sys.stdout.writelines(f"{name}: {text}\n" for text in found)
    for what in ("linearisations", "seconds"):
        totals = [sum(one[name][what] for name in both) for one in (old, new)]
        sys.stdout.write(f"{what}: {totals[0]:.0f} before, {totals[1]:.0f} after\n")
    alone = [len(one) - len(both) for one in (old, new)]
    sys.stdout.write(
        f"{len(different)} of {len(both)} problems differ; {alone[0]} only before, {alone[1]} only after\n"
    )
    return len(different)


def _differences(old: Record, new: Record) -> Iterator[str]:
    """Yield what differs between two records of one problem."""
    if old["verdict"] != new["verdict"]:
        yield f"verdict {old['verdict']} -> {new['verdict']}"
    gone = [one for one in old["findings"] if one not in new["findings"]]
    added = [one for one in new["findings"] if one not in old["findings"]]
    if gone or added:
        yield f"findings gone {gone}, added {added}"
    if old["x"] is None or new["x"] is None:
        return
    std = np.array(old["std"])
    sigmas = np.abs(step_between(np.array(old["x"]), np.array(new["x"]))) / std
    if sigmas.max() > TOLERANCE:
        yield f"result moved by {sigmas.max():.2f} standard deviations"
    ratio = np.array(new["std"]) / std
    if np.abs(np.log(ratio)).max() > TOLERANCE:
        yield f"standard deviations {ratio.min():.2f} to {ratio.max():.2f} of those before"


def _count_calls(module: Any, name: str, calls: list[int]) -> None:
    """Replace a function of a module by one that counts its calls."""
    function = getattr(module, name)

    def counted(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        return function(*args, **kwargs)

    setattr(module, name, counted)


def _record(hand_eye: Calibration) -> Record:
    """Return verdict, findings and result of a calibration."""
    return {
        "verdict": hand_eye.verdict,
        "findings": sorted(f"{one.severity}: {one.kind}" for one in hand_eye.findings),
        "x": hand_eye.gripper_from_camera.tolist(),
        "std": np.sqrt(np.diag(hand_eye.covariance)[:6]).tolist(),
        "scale": float(hand_eye.scale),
    }


def _stored(capture: Path, run: Path) -> Calibration:
    """Calibrate a capture from a stored reconstruction."""
    return calibrate_reconstruction(read_capture(capture), read_reconstruction(run / "reconstruction.npz"))


def _cell(kind: Kind) -> Record:
    """Return the last transform that is sought in a simulated cell."""
    problem = cell_problem(kind, "typical", COUNT, 0)
    found, covariance = answered(problem, 0).transform(list(wanted(problem).values())[-1])
    std = np.sqrt(np.diag(covariance)).tolist()
    return {"verdict": "solved", "findings": [], "x": found.tolist(), "std": std}


def _with_sheet(sheet: Sheet) -> Calibration:
    """Calibrate a simulated capture whose scene contains a printed sheet."""
    rng = np.random.default_rng([0, IMAGES])
    bare = faulty_capture(rng, IMAGES)
    capture, reconstruction = reconstructed(bare, False)
    return calibrate_reconstruction(
        capture, replace(reconstruction, tracks=with_sheet(bare, rng, sheet).tracks)
    )


def _arm(arm: str, preset: Any, count: int) -> Calibration:
    """Solve by poses of an arm with systematic errors, its joint angles known."""
    p = bent_problem(arm_named(arm), preset, count, 0)
    return solve_hand_eye(p.base_from_gripper, p.recon_from_camera, joints=p.joints, robot=p.bent.arm)


def _weighed_poses() -> Calibration:
    """Solve by camera poses with a stated covariance, one of 14 gripper poses being wrong."""
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 14, robot_noise=(5e-4, 1e-3), camera_noise=(1e-3, 2e-3))
    gripper = problem.base_from_gripper.copy()
    gripper[3, :3, 3] += 0.1
    variance = np.tile(np.repeat([1e-3 / problem.scale, 2e-3], 3), 14) ** 2
    return solve_hand_eye(gripper, problem.recon_from_camera, camera_covariance=np.diag(variance))


if __name__ == "__main__":
    command, *paths = sys.argv[1], *map(Path, sys.argv[2:])
    if command == "measure":
        measure(*paths)
    else:
        sys.exit(bool(compare(*paths)))
