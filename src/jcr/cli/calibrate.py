"""`jcr calibrate`: where the camera sits on the gripper, up to calibration.json."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.calibrate.calibrate import CalibrateOptions
from jcr.cli.result import show
from jcr.reconstruct.backends import ReconstructOptions


@dataclass(frozen=True)
class Arguments:
    """Reconstruct and calibrate a capture, without the map.

    examples:
      jcr calibrate examples/tabletop out/tabletop
      jcr calibrate captures/table out/table --backend colmap --seed 1 --json
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the results."""
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    json: bool = False
    """Print calibration.json on stdout."""
    quiet: bool = False
    """No progress on stderr."""


def main(arguments: Arguments) -> int:
    """Calibrate and print what was found."""
    from jcr.capture.read import read_capture
    from jcr.pipeline import RunOptions, calibrate
    from jcr.progress import progress_bars

    capture = read_capture(arguments.capture)
    options = RunOptions(arguments.reconstruct, arguments.calibrate)
    with progress_bars(arguments.quiet) as progress:
        result = calibrate(capture, arguments.out, options, progress=progress)
    return show(result, arguments.json)
