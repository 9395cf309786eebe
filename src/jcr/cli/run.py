"""`jcr run`: everything, from a capture to a calibrated camera and a map."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.calibrate.calibrate import CalibrateOptions
from jcr.cli.result import show
from jcr.reconstruct.backends import ReconstructOptions
from jcr.represent.cloud import CloudOptions
from jcr.represent.options import MapOptions
from jcr.segment.options import SegmentOptions


@dataclass(frozen=True)
class Arguments:
    """Reconstruct, calibrate, map and report a capture.

    CAPTURE is a folder with capture.json and images; OUT gets calibration.json, reconstruction.npz,
    cloud.ply, map.safetensors, report.html and log.txt. The same command resumes an interrupted run.

    examples:
      jcr run examples/tabletop out/tabletop
      jcr run captures/table out/table --robot-noise 0.1 0.05 --json
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the results."""
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    json: bool = False
    """Print calibration.json on stdout."""
    quiet: bool = False
    """No progress on stderr."""


def main(arguments: Arguments) -> int:
    """Run every stage and print what was found."""
    from jcr.capture.read import read_capture
    from jcr.pipeline import RunOptions, run
    from jcr.progress import progress_bars

    capture = read_capture(arguments.capture)
    options = RunOptions(
        arguments.reconstruct, arguments.calibrate, arguments.cloud, arguments.map, arguments.segment
    )
    with progress_bars(arguments.quiet) as progress:
        result = run(capture, arguments.out, options, progress=progress)
    status = show(result, arguments.json)
    if not arguments.json:
        sys.stdout.write(f"report: {result.out / 'report.html'}\n")
    return status
