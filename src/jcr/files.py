"""Atomic writing of files (temporary file, fsync, rename) and locking of folders."""

import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jcr.errors import InputError, shown

LOCK = ".lock"
"""Name of the file in a folder that is locked by the process that writes there."""
COPIES = "capture", "added", "cameras"
"""Subfolders of a run folder into which images are copied."""
IMAGES = "images"
"""Subfolder of a capture in which its images are expected; the user may link it to a folder elsewhere."""
LONGEST = 255
"""Largest length of a file name in bytes that file systems accept."""
LONGEST_PATH = 1000
"""Largest number of characters of a path that a file names; file systems accept 4096 bytes with the folder before."""


def as_path(path: object, what: str) -> Path:
    """Return a path that a Python program gives; raise InputError for an object that is no path, which `what` names."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{what}: {shown(path)} is no path; give text or a pathlib.Path")
    return Path(path)


@contextmanager
def writable(path: Path) -> Iterator[None]:
    """Make the folder of `path`; raise InputError if it or a file in it cannot be made, as below a file or in /proc."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (FileNotFoundError, FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder") from None


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; on success this file replaces `path`, on an exception it is deleted.

    Raises InputError as `writable` does.
    """
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.part{path.suffix}"
    with writable(path):
        # With mode 0o666 the umask decides on the permissions, as for any other file of the user.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield temporary
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: Path) -> bytes:
    """Return the content of a file; raise InputError for a pipe or device, OSError if the file cannot be read."""
    require_file(path)
    return path.read_bytes()


def require_file(path: Path) -> None:
    """Raise InputError if `path` is a pipe or a device, from which reading might never end.

    Open descriptors of the command (standard input, a shell's `<(…)`) are allowed.
    """
    given = path.parent in (Path("/dev/fd"), Path("/proc/self/fd")) or path == Path("/dev/stdin")
    if not given and path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: a pipe or a device; name a file")


def path_inside(folder: Path, name: str, where: str, *asked: Path) -> Path:
    """Return `folder/name` for a name that a file states; raise InputError if it could lead out of the folder.

    The name must be relative, without a step upwards (..). Symbolic links must stay inside of the folder, or lead into
    one of the folders `asked`, which the user named or linked. The file need not exist, but must not be a folder, pipe
    or device. Messages begin with `where`.
    """
    parts = Path(name).parts
    try:
        longest = max(len(part.encode()) for part in parts)
    except ValueError:  # an empty name, or half of a surrogate pair
        longest = LONGEST + 1
    is_odd = "\0" in name or "\n" in name or Path(name).is_absolute()
    if is_odd or longest > LONGEST or len(name) > LONGEST_PATH:
        raise InputError(f"{where}: {shown(name)} is no path inside the capture; name a file under {folder}")
    if ".." in parts:  # no file need be there yet, whose place could be resolved
        raise InputError(f"{where}: {shown(name)} leads out of {folder} (..); copy the file into it")
    target = folder / name
    try:
        place = target.resolve()
    except (OSError, RuntimeError):
        raise InputError(f"{where}: {shown(name)} is a link back to itself; put a file there") from None
    if not any(place.is_relative_to(root.resolve()) for root in (folder, *asked)):
        raise InputError(
            f"{where}: {shown(name)} is a link that leads out of {folder}; copy the file into it, or make its folder "
            f"{IMAGES} the link"
        )
    try:
        is_wrong = target.exists() and not target.is_file()  # opening a pipe would block for ever
    except OSError as error:  # a path that is too long as a whole
        raise InputError(f"{where}: {shown(name)} cannot be a file ({error.strerror}); rename it") from None
    if is_wrong:
        raise InputError(f"{where}: {shown(name)} is a folder, a pipe or a device; name a file")
    return target


def capture_file(folder: Path, name: str, where: str) -> Path:
    """Return the path of a file that a capture in `folder` names; raise InputError as `path_inside` does.

    The user may link the subfolder of the images to a folder elsewhere: who names the capture names its images.
    """
    return path_inside(folder, name, where, folder / IMAGES)


def remove_unfinished(folder: Path) -> None:
    """Delete the temporary files in a folder that killed processes have left; a folder that is a link is left alone."""
    for begun in () if folder.is_symlink() else folder.glob(".*.????????.part*"):
        if begun.is_file():
            begun.unlink()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Create a folder and lock it for this process within a `with` block.

    Raises InputError if another process has locked the folder, or if a subfolder for copies is a link, by which files
    would be written elsewhere. Temporary files of killed processes are removed. A new folder is removed again if it
    stays empty.
    """
    new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        # A lock that is a link (of a folder from elsewhere) would lead to another file, a pipe would block.
        flags = os.O_CREAT | os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK
        lock = os.fdopen(os.open(path / LOCK, flags, 0o666), "w")
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
        for linked in (path / name for name in COPIES if (path / name).is_symlink()):
            raise InputError(f"{linked}: is a link; results are written in the run folder only: remove it")
        for folder in (path, *(sub for name in COPIES for sub in (path / name).rglob("."))):
            remove_unfinished(folder)
        try:
            yield
        finally:
            if new and os.listdir(path) == [LOCK]:
                shutil.rmtree(path)


def write_new(path: Path, data: bytes) -> None:
    """Write `data` to `path`, unless the file has this content already; its time stamp then stays."""
    if not path.is_file() or path.read_bytes() != data:
        write_bytes(path, data)


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`; a failed write leaves an existing file unchanged."""
    with written_whole(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8; a failed write leaves an existing file unchanged."""
    write_bytes(path, text.encode())
