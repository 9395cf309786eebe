"""Pairing of the rows of a pose table with images: by names, numbers, time stamps, or order."""

import re
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.capture.documents import Table
from jcr.capture.frame_choice import STILL_SPEED
from jcr.capture.pose_track import NEVER, interpolated_poses
from jcr.errors import InputError, count_of, shown
from jcr.files import LONGEST
from jcr.geometry import inverse, motion_length

_LATEST_NS = np.iinfo(np.int64).max
"""Largest time stamp (ns) that fits 64 bits, in the year 2262."""
NEARLY = 0.75
"""Smallest share of the images that a column must name; tables often lack the poses of a few images."""
LEAST_TEXT = 6
"""Smallest length of a cell that is looked for inside the images' names; shorter ones occur by chance."""
ROW_NAMES = {
    "id", "index", "idx", "no", "num", "nr", "number", "frame", "record", "pose", "sample", "shot", "image", "step",
}  # fmt: skip
"""Words of the name of a column that counts images."""
STAMP_NAMES = {
    "timestamp", "stamp", "time", "t", "sec", "secs", "ts", "datetime", "date", "nanosec", "nsecs", "nsec",
}  # fmt: skip
STAMP_PARTS = {"ns", "s", "ms", "us", "header", "ros"}
"""Words of the name of a column of time stamps, and words that may stand beside them."""
ZONE_NS = 900 * 10**9
"""Step (ns) of the differences between time zones, a quarter of an hour."""
MOMENT_NS = 1_000_000
"""Time (ns) before and after a stamp by which the speed there is measured."""
DATE = re.compile(
    r"(?<!\d)(\d{4})[-_.:]?(\d\d)[-_.:]?(\d\d)[T _-]+(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)(?:[.,_](\d{1,9}))?"
)
"""Date and time in a name or a cell, with any separators."""


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """Rows of a table that belong to a folder's images, or the times at which its poses are interpolated."""

    how: str
    """Words for the user: by what the rows and images were paired."""
    row: Int[ndarray, " n"] | None = None
    """Row of each image, -1 without one; None if rows and images differ in number and nothing pairs them."""
    skipped: frozenset[int] = frozenset()
    """Columns that hold names of images, numbers of rows or time stamps."""
    is_by_name: bool = False
    """Whether names, numbers or time stamps pair them, rather than the order."""
    stamp_ns: Int[ndarray, " r"] | None = None
    """Time stamp of each row, where images have time stamps, too."""
    image_ns: Int[ndarray, " n"] | None = None

    @property
    def is_paired(self) -> bool:
        """Whether rows or times of the table belong to the images."""
        return self.row is not None or self.stamp_ns is not None


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders names by the numbers in them: img2 before img10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def plain_name(name: str) -> str:
    """Return a name without folder, ending and case, in Unicode form C; slashes may be of both kinds."""
    last = PurePosixPath(unicodedata.normalize("NFC", name).strip().replace("\\", "/"))
    is_ending = re.fullmatch(r"\.[A-Za-z]\w{1,4}", last.suffix)
    return (last.stem if is_ending else last.name).casefold()


def pair(table: Table, images: Sequence[str]) -> Pairing:
    """Pair the rows of a table with images, which are in natural order, by the surest of what the table holds.

    Names of images are surest, then time stamps in the names, numbers in names, and last the order of as many rows.
    """
    skipped = frozenset(_counting_columns(table) | _stamp_columns(table).keys())
    for found in (_by_cells(table, images), _by_time(table, images), _by_number(table, images)):
        if found is not None:
            return replace(found, skipped=found.skipped | skipped)
    if len(table.rows) == len(images):
        how = f"in order of the images' names: {images[0]} … {images[-1]}"
        return Pairing(how=how, row=np.arange(len(images)), skipped=skipped)
    return Pairing(
        how=f"{count_of(len(table.rows), 'row')}, {count_of(len(images), 'image')}", skipped=skipped
    )


def _texts(table: Table, k: int) -> list[str]:
    """Return the cells of a column as texts; numbers that are integers without a decimal point."""
    cells = [row[k] for row in table.rows]
    return [
        "" if cell is None else f"{cell:.0f}" if isinstance(cell, float) and cell.is_integer() else str(cell)
        for cell in cells
    ]


