"""How commands come by their capture: read for a run's folder, or only to be looked at."""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.capture.options import MIN_FRAMES, ReadOptions

if TYPE_CHECKING:
    from jcr.progress import Progress
    from jcr.records import Capture, PosePairs


def _announce(path: Path) -> None:
    """A first sign of life, before the packages that read images are imported."""
    if sys.stderr.isatty() and path.exists():
        sys.stderr.write(f"reading {path}\n")
        sys.stderr.flush()


def source(path: Path, options: ReadOptions, out: Path, progress: "Progress") -> "Capture | PosePairs":
    """What lies at a path, a recording's frames put in the run folder `out`; remarks of the reader on stderr."""
    _announce(path)
    from jcr.capture.read import read_source
    from jcr.run_folder import CAPTURE, locked

    with locked(out):
        found = read_source(path, options, into=out / CAPTURE, progress=progress)
    for note in found.notes:
        sys.stderr.write(f"note: {note}\n")
    return found


@contextmanager
def looked_at(
    path: Path, options: ReadOptions, progress: "Progress", at_least: int = MIN_FRAMES
) -> "Iterator[Capture | PosePairs]":
    """What lies at a path, a recording's frames put where they vanish afterwards."""
    _announce(path)
    from jcr.capture.read import read_source

    with tempfile.TemporaryDirectory(prefix="jcr-capture-") as scratch:
        yield read_source(path, options, into=scratch, progress=progress, at_least=at_least)
