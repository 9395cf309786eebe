"""`jcr calibrate`: the pose of the camera on the gripper: calibration.json and a report."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import VerboseOutput
from jcr.cli.result import calibrated, show, show_calibration
from jcr.cli.source import run_options, source
from jcr.depth.options import DepthOptions
from jcr.reconstruct import ReconstructOptions


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Calibrate a capture, without dense depth and map: calibration.json, report.html and log.txt.

    CAPTURE may also be a samples file of easy_handeye2 or MoveIt Calibration, whose marker poses need no images.

    examples:
      jcr calibrate examples/tabletop out/tabletop
      jcr calibrate captures/table out/table --backend colmap --seed 1 --json
      jcr calibrate samples.yaml out/marker
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture, or another format (jcr docs captures)."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the results."""
    output: VerboseOutput = field(default_factory=VerboseOutput)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)


def main(arguments: Arguments) -> int:
    """Calibrate and print the result."""
    from jcr.calibration.poses import is_one
    from jcr.calibration.words import labelled
    from jcr.pipeline.run import calibrate, calibrate_poses
    from jcr.progress import progress_bars
    from jcr.records import PosePairs

    options, out = run_options(arguments), arguments.out
    with progress_bars() as progress:
        capture = source(arguments.capture, arguments.read, out, progress)
        if isinstance(capture, PosePairs):
            found = calibrate_poses(capture, out, arguments.calibrate)
            show_calibration(found, arguments.output)
            more = (
                labelled("Scale", "1, as the marker's size says")
                if found.converged and is_one(found.hand_eye)
                else ()
            )
            return show(found, arguments.output, *more)
        result = calibrated(lambda: calibrate(capture, out, options, progress=progress), out)
    show_calibration(result, arguments.output)
    return show(result, arguments.output)
