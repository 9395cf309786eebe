"""How a calibration is printed on the terminal, the same for every command that ends with one."""

import sys
from typing import TYPE_CHECKING

from jcr.cli.output import Output
from jcr.errors import NotTrustedError

if TYPE_CHECKING:
    from jcr.results import PosesResult, RunResult


def show(result: "RunResult | PosesResult", output: Output, after: str = "") -> int:
    """Print the calibration, its doubts and notes on stderr, and for people what comes after it.

    Returns exit status 0, or raises NotTrustedError where it is rejected.
    """
    from jcr.calibration.words import summary
    from jcr.cell.cameras_json import in_words
    from jcr.records.words import sentence
    from jcr.results import RunResult

    content, cameras = result.calibration, getattr(result, "cameras", None)
    facts, text = content.model_dump(), summary(content)
    if cameras is not None:
        facts |= {name: cameras.as_json()[name] for name in ("cameras", "arms")}
        text += "\n".join(in_words(cameras)) + "\n"
    output.result(text + after, facts)
    for remark in content.remarks:
        sys.stderr.write(f"warning: {remark}\n")
    # Notes on poses that were given are the reader's, which has printed them.
    for note in content.notes if isinstance(result, RunResult) else ():
        sys.stderr.write(f"note: {note}\n")
    if content.doubt is not None:
        raise NotTrustedError(f"rejected: {content.doubt}")
    for camera in () if cameras is None else cameras.cameras:
        if camera.doubt is not None:
            raise NotTrustedError(f"camera {camera.name} is rejected: {camera.doubt}")
    if content.short is not None:
        sys.stderr.write(f"warning: {sentence(content.short)}\n")
    return 0
