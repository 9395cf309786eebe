"""Reading of a folder of images with documents that hold the gripper poses: tables, pairing, and readings."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.checks import checked_capture, require_frames
from jcr.capture.discovery import Discovery, discover
from jcr.capture.documents import Table
from jcr.capture.intrinsics import intrinsics_of_capture
from jcr.capture.options import ReadOptions, tolerated
from jcr.capture.pairing import Pairing, poses_at_images
from jcr.capture.readings import (
    numbers_of_table,
    pose_columns,
    readings_of,
    source_of,
    undecided,
    untaken_readings,
)
from jcr.errors import LONGEST_NAME, InputError, count_of, first_few, printable, shown
from jcr.records import Capture, Reading

POSE_WORDS = re.compile(r"pos|tcp|robot|ee|arm|hand|flange|matri|end|gripper", re.IGNORECASE)
"""Parts of names of files that probably hold the poses."""
SAME_POSES = 1e-4
"""Largest difference (m, and of the entries of a rotation) of the same poses in two files with rounded numbers."""
_Poses = Float[ndarray, "r 4 4"]


@dataclass(frozen=True, kw_only=True)
class _Source:
    """A table that may hold the gripper poses: its readings, paired with the images."""

    table: Table
    paired: Pairing
    relevance: int
    candidates: tuple[tuple[Reading, _Poses], ...]
    """Readings, with the poses of the images; of the rows if rows and images differ in number."""
    notes: tuple[str, ...] = ()

    @property
    def rank(self) -> tuple[int, bool, bool]:
        """Sort key, largest for the table that most probably holds the robot's poses."""
        return self.relevance, self.paired.is_paired, self.paired.is_by_name


def read(path: Path, options: ReadOptions) -> Capture:
    """Read a capture from a folder with images and documents, or from a file of poses beside or above images.

    Where names, numbers and options leave several readings, the capture has them as `candidates`, and its poses are NaN
    until the images decide. Raises InputError if there are no poses, or no images for them.
    """
    folder, poses = (path, options.poses) if path.is_dir() else (path.parent, path)
    found = discover(folder, poses)
    sources, errors = list[_Source](), list[tuple[Path, InputError]]()
    for table, paired in found.tables:
        try:
            source = _source(table, paired, options)
        except InputError as error:
            errors.append((table.file, error))
            continue
        sources += [source] if source.candidates else []
    if not sources:
        raise _no_poses(folder, found, [*errors, *found.refused])
    best = max(source.rank for source in sources)
    chosen = _without_copies([source for source in sources if source.rank == best])
    return _capture(folder, found, chosen, options)


def _source(table: Table, paired: Pairing, options: ReadOptions) -> _Source:
    """Return a table with its readings at the images; raise InputError if numbers contradict units or times."""
    where = f"{table.file}{f': {table.place}' if table.place else ''}"
    rank, readings = readings_of(table, options, where, paired.skipped)
    if not paired.is_paired:
        return _Source(table=table, paired=paired, relevance=rank, candidates=tuple(readings))
    made, notes = list[tuple[Reading, _Poses]](), set[str]()
    for reading, of_rows in readings:
        at_images, stale, note = poses_at_images(of_rows, paired, options.max_gap_ms, where)
        notes |= {note} if note is not None else set()
        if stale.all():
            raise InputError(
                f"{where}: no pose within {options.max_gap_ms:.0f} ms around any image; raise --max-gap-ms, or check "
                "the clocks"
            )
        made.append((reading, at_images))
    return _Source(
        table=table, paired=paired, relevance=rank, candidates=tuple(made), notes=tuple(sorted(notes))
    )


def _without_copies(sources: list[_Source]) -> list[_Source]:
    """Return the sources without those that hold the poses of an earlier one; sources with fewer readings come first."""
    kept = list[_Source]()
    for source in sorted(sources, key=lambda one: len(one.candidates)):
        known = [poses for one in kept for _, poses in one.candidates]
        is_copy = any(
            poses.shape == other.shape and np.allclose(poses, other, rtol=0, atol=SAME_POSES, equal_nan=True)
            for _, poses in source.candidates
            for other in known
        )
        kept += [] if is_copy else [source]
    return kept


def _capture(folder: Path, found: Discovery, chosen: list[_Source], options: ReadOptions) -> Capture:
    """Return the capture of tables and images; paired frames without a pose are left out with a note.

    Where rows and images differ in number and nothing pairs them, only the images can tell which fit.
    """
    candidates, first = [one for source in chosen for one in source.candidates], chosen[0]
    file, is_paired, faults = str(first.table.file), first.paired.is_paired, dict[int, str]()
    bare, unlisted = list[int](), list[int]()
    if is_paired:
        has_pose = np.any([np.isfinite(poses).all((1, 2)) for _, poses in candidates], axis=0)
        bare = np.flatnonzero(~has_pose).tolist()
    for k in bare:
        if (fault := _row_fault(chosen, k)) is None:
            unlisted.append(k)
        else:
            faults[k] = f"{file}: the row of {found.images[k]} holds no pose: {fault}; correct it"
    if len(unlisted) > (most := tolerated(len(found.images))):
        of, names = count_of(len(found.images), "image"), first_few([found.images[k] for k in unlisted])
        raise InputError(
            f"{source_of(first.table)}: {len(unlisted)} of {of} have no pose there, and at most {most} may lack one: "
            f"{names}; add their poses, or move these images away"
        )
    rows = [k for k in range(len(found.images)) if k not in unlisted]
    require_frames(len(rows), file, 0)
    is_decided = is_paired and len(candidates) == 1
    poses = candidates[0][1][rows] if is_decided else np.tile(np.eye(4), (len(rows), 1, 1))
    images, placed = [found.images[k] for k in rows], {rows.index(k): text for k, text in faults.items()}
    capture, kept = checked_capture(folder, images, poses, file, placed)
    taken = [rows[k] for k in kept]
    intrinsics, more = intrinsics_of_capture(folder, found.documents, options, capture.image_size)
    if not is_decided:
        at_images = tuple((one, of_all[taken] if is_paired else of_all) for one, of_all in candidates)
        nothing = np.full((len(kept), 4, 4), np.nan)
        capture = replace(capture, base_from_gripper=nothing, candidates=at_images)
    notes = _pairing_notes(folder, chosen, [found.images[k] for k in unlisted]) if is_paired else ()
    return replace(
        capture,
        source=first.table.file,
        intrinsics=intrinsics,
        reading=candidates[0][0] if is_decided else None,
        untaken=_untaken(first, taken, file) if is_decided else (),
        notes=(*found.notes, *notes, *more, *capture.notes),
    )


