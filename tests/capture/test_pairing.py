"""Pairing of rows and images by names, numbers, time stamps and order, each with the right row known."""

import unicodedata
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from jcr.capture.documents import Table
from jcr.capture.pairing import (
    AS_NUMBERS,
    AS_TEXT,
    natural,
    other_orders,
    pair,
    poses_at_images,
    stamp_ns,
    stamps_of_names,
)
from jcr.capture.pose_track import NEVER, interpolated_poses
from refusal import refused
from simulation.problems import hand_eye_problem

POSES = hand_eye_problem(np.random.default_rng(3), 6).base_from_gripper
ORDER = [3, 0, 5, 1, 4, 2]
"""Image of each row, where rows are not in the order of the images' names."""
START = 1_700_000_000
"""2023-11-14 22:13:20 UTC."""


def table_of(
    cells: list[list[float | str]], columns: list[str | None] | None = None, keys: list[str] | None = None
) -> Table:
    """Return a table of six rows: other cells, then x, y and z."""
    names = columns or [None] * len(cells[0])
    rows = tuple((*row, float(k), 0.5, 0.25) for k, row in enumerate(cells))
    of_rows = None if keys is None else tuple(keys)
    return Table(file=Path("p.csv"), columns=(*names, "x", "y", "z"), rows=rows, keys=of_rows, words="")


IMAGES = [f"images/{k}.png" for k in range(7, 13)]
CELLS = {
    "path": "images/{}.png", "name": "{}.png", "other folder and ending": "/home/robot/run 7/{}.JPG",
    "Windows": "C:\\run\\{}.png", "beside": "./images/{}.png", "stem": "{}",
}  # fmt: skip


@pytest.mark.parametrize(("cell", "column"), [(cell, "id" if cell == "stem" else "photo") for cell in CELLS])
def test_any_column_of_images_names_pairs_them(cell: str, column: str | None):
    numbers = [7 + k for k in ORDER]
    cells: list[list[float | str]] = [
        [float(n) if cell == "stem" else CELLS[cell].format(n)] for n in numbers
    ]
    found = pair(table_of(cells, [column]), IMAGES)
    assert found.row is not None and found.is_by_name and 0 in found.skipped
    assert [ORDER[row] for row in found.row] == list(range(6))


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_unicode_form_are_the_same(forms):
    images = [unicodedata.normalize(forms[0], f"Größe é {k}.png") for k in range(6)]
    cells: list[list[float | str]] = [[unicodedata.normalize(forms[1], f"Größe é {k}.png")] for k in ORDER]
    found = pair(table_of(cells), images)
    assert found.row is not None and [ORDER[row] for row in found.row] == list(range(6))


def test_keys_and_numbers_pair_and_images_without_a_row_have_none():
    found = pair(table_of([[1.0]] * 6, keys=[f"{7 + k}" for k in ORDER]), IMAGES)
    assert found.row is not None and [ORDER[row] for row in found.row] == list(range(6))
    found = pair(table_of([[1.0]] * 6, keys=[f"pos{7 + k}" for k in ORDER]), IMAGES)
    assert found.row is not None and [ORDER[row] for row in found.row] == list(range(6))
    short = table_of([[f"{7 + k}.png"] for k in ORDER[:5]], ["image"])
    missing = pair(short, IMAGES)
    assert missing.row is not None and missing.row.tolist().count(-1) == 1 and missing.row[ORDER[5]] == -1


def test_rows_pair_in_the_order_in_which_people_count():
    images = sorted((f"img{k}.png" for k in range(8, 14)), key=natural)
    assert images == [f"img{k}.png" for k in range(8, 14)]
    found = pair(table_of([[0.0]] * 6, ["v"]), images)
    assert found.row is not None and found.row.tolist() == list(range(6)) and not found.is_by_name
    assert "img8.png … img13.png" in found.how


def test_rows_and_images_that_differ_in_number_are_not_paired_by_order():
    found = pair(table_of([[0.0]] * 6, ["v"]), IMAGES[:5])
    assert found.row is None and found.stamp_ns is None and "6 rows, 5 images" in found.how


EVERY = [START + 2 * k for k in range(6)]


def dated(form: str, second: int) -> str:
    return datetime.fromtimestamp(second, UTC).strftime(form)


NAMES = {
    "seconds": lambda s: f"{s}.250000000.png", "nanoseconds": lambda s: f"{s}250000000.png",
    "microseconds": lambda s: f"{s}250000.png", "milliseconds": lambda s: f"{s}250.png",
    "prefix": lambda s: f"frame_{s}250000000.png", "suffix": lambda s: f"{s}250000000_color.jpg",
    "two parts": lambda s: f"{s}_250000000.png", "date": lambda s: dated("%Y-%m-%d_%H-%M-%S.25.jpg", s),
    "camera's date": lambda s: dated("IMG_%Y%m%d_%H%M%S_250.jpg", s),
}  # fmt: skip
COLUMNS = {
    "s": (["timestamp"], lambda s: [f"{s}.000000000"]),
    "s, a number": (["time"], lambda s: [float(s)]),
    "ns": (["%time"], lambda s: [f"{s}000000000"]),
    "ns in a header": (["header.stamp"], lambda s: [f"{s}000000000"]),
    "ISO": (["date"], lambda s: [dated("%Y-%m-%dT%H:%M:%S.000Z", s)]),
    "without a name": ([None], lambda s: [float(s)]),
    "sec and nanosec": (["sec", "nanosec"], lambda s: [float(s), 0.0]),
    "header": (["header.stamp.sec", "header.stamp.nanosec"], lambda s: [float(s), 0.0]),
}