def _columns(table: Table) -> list[tuple[int | None, list[str]]]:
    """Return the table's row names (with the index None) and its columns of texts, as lists of texts."""
    texts = [(k, _texts(table, k)) for k in range(len(table.columns))]
    is_text = [any(isinstance(row[k], str) for row in table.rows) for k in range(len(table.columns))]
    keys = [] if table.keys is None else [(None, list(table.keys))]
    return [*keys, *(one for one, kept in zip(texts, is_text, strict=True) if kept)]


def _by_cells(table: Table, images: Sequence[str]) -> Pairing | None:
    """Return the pairing by the column or row names that name most images; None if none names nearly all."""
    best, most, own = None, 0, dict[str, list[int]]()
    for k, image in enumerate(images):
        own.setdefault(plain_name(image), []).append(k)
    listed = "\n".join(own)
    whole = {unicodedata.normalize("NFC", image): k for k, image in enumerate(images)}
    for column, cells in _columns(table):
        row = np.full(len(images), -1)
        for r, cell in enumerate(cells):
            text = unicodedata.normalize("NFC", cell).strip().replace("\\", "/").removeprefix("./")
            like = [whole[text]] if text in whole else own.get(plain_name(text), [])
            folded = text.casefold()
            if not like and len(text) >= LEAST_TEXT and folded in listed and not _is_number(text):
                like = [k for name, ks in own.items() if folded in name for k in ks]
            if len(like) == 1 and row[like[0]] < 0:
                row[like[0]] = r
        count = int((row >= 0).sum())
        enough = NEARLY * min(len(images), len(table.rows))
        if count >= max(enough, 1) and count > most:
            most = count
            name, skipped = "names of rows", frozenset[int]()
            if column is not None:
                name, skipped = f"column {table.columns[column] or f'no. {column + 1}'}", frozenset([column])
            best = Pairing(how=f"by the {name}", row=row, skipped=skipped, is_by_name=True)
    return best


def _is_number(text: str) -> bool:
    """Test whether a text is a number in Python's notation."""
    try:
        float(text.replace("_", "x"))
    except ValueError:
        return False
    return True


def _counting_columns(table: Table) -> set[int]:
    """Return the columns of integers that count rows: 0, 1, 2 … or named as a number of images."""
    found = set()
    for k, name in enumerate(table.columns):
        cells = [row[k] for row in table.rows]
        if not all(isinstance(cell, float) and cell.is_integer() for cell in cells):
            continue
        words = set(re.findall(r"[a-z]+", (name or "").lower()))
        steps = np.diff(np.array(cells, dtype=np.float64))
        counts = len(steps) > 0 and bool((steps == 1).all()) and cells[0] in (0.0, 1.0)
        if (name is None and k == 0 and counts) or (words and words <= ROW_NAMES and (steps != 0).all()):
            found.add(k)
    return found


def _numbers_of(names: Sequence[str]) -> list[int] | None:
    """Return the number in each name that differs between the names, the last one if several do; None without one."""
    parts = [re.findall(r"\d+", plain_name(name)) for name in names]
    if not parts or len({len(one) for one in parts}) != 1:
        return None
    short = [k for k in range(len(parts[0])) if all(len(one[k]) <= LONGEST for one in parts)]
    columns = [[int(one[k]) for one in parts] for k in short]
    unique = [column for column in columns if len(set(column)) == len(column)]
    return unique[-1] if unique else None


def _by_number(table: Table, images: Sequence[str]) -> Pairing | None:
    """Return the pairing by numbers in the images' names and in row names or a counting column; None without one.

    The images' numbers must all be numbers of rows, and the rows nearly as many; else they may count from another start.
    """
    of_images = _numbers_of(images)
    if of_images is None:
        return None
    counted = [
        (k, _texts(table, k)) for k in sorted(_counting_columns(table)) if table.columns[k] is not None
    ]
    for column, cells in ([] if table.keys is None else [(None, list(table.keys))]) + counted:
        of_rows = _numbers_of(cells)
        if of_rows is None or not set(of_images) <= set(of_rows):
            continue
        if len(of_rows) > len(of_images) and len(of_images) < NEARLY * len(of_rows):
            continue
        at = {number: r for r, number in enumerate(of_rows)}
        name = "the files' numbers" if column is None else f"column {table.columns[column]}"
        return Pairing(how=f"by {name}", row=np.array([at[n] for n in of_images]), is_by_name=True)
    return None


