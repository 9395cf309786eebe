"""`jcr add-camera`: locates a fixed camera of the cell."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Locate a fixed camera (base_from_camera) from its images of the scene of a run.

    OUT is the run folder; the capture of the run must still be at its old path. No marker is needed: the images are
    matched with those of the wrist camera. One image is enough. Without intrinsics the focal length is estimated too,
    and the output names it if the image does not determine it. The camera becomes part of the run (OUT/cameras.json, the
    report, `jcr export`). If it cannot be located, nothing is written and the exit status is 3.

    examples:
      jcr add-camera out/table overhead.png --intrinsics overhead.json
      jcr add-camera out/table left/0.png left/1.png --name left
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    images: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES...")]
    """Images of one fixed camera, all of the same size."""
    name: str | None = None
    """Name of the camera; by default the file name of the first image."""
    intrinsics: Path | None = None
    """JSON with fx, fy, cx, cy and distortion as in capture.json, in pixels of these images; unset: estimated."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Locate the camera and print its pose."""
    import re

    from jcr.cell.placement import in_words
    from jcr.errors import InputError
    from jcr.pipeline.run import add_camera
    from jcr.progress import progress_bars

    if not arguments.images:
        raise InputError("no image; name one or more of the camera to place")
    name = arguments.name or re.sub(r"^[^A-Za-z]+|[^A-Za-z0-9_]+", "_", arguments.images[0].stem).strip("_")
    name = name or "camera"
    with progress_bars() as progress:
        result = add_camera(arguments.out, name, arguments.images, arguments.intrinsics, progress=progress)
    assert result.cameras is not None
    mine = result.cameras.model_copy(update={"cameras": result.cameras.cameras[-1:], "arms": []})
    arguments.output.result("\n".join(in_words(mine)) + "\n", mine.as_json()["cameras"][0])
    return 0
