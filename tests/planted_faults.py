"""Plant one error in each stage of a copy of the source, and report whether the tests named for it fail.

`python tests/planted_faults.py [STAGE ...]` runs all rows or those that are named; exit status 1 means an undetected
error.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = (
    "src",
    "tests",
    "simulation",
    "benchmarks",
    "examples",
    "docs",
    "ros2",
    "pyproject.toml",
    "README.md",
)


class PlantedFault(NamedTuple):
    """An edit of the source, and the tests that must fail after it."""

    stage: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]


FAULTS = (
    PlantedFault(
        "geometry",
        "src/jcr/geometry.py",
        "rotation_exp(step[..., 3:]) @ a_from_b[..., :3, :3]",
        "a_from_b[..., :3, :3] @ rotation_exp(step[..., 3:])",
        ("tests/test_geometry.py",),
    ),
    PlantedFault(
        "camera",
        "src/jcr/camera.py",
        "camera.fy * y / z + camera.cy",
        "camera.fy * y / z + camera.cx",
        ("tests/test_camera.py",),
    ),
    PlantedFault(
        "capture",
        "src/jcr/capture/conventions.py",
        '"kuka": Convention((*_XYZ, "a", "b", "c"), "ZYX"',
        '"kuka": Convention((*_XYZ, "a", "b", "c"), "zyx"',
        ("tests/capture/test_readers.py",),
    ),
    PlantedFault(
        "features",
        "src/jcr/features/gate.py",
        "if gaps[best] < rotation_tolerance(",
        "if gaps[best] > rotation_tolerance(",
        ("tests/features/test_gate.py",),
    ),
    PlantedFault(
        "structure from motion",
        "src/jcr/sfm/track_refinement.py",
        "return (x_px + 0.5) * factor - 0.5",
        "return x_px * factor",
        ("tests/sfm/test_track_refinement.py",),
    ),
    PlantedFault(
        "photometric",
        "src/jcr/photometric/residuals.py",
        "weight = (seen & some.agreed) / (1 + _squared(residual) / np.float32(sigma**2)) ** 2",
        "weight = (seen & some.agreed) / (1 + _squared(residual) / np.float32(sigma**2))",
        ("tests/photometric/test_direct.py::test_gradient_is_that_of_the_energy",),
    ),
    PlantedFault(
        "pointmaps",
        "src/jcr/pointmaps/grid.py",
        "return (x_px + 0.5) * self.scale - 0.5 - np.array(self.crop_corner)",
        "return x_px * self.scale - np.array(self.crop_corner)",
        ("tests/pointmaps/test_grid.py", "tests/pointmaps/test_adapters.py"),
    ),
    PlantedFault(
        "estimation",
        "src/jcr/estimation/closed_form.py",
        "return transform(rotation, translation), scale, transform(base_rotation, base_translation)",
        "return transform(rotation, translation), 1 / scale, transform(base_rotation, base_translation)",
        ("tests/estimation/test_closed_form.py",),
    ),
    PlantedFault(
        "boards",
        "src/jcr/boards/detection.py",
        "true = margin + square * corners - HALF_PIXEL",
        "true = margin + square * corners",
        ("tests/boards/test_detection.py",),
    ),
    PlantedFault(
        "findings",
        "src/jcr/findings/finding.py",
        'finding.kind.row.group != "images", not is_cause(finding)',
        'finding.kind.row.group != "images", is_cause(finding)',
        ("tests/calibration/test_findings.py",),
    ),
    PlantedFault(
        "pipeline",
        "src/jcr/pipeline/selection.py",
        'return rejection is None, is_explained, -float("inf") if error is None else -error.length_m',
        'return rejection is None, is_explained, -float("inf") if error is None else error.length_m',
        ("tests/test_attempts.py",),
    ),
    PlantedFault(
        "calibration",
        "src/jcr/calibration/case.py",
        "if not accepted or not judged(hand_eye).converged:",
        "if not accepted and not judged(hand_eye).converged:",
        ("tests/calibration/test_findings.py", "tests/calibration/test_faults.py"),
    ),
    PlantedFault(
        "depth",
        "src/jcr/depth/consistency.py",
        "(abs(there - here) < tolerance * here)",
        "(abs(there - here) < tolerance)",
        ("tests/depth/test_dense.py",),
    ),
    PlantedFault(
        "map",
        "src/jcr/scene/scene_map.py",
        'apply(require_rigid(np.asarray(base_from_robot, float), "base_from_robot"), centers)',
        'apply(np.linalg.inv(require_rigid(np.asarray(base_from_robot, float), "base_from_robot")), centers)',
        ("tests/scene/test_map_robot.py",),
    ),
    PlantedFault(
        "segments",
        "src/jcr/segments/measure.py",
        "middle = float(np.median(height[around]))",
        "middle = float(height.max())",
        ("tests/segments/test_segment.py",),
    ),
    PlantedFault(
        "cell",
        "src/jcr/cell/stage.py",
        "lambda p, k=k: p.z[0] @ inverse(p.z[k])",
        "lambda p, k=k: p.z[k] @ inverse(p.z[0])",
        ("tests/cell/test_cell.py::test_the_base_of_a_second_arm_is_found_from_its_wrist_camera",),
    ),
    PlantedFault(
        "export",
        "src/jcr/export/ros.py",
        "mount.parent_from_child @ inverse(root_from_optical)",
        "mount.parent_from_child @ root_from_optical",
        ("tests/export/test_export.py",),
    ),
    PlantedFault(
        "report",
        "src/jcr/report/render.py",
        "autoescape=True",
        "autoescape=False",
        ("tests/report/test_report.py",),
    ),
    PlantedFault(
        "live server",
        "src/jcr/live/server.py",
        "if origin is not None and not self._is_own_origin(origin):",
        "if origin is None and not self._is_own_origin(origin):",
        ("tests/live/test_server.py",),
    ),
    PlantedFault(
        "run folder",
        "src/jcr/run_folder.py",
        "fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)",
        ("tests/test_run_folder.py",),
    ),
    PlantedFault(
        "files",
        "src/jcr/files.py",
        "        temporary.unlink(missing_ok=True)",
        "        pass",
        ("tests/test_files.py",),
    ),
)


def copy_source(into: Path) -> None:
    """Copy what the tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, into / name, ignore=shutil.ignore_patterns("__pycache__", "_site"))
        else:
            shutil.copy(source, into / name)