def stamp_ns(text: str, where: str = "") -> int:
    """Convert a time stamp from text to nanoseconds: a number whose size tells s, ms, µs or ns, or a date with a time.

    Numbers below 1e11 are in s, below 1e14 in ms, below 1e17 in µs, others in ns. The result is exact. A date counts as
    UTC. Raises InputError if the text is no time stamp.
    """
    with suppress(ArithmeticError, ValueError):  # errors of Decimal and int
        if (date := DATE.search(text)) is not None:
            *fields, fraction = date.groups()
            whole = int(datetime(*map(int, fields), tzinfo=UTC).timestamp())  # pyright: ignore[reportArgumentType]
            return whole * 10**9 + int((fraction or "0").ljust(9, "0"))
        value = Decimal(text)
        if (size := abs(value)) < 10**20:
            unit_ns = 10**9 if size < 10**11 else 10**6 if size < 10**14 else 10**3 if size < 10**17 else 1
            if abs(stamp := int(value * unit_ns)) <= _LATEST_NS:
                return stamp
    raise InputError(f"{where}: {shown(text)} is not a time stamp; give seconds or nanoseconds")


def stamps_of_names(images: Sequence[str]) -> Int[ndarray, " n"] | None:
    """Return the time stamps (ns) in the images' names: a date, or a number of ten digits or more; None without them."""
    found = list[int]()
    for image in images:
        name = plain_name(image)
        number = re.search(r"(?<!\d)(?:\d{9,19}(?:\.\d+)?|\d+\.\d+)(?!\d)", name)
        sides = re.fullmatch(r"\D*(\d{10})[._](\d{9})\D*", name)  # seconds and nanoseconds
        text = f"{sides[1]}.{sides[2]}" if sides else number[0] if number else ""
        date = DATE.search(name)
        try:
            found.append(stamp_ns(date[0] if date else text))
        except InputError:
            return None
    return np.array(found, dtype=np.int64) if len(set(found)) == len(found) else None


