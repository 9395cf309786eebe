"""`jcr run`: everything, from a capture to a calibrated camera and a map."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import Output
from jcr.cli.result import show, show_calibration
from jcr.cli.source import run_options, source, with_images
from jcr.depth.options import DepthOptions
from jcr.reconstruct import ReconstructOptions
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Reconstruct, calibrate, map and report a capture.

    CAPTURE is a folder with capture.json and images, or any format that `jcr docs captures` lists: images and a table
    of poses, bags, LeRobot data sets, COLMAP models … The run writes calibration.json, reconstruction.npz, depth.npz,
    cloud.ply, map.safetensors, report.html and log.txt to OUT. The same command resumes an interrupted run.

    examples:
      jcr run examples/tabletop out/tabletop
      jcr run captures/table out/table --robot-noise 0.1 0.05 --json
      jcr run captures/ur5 out/ur5 --pose-convention ur
      jcr run captures/table out/table --no-map
      jcr run scan.mcap out/scan --base-frame base_link --gripper-frame tool0 --frames 12
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture, or another format (jcr docs captures)."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the results."""
    output: Output = field(default_factory=Output)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    no_map: bool = False
    """Calibration and report only: no dense depth, cloud or map; so without torch, too."""


def main(arguments: Arguments) -> int:
    """Run every stage and print what was found."""
    from jcr.pipeline.mapping import require_dense
    from jcr.pipeline.run import finished, run
    from jcr.progress import progress_bars

    map_options = None if arguments.no_map else arguments.map
    if map_options is not None:
        require_dense(arguments.depth)  # before a recording is read
    options = run_options(arguments, map=map_options)
    with progress_bars() as progress:
        found = source(arguments.capture, arguments.read, arguments.out, progress)
        capture = with_images(found, arguments.capture, "nothing to map; use `jcr calibrate`")
        if (before := finished(capture, arguments.out, options)) is not None:
            sys.stderr.write(f"unchanged: {arguments.out} is the run of this capture with these options\n")
            show_calibration(before, arguments.output)
            return show(before, arguments.output, f"report: {before.out / 'report.html'}\n")
        result = run(
            capture,
            arguments.out,
            options,
            progress=progress,
            calibrated=lambda found: show_calibration(found, arguments.output),
        )
    return show(result, arguments.output, f"report: {result.out / 'report.html'}\n")
