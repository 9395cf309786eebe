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
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.cameras import COUNT, answered, wanted
from benchmarks.faults import IMAGES, OBSERVED, calibrated
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.estimation.arms import arm_named
from jcr.estimation.hand_eye import fit_hand_eye
from jcr.geometry import step_between
from jcr.reconstruction_npz import read_reconstruction
from jcr.records import HandEye
from simulation.boards import Sheet, with_sheet
from simulation.cells import Kind, cell_problem
from simulation.faults import Faults, faulty_capture, reconstructed
from simulation.problems import bent_problem, hand_eye_problem

Record = dict[str, Any]
COUNTED = (("jcr.estimation.image_equations", "without_points"), ("jcr.estimation.solve", "pose_equations"))
"""Functions whose calls are counted as linearisations, by module."""
CELLS: tuple[Kind, ...] = ("fixed", "wrists", "arms", "carried")
ARMS = (("panda", "typical", 12), ("ur5e", "low-cost", 8), ("iiwa7", "white", 30))
TOLERANCE = 0.05
"""Largest accepted change of a result, in standard deviations of the state before."""


def cases(captures: Path, runs: Path) -> Iterator[tuple[str, Callable[[], Record]]]:
    """Yield the name of each problem and a function that solves it."""
    for folder in sorted(path.parent for path in runs.glob("*/reconstruction.npz")):
        yield f"capture {folder.name}", lambda folder=folder: _record_run(captures, folder)
    for k, case in enumerate(OBSERVED):
        name = f"fault {k} {case.what}"
        assert isinstance(case.fault, Faults)
        yield name, lambda case=case, faults=case.fault: _record(calibrated(faults, 0, given=case.given)[1])
    for seed in range(3):
        estimated = seed % 2 == 1
        yield (
            f"clean {seed}",
            lambda seed=seed, estimated=estimated: _record(
                calibrated(Faults(), 1000 + seed, (8, 12, 20)[seed], given=not estimated)[1]
            ),
        )
    yield "sheet, bent", lambda: _record(_with_sheet(Sheet(bend_m=2e-3)))
    yield "sheet, size 1 % off", lambda: _record(_with_sheet(Sheet(size_error=0.01)))
    for arm, preset, count in ARMS:
        yield f"arm {arm} {preset} {count}", lambda a=arm, p=preset, c=count: _record(_arm(a, p, c))
    yield "poses with camera covariance", lambda: _record(_weighed_poses())
    for kind in CELLS:
        yield f"cell {kind}", lambda kind=kind: _record_cell(kind)


def measure(captures: Path, runs: Path, out: Path) -> None:
    """Solve all problems and write their records as JSON."""
    calls = [0]
    for module, name in COUNTED:
        _count_calls(import_module(module), name, calls)
    records: dict[str, Record] = {}
    for name, solve in cases(captures, runs):
        calls[0], start = 0, time.process_time()
        try:
            record = solve()
        except Exception as error:  # noqa: BLE001 (a failure is a result to compare)
            record = {"verdict": f"failed: {type(error).__name__}", "findings": [], "x": None, "std": None}
        record |= {"linearisations": calls[0], "seconds": round(time.process_time() - start, 3)}
        records[name] = record
        sys.stderr.write(f"{name}: {record['verdict']}, {record['seconds']:.1f} s\n")
    out.write_text(json.dumps(records, indent=1) + "\n")


def compare(before: Path, after: Path) -> int:
    """Print each difference and the totals; return the number of problems that differ."""
    old, new = json.loads(before.read_text()), json.loads(after.read_text())
    changed = 0
    for name in [name for name in old if name in new]:
        differences = list(_differences(old[name], new[name]))
        changed += bool(differences)
        for text in differences:
            sys.stdout.write(f"{name}: {text}\n")
    both = [name for name in old if name in new]
    for what in ("linearisations", "seconds"):
        totals = [sum(one[name][what] for name in both) for one in (old, new)]
        sys.stdout.write(f"{what}: {totals[0]:.0f} before, {totals[1]:.0f} after\n")
    alone = [len(one) - len(both) for one in (old, new)]
    sys.stdout.write(
        f"{changed} of {len(both)} problems differ; {alone[0]} only before, {alone[1]} only after\n"
    )
    return changed


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


def _record_run(captures: Path, run: Path) -> Record:
    """Return the record of a capture that is calibrated from a stored reconstruction."""
    capture = read_capture(captures / run.name)
    return _record(calibrate(capture, read_reconstruction(run / "reconstruction.npz")))


def _record(hand_eye: HandEye) -> Record:
    """Return verdict, findings and result of a calibration."""
    return {
        "verdict": hand_eye.verdict,
        "findings": sorted(f"{one.severity}: {one.kind}" for one in hand_eye.findings),
        "x": hand_eye.gripper_from_camera.tolist(),
        "std": np.sqrt(np.diag(hand_eye.covariance)[:6]).tolist(),
        "scale": float(hand_eye.scale),
    }


def _record_cell(kind: Kind) -> Record:
    """Return the last transform that is sought in a simulated cell."""
    problem = cell_problem(kind, "typical", COUNT, 0)
    answer = answered(problem, 0)
    found, covariance = answer.transform(list(wanted(problem).values())[-1])
    return {
        "verdict": "solved",
        "findings": [],
        "x": found.tolist(),
        "std": np.sqrt(np.diag(covariance)).tolist(),
    }


def _with_sheet(sheet: Sheet) -> HandEye:
    """Return the calibration of a simulated capture whose scene contains a printed sheet."""
    rng = np.random.default_rng([0, IMAGES])
    bare = faulty_capture(rng, IMAGES)
    capture, reconstruction = reconstructed(bare, False)
    return calibrate(capture, replace(reconstruction, tracks=with_sheet(bare, rng, sheet).tracks))


def _arm(arm: str, preset: Any, count: int) -> HandEye:
    """Return the calibration of poses of an arm with systematic errors, its joint angles known."""
    problem = bent_problem(arm_named(arm), preset, count, 0)
    return fit_hand_eye(
        problem.base_from_gripper, problem.recon_from_camera, joints=problem.joints, robot=problem.bent.arm
    )


def _weighed_poses() -> HandEye:
    """Return the calibration of camera poses with a stated covariance, one of 14 gripper poses being wrong."""
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 14, robot_noise=(5e-4, 1e-3), camera_noise=(1e-3, 2e-3))
    gripper = problem.base_from_gripper.copy()
    gripper[3, :3, 3] += 0.1
    variance = np.tile(np.repeat([1e-3 / problem.scale, 2e-3], 3), 14) ** 2
    return fit_hand_eye(gripper, problem.recon_from_camera, camera_covariance=np.diag(variance))


if __name__ == "__main__":
    command, *paths = sys.argv[1], *map(Path, sys.argv[2:])
    if command == "measure":
        measure(*paths)
    else:
        sys.exit(bool(compare(*paths)))
