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

ROOT = Path(__file__).parents[1]
COPIED = "src", "tests", "simulation", "benchmarks", "examples", "docs", "ros2", "pyproject.toml", "README.md"
FAULTS = (
    ("geometry", "geometry.py", "test_geometry.py",
     "rotation_exp(step[..., 3:]) @ a_from_b[..., :3, :3]",
     "a_from_b[..., :3, :3] @ rotation_exp(step[..., 3:])"),
    ("camera", "camera.py", "test_camera.py",
     "camera.fy * y / z + camera.cy", "camera.fy * y / z + camera.cx"),
    ("capture", "capture/controllers.py", "capture/test_readers.py",
     '"kuka": Convention((*_XYZ, "a", "b", "c"), "ZYX"', '"kuka": Convention((*_XYZ, "a", "b", "c"), "zyx"'),
    ("features", "features/gate.py", "features/test_gate.py",
     "if gaps[k] < allowed else None", "if gaps[k] > allowed else None"),
    ("structure from motion", "sfm/track_refinement.py", "sfm/test_track_refinement.py",
     "((at + 0.5) * factor - 0.5 for at in (x_px, start_px))", "(at * factor for at in (x_px, start_px))"),
    ("photometric", "photometric/residuals.py", "photometric/test_direct.py::test_gradient_is_that_of_the_energy",
     "weight = (seen & some.agreed) / (1 + _squared(residual) / np.float32(sigma**2)) ** 2",
     "weight = (seen & some.agreed) / (1 + _squared(residual) / np.float32(sigma**2))"),
    ("pointmaps", "pointmaps/grid.py", "pointmaps/test_grid.py pointmaps/test_adapters.py",
     "return (x_px + 0.5) * self.scale - 0.5 - np.array(self.crop_corner)",
     "return x_px * self.scale - np.array(self.crop_corner)"),
    ("estimation", "estimation/closed_form.py", "estimation/test_closed_form.py",
     "return transform(rotation, x), scale, transform(base_rotation, z)",
     "return transform(rotation, x), 1 / scale, transform(base_rotation, z)"),
    ("boards", "boards/detection.py", "boards/test_detection.py",
     "true = margin + square * corners - HALF_PIXEL", "true = margin + square * corners"),
    ("findings", "findings/finding.py", "calibration/test_findings.py",
     'finding.kind.row.group != "images", not is_cause(finding)',
     'finding.kind.row.group != "images", is_cause(finding)'),
    ("pipeline", "pipeline/selection.py", "test_attempts.py",
     'return True, rejection is None, is_explained, -float("inf") if error is None else -error.length_m',
     'return True, rejection is None, is_explained, -float("inf") if error is None else error.length_m'),
    ("calibration", "calibration/case.py", "calibration/test_findings.py calibration/test_faults.py",
     "if not accepted or not judged(hand_eye).converged:",
     "if not accepted and not judged(hand_eye).converged:"),
    ("depth", "depth/consistency.py", "depth/test_dense.py",
     "(abs(there - here) < tolerance * here)", "(abs(there - here) < tolerance)"),
    ("map", "scene/scene_map.py", "scene/test_map_robot.py",
     'apply(require_rigid(np.asarray(base_from_robot, float), "base_from_robot"), centers)',
     'apply(np.linalg.inv(require_rigid(np.asarray(base_from_robot, float), "base_from_robot")), centers)'),
    ("segments", "segments/measure.py", "segments/test_segment.py",
     "middle = float(np.median(height[around]))", "middle = float(height.max())"),
    ("cell", "cell/stage.py", "cell/test_cell.py::test_the_base_of_a_second_arm_is_found_from_its_wrist_camera",
     "lambda p, k=k: p.z[0] @ inverse(p.z[k])", "lambda p, k=k: p.z[k] @ inverse(p.z[0])"),
    ("export", "export/ros.py", "export/test_export.py",
     "mount.parent_from_child @ inverse(root_from_optical)", "mount.parent_from_child @ root_from_optical"),
    ("report", "report/render.py", "report/test_report.py",
     "autoescape=True", "autoescape=False"),
    ("live server", "live/server.py", "live/test_server.py",
     'elif "Origin" in self.headers and not self._is_own_origin():',
     'elif "Origin" not in self.headers and not self._is_own_origin():'),
    ("run folder", "files.py", "test_run_folder.py",
     "fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)", "fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)"),
    ("stages", "pipeline/stages.py", "test_run_folder.py",
     'if name in (CALIBRATION, ADDED) else ""', 'if name in (ADDED,) else ""'),
    ("files", "files.py", "test_files.py",
     "        temporary.unlink(missing_ok=True)", "        pass"),
)  # fmt: skip
"""Stage, file below src/jcr, tests below tests/ that must fail, text of the file, and the text that replaces it."""


def first_failure(copy: Path, tests: str) -> str:
    """Return the first of the tests that fails in a copy of the project, or an empty text."""
    path = f"{copy / 'src'}{os.pathsep}{copy}"
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    files = [f"tests/{test}" for test in tests.split()]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    # 1: tests failed. Others: nothing was collected, or pytest itself failed.
    if done.returncode not in (0, 1):
        return f"pytest ended with status {done.returncode}: {done.stdout[-500:]}"
    failures = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failures[0].split(" - ")[0].split(" ", 1)[1] if done.returncode else ""


def main(names: list[str]) -> int:
    """Plant the errors in a copy whose tests pass, print a row for each, and return 1 where one is not caught."""
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        ignore = shutil.ignore_patterns("__pycache__", "_site")
        for name in COPIED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, copy / name, ignore=ignore)
            else:
                shutil.copy(ROOT / name, copy / name)
        for stage, name, tests, before, after in FAULTS:
            if names and stage not in names:
                continue
            file = copy / "src/jcr" / name
            text, failed = file.read_text(), ""
            if text.count(before) == 1:
                file.write_text(text.replace(before, after))
                failed = first_failure(copy, tests)
                file.write_text(text)
            else:
                sys.stdout.write(f"{name} does not contain the line once: {before}\n")
            missed += "::" not in failed
            sys.stdout.write(f"{stage}: {failed if '::' in failed else f'NOT CAUGHT {failed}'}\n")
            sys.stdout.flush()
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
