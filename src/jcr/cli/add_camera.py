"""`jcr add-camera`: where a fixed camera of the cell is."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output


@dataclass(frozen=True)
class Arguments:
    """Place a fixed camera by images of the scene that a run calibrated and mapped with the wrist's: base_from_camera.

    OUT is the run folder, whose capture must still be where it was. No marker is needed: what the images share with
    those of the wrist camera tells. One image will do; of a camera whose intrinsics are not given the focal length is
    estimated with the rest, and the answer says when the image does not show it. The camera becomes part of the run
    (OUT/cameras.json, the report, `jcr export`). Exit status 3 where it cannot be placed; nothing is kept then.

    examples:
      jcr add-camera out/table overhead.png --intrinsics overhead.json
      jcr add-camera out/table left/0.png left/1.png --name left
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    pictures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Images of one fixed camera, all of one size."""
    name: str | None = None
    """Of the camera; by default that of the first image's file."""
    intrinsics: Path | None = None
    """JSON with fx, fy, cx, cy and distortion as in capture.json, in pixels of these images; unset: estimated."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Place the camera and say where it is."""
    import re

    from jcr.cell.cameras_json import in_words
    from jcr.errors import InputError
    from jcr.pipeline import add_camera
    from jcr.progress import progress_bars

    if not arguments.pictures:
        raise InputError("no image; name one or more of the camera to place")
    name = arguments.name or re.sub(r"^[^A-Za-z]+|[^A-Za-z0-9_]+", "_", arguments.pictures[0].stem).strip("_")
    name = name or "camera"
    with progress_bars() as progress:
        result = add_camera(arguments.out, name, arguments.pictures, arguments.intrinsics, progress=progress)
    assert result.cameras is not None
    mine = result.cameras.model_copy(update={"cameras": result.cameras.cameras[-1:], "arms": []})
    arguments.output.result("\n".join(in_words(mine)) + "\n", mine.cameras[0].model_dump())
    return 0
