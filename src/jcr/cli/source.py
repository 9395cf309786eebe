"""Reading of the capture of a command, into the folder of a run or for a look."""

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jcr.capture.options import ReadOptions

if TYPE_CHECKING:
    from jcr.progress import Progress
    from jcr.records import Capture, PosePairs
    from jcr.run_folder import RunOptions


def _announce(path: Path) -> None:
    """Report that the command has started, before the packages that read images are imported."""
    if sys.stderr.isatty() and path.exists():
        sys.stderr.write(f"reading {path}\n")
        sys.stderr.flush()


def source(path: Path, options: ReadOptions, out: Path, progress: "Progress") -> "Capture | PosePairs":
    """Read the capture at a path; the frames of a recording are put in the run folder `out`."""
    _announce(path)
    from jcr.capture.read import read_source
    from jcr.run_folder import CAPTURE, locked

    with locked(out):
        found = read_source(path, options, into=out / CAPTURE, progress=progress)
    return found


def run_options(arguments: Any, **chosen: Any) -> "RunOptions":
    """Return the options of the stages among a command's arguments, `chosen` ones in their place."""
    from jcr.run_folder import RunOptions

    given = {
        one.name: getattr(arguments, one.name) for one in fields(RunOptions) if hasattr(arguments, one.name)
    }
    return RunOptions(**given | chosen)


def with_images(found: "Capture | PosePairs", path: Path, needed: str) -> "Capture":
    """Return the capture; raise InputError, which ends with `needed`, where there are poses alone."""
    from jcr.errors import InputError
    from jcr.records import PosePairs

    if isinstance(found, PosePairs):
        raise InputError(f"{path}: gives poses and no images, {needed}")
    return found


@contextmanager
def looked_at(
    path: Path,
    options: ReadOptions,
    progress: "Progress",
    read: Callable[..., Any] | None = None,
    **more: Any,
) -> "Iterator[Capture | PosePairs]":
    """Read what lies at a path with `read`, by default read_source; the frames of a recording vanish afterwards."""
    _announce(path)
    from jcr.capture.read import read_source

    with tempfile.TemporaryDirectory(prefix="jcr-capture-") as scratch:
        yield (read or read_source)(path, options, into=scratch, progress=progress, **more)