def _pairing_notes(folder: Path, chosen: list[_Source], unlisted: list[str]) -> list[str]:
    """Return notes on how rows and images were paired, and on those without a partner."""
    table, paired = chosen[0].table, chosen[0].paired
    notes = [note for source in chosen for note in source.notes]
    notes.append(f"poses of {source_of(table)}, paired with the images {paired.how}")
    if paired.row is not None and (alone := np.setdiff1d(np.arange(len(table.rows)), paired.row)).size:
        numbers = first_few([str(1 + r) for r in alone.tolist()])
        notes.append(
            f"left out: {count_of(len(alone), 'pose')} of {table.file.name} without an image in {folder}: "
            f"row {numbers} of its table, counted from 1 without a header"
        )
    if unlisted:
        notes.append(
            f"left out: {count_of(len(unlisted), 'image')} without a pose in {table.file.name}: {first_few(unlisted)}"
        )
    return notes


def _untaken(source: _Source, images: list[int], where: str) -> tuple[tuple[Reading, _Poses], ...]:
    """Return the readings that names or options ruled out, with their poses of the images with the given indices."""
    others = untaken_readings(source.table, source.candidates[0][0], where, source.paired.skipped)
    return tuple(
        (one, poses_at_images(poses, source.paired, np.inf, where)[0][images]) for one, poses in others
    )


def _row_fault(chosen: list[_Source], image: int) -> str | None:
    """Return why the row of an image is no pose, by the cell that is no number; None if no table has a row for it."""
    with_row = [one for one in chosen if one.paired.row is not None and one.paired.row[image] >= 0]
    if not with_row:
        return None
    table, paired = with_row[0].table, with_row[0].paired
    assert paired.row is not None
    columns = pose_columns(table, paired.skipped)[0]
    row = int(paired.row[image])
    numbers, cells = numbers_of_table(table)[row], table.rows[row]
    for k in (*columns.position, *columns.rotation):
        if np.isnan(numbers[k]):
            holds = "is empty" if cells[k] is None else f"holds {shown(cells[k])}"
            return f"column {table.columns[k] or k + 1} {holds}"
    return f"{' '.join(f'{numbers[k]:.4g}' for k in columns.rotation)} is no rotation"


def _why_no_pose(table: Table) -> str:
    """Return why a table whose columns have names holds no pose; empty without such names."""
    rows, missing = len(table.rows), np.isnan(numbers_of_table(table)).sum(0).tolist()
    for name, cells, bad in zip(table.columns, zip(*table.rows, strict=True), missing, strict=True):
        if name and bad > tolerated(rows) and any(isinstance(cell, float) for cell in cells):
            return f" (column {printable(name)[:LONGEST_NAME]} has no number in {bad} of {rows} rows)"
    names = [printable(name) for name in table.columns if name]
    return f" (its columns {first_few(names)} are no position with a rotation)" if names else ""


def _no_poses(folder: Path, found: Discovery, errors: list[tuple[Path, InputError]]) -> InputError:
    """Return the error that no document holds poses: that of the file that most probably should, else how to add one."""
    named = [one for one in errors if POSE_WORDS.search(one[0].name)]
    if named or errors:
        return (named or errors)[0][1]
    listed = first_few([one.name for one in found.documents])
    tables = sorted(
        (table for table, _ in found.tables), key=lambda one: not POSE_WORDS.search(one.file.name)
    )
    listed += _why_no_pose(tables[0]) if tables else ""
    images = found.images
    return InputError(
        f"{folder}: no gripper poses for its {count_of(len(images), 'image')} ({images[0]} … {images[-1]})"
        f"{f' in {listed}' if listed else ''}; add a file with a row for each image (image,x,y,z,qx,qy,qz,qw in m, or "
        "as the robot writes it), or name one with --poses"
    )


def count_differs(capture: Capture) -> InputError:
    """Return the error that a file has another number of poses than there are images; it is not raised."""
    rows = len(capture.candidates[0][1])
    return InputError(
        f"{capture.source}: {count_of(rows, 'pose')} for {count_of(len(capture), 'image')} "
        f"({capture.images[0]} … {capture.images[-1]}), and nothing says which belongs to which; "
        "add a column with the images' names, or remove what is too much"
    )


def require_decided(capture: Capture) -> Capture:
    """Return a capture whose reading is decided; raise InputError that lists the possible readings for another one."""
    if capture.candidates:
        is_unpaired = len(capture.candidates[0][1]) != len(capture)
        readings = [reading for reading, _ in capture.candidates]
        raise count_differs(capture) if is_unpaired else undecided(str(capture.source), readings)
    return capture
