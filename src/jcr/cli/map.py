"""`jcr map`: the map of a calibrated run, made again."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.capture.options import ReadOptions
from jcr.cli.output import Output
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """(Re)build cloud, map and report of a run with other options, or with further images.

    examples:
      jcr map out/tabletop --preset paper
      jcr map out/tabletop --segments labels
      jcr map out/tabletop --workspace 0.2 -0.4 -0.05 0.9 0.4 0.6
      jcr map out/tabletop --add captures/later
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    add: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="CAPTURE")] = ()
    """A capture of new images, in any format; repeat for more, oldest first. The calibration is not changed. What a new
    image sees through is removed from the map; a new object needs two new images. They are kept for every later map of
    the run (OUT/added)."""
    read: ReadOptions = field(default_factory=ReadOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Build the map and print its path."""
    from jcr.pipeline.run import build_map
    from jcr.progress import progress_bars

    with progress_bars() as progress:
        result = build_map(
            arguments.out,
            arguments.cloud,
            arguments.map,
            arguments.segment,
            add=arguments.add,
            read=arguments.read,
            progress=progress,
        )
    map, report = result.out / "map.safetensors", result.out / "report.html"
    arguments.output.result(f"map: {map}\nreport: {report}\n", {"map": str(map), "report": str(report)})
    return 0
