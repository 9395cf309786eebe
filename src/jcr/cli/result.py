"""Output of the commands that end with a calibration: verdict, transform, warnings, next command."""

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.cli.output import VerboseOutput

if TYPE_CHECKING:
    from jcr.cell.placement import CameraPlacement
    from jcr.run_folder import RunResult


def calibrated(action: "Callable[[], RunResult]", out: Path) -> "RunResult":
    """Return the result of a run; where no back end found anything, what it left in `out`, which has the reason."""
    from jcr.pipeline.selection import NothingFoundError
    from jcr.run_folder import load_run

    try:
        return action()
    except NothingFoundError:
        return load_run(out)


def show_calibration(result: "RunResult", output: VerboseOutput) -> None:
    """Print the summary as soon as the calibration stands; with --json all comes at the end."""
    from jcr.calibration.words import MOST_LINES, summary

    if not output.json:
        cameras = result.cameras
        others = 1 if cameras is None else 1 + len(cameras.cameras)  # a line of the caller, and the cameras
        sys.stdout.write(summary(result.calibration, MOST_LINES - others))
        sys.stdout.flush()


def show(result: "RunResult", output: VerboseOutput, *more: str) -> int:
    """Print the lines after the summary, and return the exit status: 3 where it or a further camera is rejected.

    These are further cameras, `more` lines, the report and the next command; with --verbose the details; with --json
    everything at once.
    """
    from jcr.calibration.words import details, labelled

    content, cameras = result.calibration, result.cameras
    placed = [] if cameras is None else cameras.cameras
    facts = content.as_json()
    if cameras is not None:
        facts |= {name: cameras.as_json()[name] for name in ("cameras", "arms")}
    lines = [line for camera in placed for line in labelled("Camera", _camera_in_words(camera))]
    lines += [*more, *labelled("Report", str(result.out / "report.html")), *labelled("Next", _next(result))]
    if output.verbose:
        lines += ["", *details(content), *(line for camera in placed for line in camera.in_words)]
    output.result("\n".join(lines) + "\n", facts)
    return 0 if content.converged and all(camera.converged for camera in placed) else 3


def _camera_in_words(camera: "CameraPlacement") -> str:
    """Return the verdict on a further camera, with its uncertainty or the reason, in one line."""
    from jcr.rounding import significant

    if camera.doubt is not None or camera.uncertainty is None:
        return f"{camera.name}: REJECTED: {camera.doubt}"
    mm, deg = (
        max(std) for std in (camera.uncertainty.translation_std_mm, camera.uncertainty.rotation_std_deg)
    )
    return (
        f"{camera.name}: {camera.verdict.upper()}, {camera.mount}_from_camera ±{significant(mm)} mm, "
        f"{significant(deg)}° (1σ, worst axis; cameras.json)"
    )


def _next(result: "RunResult") -> str:
    """Return the command that makes sense now."""
    if not result.converged:
        return "jcr docs troubleshooting"
    return f"jcr export {shlex.quote(str(result.out))} ros2"
