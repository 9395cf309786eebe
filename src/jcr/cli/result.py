"""How a calibration is printed on the terminal, the same for every command that ends with one."""

import shlex
import sys
from typing import TYPE_CHECKING

from jcr.cli.output import Output, warn
from jcr.errors import RejectedError

if TYPE_CHECKING:
    from jcr.results import PosesResult, RunResult, SavedRun


def show_calibration(result: "RunResult | SavedRun | PosesResult", output: Output) -> None:
    """Print the calibration for people as soon as it stands; with --json all comes at the end."""
    from jcr.calibration.words import summary

    if not output.json:
        sys.stdout.write(summary(result.calibration))
        sys.stdout.flush()


def show(result: "RunResult | SavedRun | PosesResult", output: Output, after: str = "") -> int:
    """Print what follows the calibration: further cameras, the verdict and `after` it; doubts and notes on stderr.

    Returns exit status 0, or raises RejectedError where it is rejected.
    """
    from jcr.calibration.words import verdict_in_words
    from jcr.cell.placement import in_words
    from jcr.findings import sentence
    from jcr.results import PosesResult

    content, cameras = result.calibration, getattr(result, "cameras", None)
    facts, text = content.model_dump(), ""
    if cameras is not None:
        facts |= {name: cameras.as_json()[name] for name in ("cameras", "arms")}
        text += "\n".join(in_words(cameras)) + "\n"
    text += f"{verdict_in_words(content)}\n"
    output.result(text + after + _next_commands(result), facts)
    for remark in content.remarks:
        warn(remark)
    # Notes on poses that were given are the reader's, which has printed them.
    for note in () if isinstance(result, PosesResult) else content.notes:
        sys.stderr.write(f"note: {note}\n")
    if content.doubt is not None:
        raise RejectedError(f"rejected: {content.doubt}")
    for camera in () if cameras is None else cameras.cameras:
        if camera.doubt is not None:
            raise RejectedError(f"camera {camera.name} is rejected: {camera.doubt}")
    if content.short is not None:
        warn(sentence(content.short))
    return 0


def _next_commands(result: "RunResult | SavedRun | PosesResult") -> str:
    """Three commands that make sense now, a line each."""
    from jcr.results import PosesResult
    from jcr.run_folder import RunFolder

    out, has_images = shlex.quote(str(result.out)), not isinstance(result, PosesResult)
    if not result.converged:
        source = RunFolder(result.out).state().capture if has_images else "CAPTURE"
        commands = (f"jcr check {shlex.quote(source)}", "jcr docs troubleshooting", "jcr docs captures")
    else:
        shown = f"jcr view {out}" if RunFolder(result.out).has_map() else f"jcr export {out} urdf"
        test = f"jcr verify {out} NEW_IMAGES" if has_images else f"jcr compare {out} OTHER"
        commands = (shown, f"jcr export {out} ros2", test)
    return "next: " + "\n      ".join(commands) + "\n"
