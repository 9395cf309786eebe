"""`jcr batch`: many captures, on this machine or a Ray cluster."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import Output
from jcr.cli.source import run_options
from jcr.depth.options import DepthOptions
from jcr.pipeline.batch_options import BatchOptions
from jcr.reconstruct import ReconstructOptions
from jcr.scene.options import CloudOptions, MapOptions

if TYPE_CHECKING:
    from jcr.pipeline.batch import Row


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Run many captures, each into its own folder in OUT, and rank them in OUT/summary.csv and .html.

    A capture that fails does not stop the others. The same command again runs only what is missing or has changed. The
    exit status is 3 if any capture failed or was rejected.

    examples:
      jcr batch captures/* out/all
      jcr batch captures/* out/all --processes 4 --calibrate-only
      jcr batch /shared/captures/* /shared/out --ray auto --gpus-per-task 0.25
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURES... OUT")]
    """Folders of the captures, then the folder for the results."""
    output: Output = field(default_factory=Output)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    batch: BatchOptions = field(default_factory=BatchOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)


def main(arguments: Arguments) -> int:
    """Run all and print the table."""
    from jcr.errors import InputError, RejectedError
    from jcr.pipeline.batch import batch, is_accepted
    from jcr.progress import progress_bars

    if len(arguments.paths) < 2:
        raise InputError("batch: name one capture or more, then the folder for the results")
    *captures, out = arguments.paths
    with progress_bars() as progress:
        rows = batch(captures, out, run_options(arguments), arguments.batch, progress, arguments.read)
    arguments.output.result(
        _table(rows) + f"table: {out / 'summary.html'}\n", {"captures": [asdict(row) for row in rows]}
    )
    doubtful = sum(not is_accepted(row) for row in rows)
    if doubtful:
        raise RejectedError(
            f"{doubtful} of {len(rows)} captures failed or are rejected; see {out / 'summary.html'}"
        )
    return 0


def _table(rows: "list[Row]") -> str:
    lines = ""
    for rank, row in enumerate(rows, start=1):
        std = "" if row.offset_std_mm is None else f"± {row.offset_std_mm:.2f} mm, {row.turn_std_deg:.3f}°"
        used = f"{row.used:3d}/{row.images:<3d}"
        line = f"{rank:3d}  {Path(row.out).name:<24} {row.status:<22} {used} {std}  {row.reason}"
        lines += line.rstrip() + "\n"
    return lines
