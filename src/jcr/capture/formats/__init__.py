"""Formats of captures, a file each: how a format is recognised by its files, and its reader."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Format:
    """Row of the table of formats."""

    name: str
    about: str
    recognises: Callable[[Path], bool]
    """Test of a file or folder."""
    read: Callable[..., Any]
    """Reader of (path, options), returning a Capture or PosePairs."""
    recording: bool = False
    """True where the images are inside a file: the reader then takes (path, options, folder, progress)."""
