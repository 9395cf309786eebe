"""Writing of whole files, by a temporary name beside the target, fsync and rename; locking of folders."""

import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jcr.errors import InputError

LOCK = ".lock"
"""File of a folder that the process which writes there has locked."""
COPIES = "capture", "added"
"""Subfolders of a run folder into which images are copied."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it replaces `path`, on failure it is deleted."""
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
    """Delete the files of a folder that killed processes had begun to write."""
    for begun in folder.glob(".*.????????.part*"):
        begun.unlink()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Make and lock the folder, so that a second process writes nothing between the files of the first.

    Files that a killed process had begun to write are removed, and so is a new folder into which nothing came.
    """
    new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / LOCK).open("w", encoding="utf-8")
    except (FileExistsError, NotADirectoryError):
        file = next(part for part in (path, *path.parents) if part.is_file())
        raise InputError(f"{file}: is a file; name a folder for the results") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path}: another jcr is writing there; wait for it or choose another") from None
        for folder in (path, *(sub for name in COPIES for sub in (path / name).rglob("."))):
            remove_unfinished(folder)
        try:
            yield
        finally:
            if new and os.listdir(path) == [LOCK]:
                shutil.rmtree(path)


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
