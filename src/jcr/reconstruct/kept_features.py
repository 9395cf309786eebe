"""Features, matches and two-view geometries of a capture's images, kept in its folder from one calibration to the next.

They lie in a COLMAP database; an index beside it names the row of each image by the SHA-256 of its file. What is found
there is what would be found again, for the same images, intrinsics and seed. An image enters the index last: of one that
a kill interrupted, the index does not know.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from jcr.files import read_bytes, write_text
from jcr.match.gate import Key

DATABASE, INDEX = "live/features.db", "live/features.json"
FORMAT = "jcr.features/1"
"""To be changed with whatever changes the features or the geometries of a pair."""
SEED = 0
"""Of the geometries."""


def file_digest(file: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(read_bytes(file)).hexdigest()


def new_database(database: Path, camera: pycolmap.Camera) -> None:
    """A database of images of one camera, without images."""
    with closing(pycolmap.Database.open(database)) as db:
        db.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)


def enter_image(db: pycolmap.Database, row: int) -> str:
    """One more image of that camera, before its features; its name is returned."""
    name = image_name(row)
    image = pycolmap.Image(name=name, camera_id=1, image_id=row + 1)
    db.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
    frame.add_data_id(image.data_id)
    db.write_frame(frame, use_frame_id=True)
    return name


def image_name(row: int) -> str:
    """Of a row, in a database."""
    return f"{row:05d}.png"


@dataclass(frozen=True)
class KeptFeatures:
    """The database in the folder of a capture."""

    folder: Path
    row_of: dict[str, int]
    """Rows of the database by the digests of the images' files."""

    @staticmethod
    def of(folder: Path) -> "KeptFeatures":
        """What is kept in a folder: nothing, where there is no index or it is not of this format."""
        try:
            content = json.loads(read_bytes(folder / INDEX))
            rows = {str(digest): int(row) for digest, row in content["rows"].items()}
            is_current = content["format"] == FORMAT and (folder / DATABASE).is_file()
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            return KeptFeatures(folder, {})
        return KeptFeatures(folder, rows if is_current else {})

    @property
    def database(self) -> Path:
        """The COLMAP database."""
        return self.folder / DATABASE

    def rows(self, digests: Iterable[str]) -> list[int | None]:
        """The rows of images, by the digests of their files; None of those that are not kept."""
        return [self.row_of.get(digest) for digest in digests]

    def copy_into(self, database: Path, camera: pycolmap.Camera, rows: Sequence[int | None]) -> set[int]:
        """Copy what is kept into a database that has its images; return the rows there that have features now.

        `rows` are those of the kept database, one for each image. Features must be of images of this camera's size;
        the geometries of pairs are copied where they were found with these intrinsics.
        """
        there = [(row, kept) for row, kept in enumerate(rows) if kept is not None]
        if not there:
            return set()
        with (
            closing(pycolmap.Database.open(self.database)) as source,
            closing(pycolmap.Database.open(database)) as target,
        ):
            before = source.read_camera(1)
            if (before.width, before.height) != (camera.width, camera.height):
                return set()
            for row, kept in there:
                _copy_image(source, kept, target, row)
            pairs = [(a, b) for k, a in enumerate(there) for b in there[k + 1 :]]
            for (i, kept_i), (j, kept_j) in pairs:
                _copy_pair(source, (kept_i, kept_j), target, (i, j), with_geometry=_same(before, camera))
        return {row for row, _ in there}

    def with_image(self, database: Path, row: int, digest: str) -> "KeptFeatures":
        """The same with one more image, whose features are in another database at `row`."""
        number = max(self.row_of.values(), default=-1) + 1
        with closing(pycolmap.Database.open(database)) as source:
            if not self.row_of:
                for ending in ("", "-wal", "-shm"):  # SQLite's journals of a program that was killed
                    Path(f"{self.database}{ending}").unlink(missing_ok=True)
                self.database.parent.mkdir(parents=True, exist_ok=True)
                new_database(self.database, source.read_camera(1))
            with closing(pycolmap.Database.open(self.database)) as target:
                while target.exists_image(
                    number + 1
                ):  # of a capture that was interrupted before the index was written
                    number += 1
                enter_image(target, number)
                _copy_image(source, row, target, number)
        kept = KeptFeatures(self.folder, {**self.row_of, digest: number})
        write_text(self.folder / INDEX, json.dumps({"format": FORMAT, "rows": kept.row_of}) + "\n")
        return kept

    def keep_pairs(self, database: Path, rows: Sequence[int | None], pairs: Iterable[Key]) -> None:
        """Keep the matches and geometries that pairs of another database have; `rows` as copy_into takes them."""
        with (
            closing(pycolmap.Database.open(database)) as source,
            closing(pycolmap.Database.open(self.database)) as target,
        ):
            for i, j in pairs:
                kept_i, kept_j = rows[i], rows[j]
                if kept_i is None or kept_j is None or target.exists_matches(kept_i + 1, kept_j + 1):
                    continue
                _copy_pair(source, (i, j), target, (kept_i, kept_j), with_geometry=True)


def _same(one: pycolmap.Camera, other: pycolmap.Camera) -> bool:
    return (
        one.model == other.model
        and one.has_prior_focal_length == other.has_prior_focal_length
        and bool((one.params == other.params).all())
    )


def _copy_image(source: pycolmap.Database, row: int, target: pycolmap.Database, to: int) -> None:
    target.write_keypoints(to + 1, source.read_keypoints(row + 1))
    target.write_descriptors(to + 1, source.read_descriptors(row + 1))


def _copy_pair(
    source: pycolmap.Database, rows: Key, target: pycolmap.Database, to: Key, with_geometry: bool
) -> None:
    first, second = rows[0] + 1, rows[1] + 1
    if not source.exists_matches(first, second):
        return
    target.write_matches(to[0] + 1, to[1] + 1, source.read_matches(first, second))
    if with_geometry and source.exists_two_view_geometry(first, second):
        found = source.read_two_view_geometry(first, second)
        target.write_two_view_geometry(to[0] + 1, to[1] + 1, found)
