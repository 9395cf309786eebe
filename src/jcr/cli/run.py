"""`jcr run`: everything, from a capture to a calibrated camera and a map."""

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import VerboseOutput
from jcr.cli.result import calibrated, show, show_calibration
from jcr.cli.source import run_options, source, with_images
from jcr.depth.options import DepthOptions
from jcr.reconstruct import ReconstructOptions
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.run_folder import RunResult


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
    output: VerboseOutput = field(default_factory=VerboseOutput)
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
    """Run every stage and print the result."""
    from jcr.pipeline.run import run
    from jcr.progress import progress_bars

    map_options = None if arguments.no_map else arguments.map
    options, out = run_options(arguments, map=map_options), arguments.out
    with progress_bars() as progress:
        found = source(arguments.capture, arguments.read, out, progress)
        capture = with_images(found, arguments.capture, "nothing to map; use `jcr calibrate`")
        shown = list[object]()

        def show_early(result: "RunResult") -> None:
            """Print the calibration before depth and map are made."""
            show_calibration(result, arguments.output)
            shown.append(result)

        result = calibrated(lambda: run(capture, out, options, progress=progress, calibrated=show_early), out)
    if result.is_unchanged:
        sys.stderr.write(f"unchanged: {out} is the run of this capture with these options\n")
    if not shown:
        show_calibration(result, arguments.output)
    return show(result, arguments.output, *_map_lines(result, out, map_options is not None))


def _map_lines(result: "RunResult", out: Path, is_wanted: bool) -> list[str]:
    """Return the line on the map: how to look at it, or why there is none where one was wanted."""
    from jcr.calibration.words import labelled

    if (out / "map.safetensors").is_file():
        return labelled("Map", f"jcr view {shlex.quote(str(out))}")
    missing = [note for note in result.calibration.notes if note.startswith("no map was made")]
    return labelled("Map", *missing) if is_wanted else []