@pytest.mark.parametrize(
    ("name", "column"), [*((name, "ns") for name in NAMES), *(("nanoseconds", one) for one in COLUMNS)]
)
def test_time_stamps_pair_to_the_nanosecond(name: str, column: str):
    """Samples at each second, images a quarter of a second later: poses are interpolated."""
    columns, write = COLUMNS[column]
    table = table_of([write(second) for second in EVERY], columns)
    images = [NAMES[name](second) for second in EVERY[:5]]
    found = pair(table, images)
    assert found.stamp_ns is not None and found.image_ns is not None
    assert found.skipped >= set(range(len(columns)))
    assert found.stamp_ns.tolist() == [second * 10**9 for second in EVERY]
    assert (found.image_ns - found.stamp_ns[:5]).tolist() == [250_000_000] * 5
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6.0)
    at_images, stale, note = poses_at_images(poses, found, 5000.0, "p.csv")
    np.testing.assert_allclose(at_images[:, 0, 3], np.arange(5) + 0.125, atol=1e-9)
    assert note is None and not stale.any()
    assert poses_at_images(poses, found, 500.0, "p.csv")[1].all(), "samples two seconds apart are too far"


def test_a_stamp_at_a_sample_has_no_gap_and_one_outside_of_the_samples_has_no_end():
    times, poses = np.array([0, 10, 30]), np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [1.0, 2.0, 6.0]
    found, gap = interpolated_poses(times, poses, np.array([-1, 0, 5, 10, 25, 30, 31]))
    assert found[:, 0, 3].tolist() == [1.0, 1.0, 1.5, 2.0, 5.0, 6.0, 6.0]
    assert gap.tolist() == [NEVER, 0, 10, 0, 20, 0, NEVER]


def resting() -> tuple[np.ndarray, np.ndarray]:
    """Return times (ns) and poses of an arm that rests at six poses for a second each, and moves between them."""
    seconds = np.arange(0, 12, 0.1)
    at = np.interp(seconds, np.arange(12), np.repeat(np.arange(6), 2))
    poses = np.tile(np.eye(4), (len(seconds), 1, 1))
    poses[:, :3, 3] = np.stack([np.interp(at, range(6), POSES[:, axis, 3]) for axis in range(3)], axis=1)
    return np.round((START + seconds) * 1e9).astype(np.int64), poses


@pytest.mark.parametrize("hours", [-8.0, 8.0, 5.75])
def test_clocks_in_other_time_zones_are_found_where_the_arm_rests(hours: float):
    times, poses = resting()
    images = [dated("%Y-%m-%d_%H-%M-%S.5.png", int(START + 3600 * hours + 2 * k)) for k in range(6)]
    rows = [[str(one), *row[:3, 3].tolist()] for one, row in zip(times.tolist(), poses, strict=True)]
    facts = {"file": Path("p.csv"), "place": "", "keys": None, "words": ""}
    table = Table(columns=("stamp", "x", "y", "z"), rows=tuple(map(tuple, rows)), **facts)  # pyright: ignore
    at_images, _, note = poses_at_images(poses, pair(table, images), 500.0, "p.csv")
    assert note is not None and f"{-hours:+.2f} h" in note
    np.testing.assert_allclose(at_images[:, :3, 3], POSES[:, :3, 3], atol=1e-9)


def test_clocks_that_differ_otherwise_are_named_with_the_difference():
    table = table_of([[f"{second}000000000"] for second in EVERY], ["stamp"])
    found = pair(table, [f"{second + 1234567}000000000.png" for second in EVERY])
    with refused(r"p.csv: no image lies within the times.*\+1234567\.0 s.*the two clocks differ"):
        poses_at_images(np.tile(np.eye(4), (6, 1, 1)), found, 100.0, "p.csv")


def test_names_without_stamps_have_none():
    for names in (
        ["a.png", "b.png"], ["1.png", "2.png"], ["img_0001.png", "img_0002.png"], ["1700000000.png"] * 2,
    ):  # fmt: skip
        assert stamps_of_names(names) is None


@pytest.mark.parametrize(
    "text", ["9700000000000000000", "1e30", "0.58E58800781040842", "nan", "now", "2023-99-99 99:99:99"]
)
def test_a_stamp_that_64_bits_do_not_hold_is_refused(text: str):
    """By fuzzing: the first made floats of all the stamps beside it, the third was too large to compare."""
    assert stamp_ns("9200000000000000000", "a table") == 9_200_000_000_000_000_000
    with refused("a table: .*not a time stamp"):
        stamp_ns(text, "a table")


def test_stamps_of_all_units_are_the_same_time():
    whole = START * 10**9 + 123_000_000
    for text in (f"{START}.123", f"{START}123", f"{START}123000", f"{START}123000000", "2023-11-14 22:13:20.123",
                 "2023-11-14T22:13:20,123Z", "20231114_221320.123"):  # fmt: skip
        assert stamp_ns(text) == whole
    later = datetime.fromtimestamp(START, UTC) + timedelta(days=1)
    assert stamp_ns(later.isoformat()) == (START + 86400) * 10**9


def test_other_orders_are_shifts_the_reverse_and_both_ways_of_sorting():
    names = [f"{k}.png" for k in range(1, 13)]
    found = dict(other_orders(names))
    assert found["listed in reverse order of the images"].tolist() == list(range(12))[::-1]
    (ahead,) = (order for words, order in found.items() if words.startswith("one ahead"))
    assert ahead.tolist() == [*range(1, 12), -1]
    # The rows are in the order of the names as text: 1, 10, 11, 12, 2; the image 2.png has the fifth row.
    assert found[AS_TEXT].tolist()[:3] == [0, 4, 5] and AS_NUMBERS not in found
