"""Predictions of single pairs on disk, named by a hash of all they depend on, checked on reading."""

import os
import tempfile
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy import ndarray

DIGEST_BYTES = 16


def user_cache() -> Path:
    """jcr/pairs in the user's cache folder (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jcr" / "pairs"


@dataclass(frozen=True)
class PairCache:
    """Files of float32 arrays followed by their digest; a file that does not match its digest is no file."""

    folder: Path
    limit_bytes: int

    def read(self, key: str, shapes: tuple[tuple[int, ...], ...]) -> list[ndarray] | None:
        """The arrays of a key, or None where they are missing; ValueError where the file is damaged."""
        path = self.folder / key
        try:
            content = path.read_bytes()
            os.utime(path)
        except OSError:
            return None
        sizes = [int(np.prod(shape)) for shape in shapes]
        values, digest = content[:-DIGEST_BYTES], content[-DIGEST_BYTES:]
        if len(values) != 4 * sum(sizes) or blake2b(values, digest_size=DIGEST_BYTES).digest() != digest:
            raise ValueError(f"{path}: not what was written")
        parts = np.split(np.frombuffer(values, np.float32), np.cumsum(sizes)[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    def write(self, key: str, arrays: list[ndarray]) -> None:
        """Store float32 arrays; a full disk is no reason to fail, the cache then simply lacks them."""
        # No fsync: a torn file fails its digest, and 90 pairs would wait seconds for the disk.
        values = b"".join(np.ascontiguousarray(array, np.float32).tobytes() for array in arrays)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=self.folder, suffix=".part")
            with open(handle, "wb") as stream:
                stream.write(values)
                stream.write(blake2b(values, digest_size=DIGEST_BYTES).digest())
            os.replace(name, self.folder / key)
        except OSError:
            return

    def prune(self) -> None:
        """Delete what was used longest ago until the limit holds."""
        try:
            files = sorted(
                ((path.stat(), path) for path in self.folder.iterdir()), key=lambda f: f[0].st_mtime
            )
            total = sum(stat.st_size for stat, _ in files)
            for stat, path in files:
                if total <= self.limit_bytes:
                    return
                path.unlink(missing_ok=True)
                total -= stat.st_size
        except OSError:
            return
