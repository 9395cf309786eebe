"""`jcr export`: writes a run's calibration and map in the formats of other tools."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, get_args

import tyro

from jcr.cli.output import Output, warn
from jcr.export.options import ExportName, ExportOptions


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Write a run's calibration or map in another tool's format; without FORMAT, list the formats.

    Every file names its frames and units. Map, images and cameras are in the robot's base frame, in metres. A
    calibration that is rejected is exported with --force alone; the exit status is 3 without it.

    examples:
      jcr export out/table ros2 --parent-frame tool0 --child-frame camera_color_optical_frame
      jcr export out/table urdf --to-root camera_link
      jcr export out/table octomap table.bt --voxel-size 0.02
      jcr export out/table nerfstudio splat/ --undistort
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    format: Annotated[
        ExportName | None,
        tyro.conf.Positional,
        tyro.conf.arg(
            help=f"{', '.join(get_args(ExportName))}; without it, all are listed with their contents."
        ),
    ] = None
    path: Annotated[Path | None, tyro.conf.Positional] = None
    """File or (nerfstudio, colmap) new folder to write; by default in OUT/export."""
    export: ExportOptions = field(default_factory=ExportOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Write the file and print its path; 3 where the calibration is rejected, and nothing was written."""
    from jcr.export.formats import FORMATS, write_run
    from jcr.export.ros import static_transform_publisher

    if arguments.format is None:
        lines = "".join(f"{row.name:<14} {row.about}\n" for row in FORMATS)
        arguments.output.result(
            f"{lines}for one: jcr export {arguments.out} FORMAT\n",
            {"formats": {row.name: row.about for row in FORMATS}},
        )
        return 0
    run, row, path, replaced = write_run(arguments.out, arguments.format, arguments.path, arguments.export)
    sys.stderr.write(f"wrote {path}: {row.about}\n")
    if replaced:
        warn(f"{path}: replaced a file with other content; name another PATH to keep both")
    line, facts = "", {"file": str(path), "format": row.name, "about": row.about}
    if row.name == "ros2":
        mount = run.mount
        line = static_transform_publisher(mount.parent, mount.child, mount.parent_from_child)
        facts["line"] = line
    arguments.output.result(line and line + "\n", facts)
    if run.doubt is not None:
        warn(f"the calibration is rejected, as the file says too: {run.doubt}")
    return 0
