"""How a calibration is told on the terminal, the same for every command that ends with one."""

import sys
from typing import TYPE_CHECKING

from jcr.cli.output import Output
from jcr.errors import NotTrustedError

if TYPE_CHECKING:
    from jcr.results import PosesResult, RunResult


def show(result: "RunResult | PosesResult", output: Output, after: str = "") -> int:
    """Print the calibration, its doubts on stderr, and for people what comes after it.

    Returns exit status 0, or raises NotTrustedError.
    """
    from jcr.calibration.words import summary
    from jcr.cell.cameras_json import in_words

    content, cameras = result.calibration, getattr(result, "cameras", None)
    facts, text = content.model_dump(), summary(content)
    if cameras is not None:
        facts |= {"cameras": cameras.model_dump()["cameras"], "arms": cameras.model_dump()["arms"]}
        text += "\n".join(in_words(cameras)) + "\n"
    output.result(text + after, facts)
    for remark in content.remarks:
        sys.stderr.write(f"warning: {remark}\n")
    if content.doubt is not None:
        raise NotTrustedError(f"not to be trusted: {content.doubt}")
    for camera in () if cameras is None else cameras.cameras:
        if camera.doubt is not None:
            raise NotTrustedError(f"camera {camera.name} is not to be trusted: {camera.doubt}")
    return 0