def _stamp_columns(table: Table) -> dict[int, list[int]]:
    """Return the columns that hold time stamps, each with its stamps (ns).

    A column of seconds with one of nanoseconds beside it is one stamp, under the first column. The first column without
    a name counts if it ascends and its numbers are no positions of an arm (above 10,000).
    """
    found, parts = {}, {}
    for k, name in enumerate(table.columns):
        cells = [row[k] for row in table.rows]
        words = set(re.findall(r"[a-z]+", (name or "").lower().replace("_ns", "")))
        is_named = bool(words & STAMP_NAMES) and not words - STAMP_NAMES - STAMP_PARTS
        is_fraction = bool(words & {"nanosec", "nsecs", "nsec"})
        if len(set(map(str, cells))) < len(cells) / 2 and not is_fraction:
            continue  # a turn of an axis, such as KUKA's T
        numeric = [cell for cell in cells if isinstance(cell, float)]
        rising = len(numeric) == len(cells) and bool((np.diff(numeric) >= 0).all())
        is_place = re.search(r"\d", name or "") is not None  # T_03, an entry of a transform
        is_named = is_named and (
            words != {"t"} or (rising and len(set(numeric)) == len(cells) and not is_place)
        )  # or Kawasaki's T
        if not is_named and not (name is None and k == 0 and rising and abs(numeric[0]) > 1e4):
            dated = [
                isinstance(cell, str) and (DATE.search(cell) or re.fullmatch(r"\d{16,19}", cell))
                for cell in cells
            ]
            if not all(dated):
                continue
        texts = [repr(cell) if isinstance(cell, float) else str(cell) for cell in cells]
        with suppress(InputError):
            if is_fraction:
                parts["nanosec"] = k, [int(Decimal(text)) for text in texts]
                continue
            found[k] = [stamp_ns(text) for text in texts]
    if "nanosec" in parts and found:
        first = next(iter(found))
        whole = [10**9 * (one // 10**9) for one in found[first]]
        found[first] = [a + b for a, b in zip(whole, parts["nanosec"][1], strict=True)]
        found[parts["nanosec"][0]] = found[first]
    return found


def _by_time(table: Table, images: Sequence[str]) -> Pairing | None:
    """Return the pairing by time stamps in the table and in the images' names; None if one of them has none."""
    columns, image_ns = _stamp_columns(table), stamps_of_names(images)
    if image_ns is None or not columns:
        return None
    column = next(iter(columns))
    return Pairing(
        how=f"by time stamps, poses interpolated at those of the {len(images)} images' names",
        is_by_name=True,
        stamp_ns=np.array(columns[column], dtype=np.int64),
        image_ns=image_ns,
    )


def poses_at_images(
    poses: Float[ndarray, "r 4 4"], paired: Pairing, max_gap_ms: float, where: str
) -> tuple[Float[ndarray, "n 4 4"], Bool[ndarray, " n"], str | None]:
    """Return the poses at the images by row or by time, a mask of images whose poses are stale, and a note or None.

    An image without a row or with a stale pose gets NaN. A stale pose is interpolated between samples that are more
    than `max_gap_ms` apart. Where no image lies within the times, a difference of time zones is tried: a multiple of a
    quarter of an hour with which the arm is at rest at the images. Raises InputError if none fits.
    """
    if paired.stamp_ns is None or paired.image_ns is None:
        assert paired.row is not None
        at_images = poses[paired.row]
        at_images[paired.row < 0] = np.nan
        return at_images, np.zeros(len(at_images), bool), None
    sound, stamps, note = np.isfinite(poses).all((1, 2)), paired.image_ns, None
    if not sound.any():
        raise InputError(f"{where}: no row holds a pose; correct its numbers")
    times, known = paired.stamp_ns[sound], poses[sound]
    inside = (stamps >= times.min()) & (stamps <= times.max())
    if not inside.any():
        shift = _zone(times, known, stamps)
        gap_s = (float(stamps.min()) - float(times.min())) / 1e9
        if shift is None:
            raise InputError(
                f"{where}: no image lies within the times of the poses; the first image is {gap_s:+.1f} s from the "
                "first pose: the two clocks differ; correct the time stamps of one, or add a column with the images' "
                "names"
            )
        stamps = stamps + shift
        note = f"the clocks differ by {shift / 3.6e12:+.2f} h; the poses were shifted by that"
    at_images, gap_ns = interpolated_poses(times, known, stamps)
    stale = gap_ns > 1e6 * max_gap_ms
    at_images[stale] = np.nan
    return at_images, stale, note


def _zone(
    times: Int[ndarray, " r"], poses: Float[ndarray, "r 4 4"], stamps: Int[ndarray, " n"]
) -> int | None:
    """Return the difference (ns) of time zones that brings all stamps into the times while the arm is at rest; or None.

    None is also returned if several differences do.
    """
    low, high = times.min() - stamps.min(), times.max() - stamps.max()
    steps = range(-(-int(low) // ZONE_NS), int(high) // ZONE_NS + 1)
    fitting = []
    for step in steps if len(steps) <= 200 else ():
        at = stamps + step * ZONE_NS
        _, gap = interpolated_poses(times, poses, at)
        before, after = (interpolated_poses(times, poses, at + side * MOMENT_NS)[0] for side in (-1, 1))
        slow = np.asarray(motion_length(inverse(before) @ after)) / (2e-9 * MOMENT_NS) < STILL_SPEED
        if (gap != NEVER).all() and slow.mean() >= NEARLY:
            fitting.append(step * ZONE_NS)
    return fitting[0] if len(fitting) == 1 else None


AS_TEXT = "in the order of the images' names as text (1, 10, 11, … 2)"
AS_NUMBERS = "in the order of the images' names as numbers (1, 2, … 10)"
LARGEST_SHIFT = 2
"""Largest shift, in images, between poses and images that is tried."""


def other_orders(names: Sequence[str]) -> Iterator[tuple[str, Int[ndarray, " n"]]]:
    """Yield other orders of the poses of n named images: words for each, and the pose's index of each image, or -1."""
    n = len(names)
    yield "listed in reverse order of the images", np.arange(n)[::-1]
    for shift in range(1, min(LARGEST_SHIFT, n - 5) + 1):
        for word, sign, step in (("ahead of", "+", shift), ("behind", "−", -shift)):
            order = np.arange(n) + step
            order[(order < 0) | (order >= n)] = -1
            yield (
                f"{'one' if shift == 1 else shift} {word} the images (image k has pose k {sign} {shift})",
                order,
            )
    for words, key in ((AS_NUMBERS, natural), (AS_TEXT, str)):
        order = sorted(range(n), key=lambda k: key(names[k]))
        if order != list(range(n)):
            yield words, np.argsort(order)
