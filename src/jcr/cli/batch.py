"""`jcr batch`: many captures, on this machine or a Ray cluster."""

import json
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.batch import BatchOptions
from jcr.calibrate.calibrate import CalibrateOptions
from jcr.reconstruct.backends import ReconstructOptions
from jcr.represent.cloud import CloudOptions
from jcr.represent.options import MapOptions


@dataclass(frozen=True)
class Arguments:
    """Run many captures, each into a folder of its own in OUT, and rank them in OUT/summary.csv and .html.

    A capture that fails fails alone. The same command again runs what is missing or has changed. Exit status 3
    when one or more failed or are not to be trusted.

    examples:
      jcr batch captures/* out/all
      jcr batch captures/* out/all --processes 4 --calibrate-only
      jcr batch /shared/captures/* /shared/out --ray auto --gpus-per-task 0.25
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURES... OUT")]
    """Folders of the captures, then the folder for the results."""
    batch: BatchOptions = field(default_factory=BatchOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    json: bool = False
    """Print the table as JSON on stdout."""
    quiet: bool = False
    """No progress on stderr."""


def main(arguments: Arguments) -> int:
    """Run all and print the table."""
    from jcr.batch import batch
    from jcr.errors import InputError
    from jcr.pipeline import RunOptions
    from jcr.progress import progress_bars

    if len(arguments.paths) < 2:
        raise InputError("batch: name one capture or more, then the folder for the results")
    options = RunOptions(arguments.reconstruct, arguments.calibrate, arguments.cloud, arguments.map)
    *captures, out = arguments.paths
    with progress_bars(arguments.quiet) as progress:
        rows = batch(captures, out, options, arguments.batch, progress)
    if arguments.json:
        sys.stdout.write(json.dumps([asdict(row) for row in rows]) + "\n")
    else:
        for rank, row in enumerate(rows, start=1):
            std = (
                "" if row.offset_std_mm is None else f"± {row.offset_std_mm:.2f} mm, {row.turn_std_deg:.3f}°"
            )
            name = Path(row.out).name
            line = (
                f"{rank:3d}  {name:<24} {row.status:<12} {row.used:3d}/{row.images:<3d} {std}  {row.reason}"
            )
            sys.stdout.write(line.rstrip() + "\n")
        sys.stdout.write(f"table: {out / 'summary.html'}\n")
    doubtful = sum(row.status != "done" for row in rows)
    if doubtful:
        sys.stderr.write(
            f"error: {doubtful} of {len(rows)} captures failed or are not to be trusted; see the table\n"
        )
        return 3
    return 0