def failed_test(fault: PlantedFault, copy: Path) -> str:
    """Return the test that fails while the error is in the copy, and passes without; empty where none does.

    Raises ValueError where the edit does not apply.
    """
    file = copy / fault.file
    text = file.read_text()
    if text.count(fault.before) != 1:
        raise ValueError(f"{fault.file} does not contain the line once: {fault.before}")
    file.write_text(text.replace(fault.before, fault.after))
    try:
        failed = _first_failure(copy, fault.tests)
    finally:
        file.write_text(text)
    if failed and _first_failure(copy, (failed,)):
        raise ValueError(f"{failed} fails without the error, too")
    return failed


def _first_failure(copy: Path, tests: tuple[str, ...]) -> str:
    """Return the first test that fails, or an empty text."""
    environment = os.environ | {
        "PYTHONPATH": f"{copy / 'src'}{os.pathsep}{copy}",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    # 1: tests failed. Others: nothing was collected, or pytest itself failed.
    if done.returncode not in (0, 1):
        raise ValueError(f"pytest ended with status {done.returncode}: {done.stdout[-500:]}")
    failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failures[0].split(" - ")[0].split(" ", 1)[1] if done.returncode else ""


def main(names: list[str]) -> int:
    """Plant the errors and print a row for each."""
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy_source(Path(folder))
        for fault in FAULTS:
            if names and fault.stage not in names:
                continue
            try:
                failed = failed_test(fault, Path(folder))
            except ValueError as error:
                sys.stdout.write(f"{fault.stage}: {error}\n")
                missed += 1
                continue
            missed += not failed
            sys.stdout.write(f"{fault.stage}: {failed or 'NOT CAUGHT'}\n")
            sys.stdout.flush()
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
