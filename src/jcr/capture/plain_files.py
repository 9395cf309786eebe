"""Paths that files name."""

from pathlib import Path

from jcr.errors import InputError, shown

LONGEST = 255
"""Largest length of a file name in bytes that file systems accept."""


def contained(folder: Path, name: str, where: str) -> Path:
    """Return `folder/name`; raise InputError if the name is absolute, invalid, or leads out of the folder.

    The file need not exist, but must not be a folder, pipe or device. Messages begin with `where`.
    """
    try:
        longest = max(len(part.encode()) for part in Path(name).parts)
    except ValueError:  # an empty name, or half of a surrogate pair
        longest = LONGEST + 1
    if "\0" in name or longest > LONGEST or Path(name).is_absolute():
        raise InputError(f"{where}: {shown(name)} is no path inside the capture; use one under {folder}")
    target = folder / name
    try:
        inside = target.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):
        raise InputError(f"{where}: {name!r} is a link that leads back to itself; put a file there") from None
    if not inside:
        raise InputError(f"{where}: {name!r} leads out of {folder}; copy the image into the capture")
    if target.exists() and not target.is_file():  # opening a pipe would block for ever
        raise InputError(f"{where}: {name!r} is a folder, a pipe or a device; name the image's file")
    return target
