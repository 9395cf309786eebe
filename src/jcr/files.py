"""Files are written whole or not at all: a temporary name beside the target, fsync, rename; and only files are read."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jcr.errors import InputError


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it replaces `path`, on failure it goes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.part{path.suffix}"
    # The system applies the umask, so a result is as readable as any file that the user makes.
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield temporary
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: Path) -> bytes:
    """Read a file; raise as `require_file`, and OSError where nothing can be read."""
    require_file(path)
    return path.read_bytes()


def require_file(path: Path) -> None:
    """Raise InputError where a pipe or a device is in place of a file: to read it could take for ever.

    What the command itself was given on an open descriptor, as a shell's `<(…)`, is read.
    """
    given = path.parent in (Path("/dev/fd"), Path("/proc/self/fd")) or path == Path("/dev/stdin")
    if not given and path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: a pipe or a device; name a file")


def remove_unfinished(folder: Path) -> None:
    """Delete what writers that were killed had begun in a folder."""
    for begun in folder.glob(".*.????????.part*"):
        begun.unlink()


def write_new(path: Path, data: bytes) -> None:
    """Write `data` to `path` unless the file has it already; then its time stamp stays, too."""
    if not path.is_file() or path.read_bytes() != data:
        write_bytes(path, data)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 `text` to `path` whole or not at all."""
    write_bytes(path, text.encode())
