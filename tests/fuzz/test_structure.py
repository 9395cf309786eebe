"""Each value of each structured file exchanged for one of another kind: read or refused, soon, and never status 1.

A share by default; JCR_TEST_FUZZ=2 or more tries all.
"""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from corpus import SIZE, STRUCTURES, Target, corpus
from jcr.capture.read import read_source
from jcr.errors import InputError, RejectedError

pytestmark = pytest.mark.slow

EVERY = 25 if os.environ.get("JCR_TEST_FUZZ", "1") == "1" else 1
TOO_LONG_S = 5.0
VALUES = {
    "null": None,
    "-1": -1,
    "0": 0,
    "1e309": float("inf"),
    "empty text": "",
    "list": [],
    "object": {},
    "text of 10⁶": "x" * 1_000_000,
}
"""What takes a value's place; infinity is written as 1e309, which JSON has no other word for."""
Place = tuple[str | int, ...]


def places(content: object, place: Place = ()) -> Iterator[Place]:
    """Yield every place of a value, of each list the first and the last."""
    if place:
        yield place
    if isinstance(content, dict):
        for key, value in content.items():
            yield from places(value, (*place, key))
    if isinstance(content, list) and content:
        for k in sorted({0, len(content) - 1}):
            yield from places(content[k], (*place, k))


def exchanged(content: Any, place: Place, value: object) -> Any:
    """Return a copy of the content with another value at a place."""
    if not place:
        return value
    copy = dict(content) if isinstance(content, dict) else list(content)
    copy[place[0]] = exchanged(content[place[0]], place[1:], value)
    return copy


def tried(target: Target, content: Any, place: Place, value: object) -> tuple[str, float]:
    """Return how reading ends: `read`, `refused`, or the exception that would be status 1; and the seconds."""
    valid, write = target.file.read_bytes(), STRUCTURES[target.file.suffix][1]
    data = write(exchanged(content, place, value)).encode()
    start = time.process_time()  # of a busy machine the clock tells nothing
    try:
        target.feed(data)
        ended = "read"
    except (InputError, RejectedError) as error:
        ended = "refused" if "\0" not in str(error) else "unreadable message"
    except Exception as error:  # what a user would see as a traceback
        ended = f"status 1: {type(error).__name__}: {str(error)[:200]}"
    finally:
        target.file.write_bytes(valid)
    return ended, time.process_time() - start


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Target, Any]]:
    """The structured files of the corpus, with their content."""
    found = corpus(tmp_path_factory.mktemp("structure") / "targets")
    return {
        name: (target, STRUCTURES[target.file.suffix][0](target.file.read_text()))
        for name, target in found.items()
        if target.file.suffix in STRUCTURES
    }


@pytest.mark.long
def test_no_value_of_another_kind_makes_a_traceback_or_takes_long(targets: dict[str, tuple[Target, Any]]):
    cases = [
        (name, place, value)
        for name, (_, content) in targets.items()
        for place in places(content)
        for value in VALUES
    ]
    shuffled = np.random.default_rng(0).permutation(len(cases))[::EVERY]
    bad, ended = [], []
    for name, place, value in (cases[k] for k in shuffled):
        how, seconds = tried(*targets[name], place, VALUES[value])
        ended.append(how)
        if how not in ("read", "refused") or seconds > TOO_LONG_S:
            bad.append(f"{name} {place} = {value}: {how} ({seconds:.1f} s)")
    assert not bad
    # Most values have a kind, and some may be anything: a fuzzer that is always refused tests nothing.
    assert 0.1 < ended.count("read") / len(ended) < 0.4


FRAME = {"image": "0.png", "base_from_gripper": np.eye(4).tolist()}
MANY = {
    "missing images": (
        "capture.json",
        {"frames": [FRAME | {"image": f"images/{k}.png"} for k in range(30_000)]},
        "30000 frames; choose 1000 at most",
    ),
    "this many images": (
        "capture.json",
        {"frames": [FRAME | {"image": f"l{k}.png"} for k in range(1001)]},
        "1001 frames; choose 1000 at most",
    ),
    "samples": (
        "samples.yaml",
        [dict.fromkeys(("effector_wrt_world", "object_wrt_sensor"), np.eye(4).ravel().tolist())] * 1001,
        "1001 frames; choose 1000 at most",
    ),
    "rows": (
        "poses.csv",
        "image,x,y,z,qx,qy,qz,qw\n" + "".join(f"{k}.png,0.5,0.1,0.4,0,0,0,1\n" for k in range(100_000)),
        "100000 frames; choose 1000 at most",
    ),
    "columns": (
        "poses.csv",
        ",".join(f"c{k}" for k in range(30_000)) + "\n" + ",".join("0" * 30_000),
        "contain no pose",
    ),
}


@pytest.mark.parametrize("what", MANY)
def test_many_entries_of_any_kind_are_refused_at_once(tmp_path: Path, what: str):
    name, content, words = MANY[what]
    Image.new("RGB", SIZE).save(tmp_path / "0.png")
    for k in range(1001):
        os.link(tmp_path / "0.png", tmp_path / f"l{k}.png")
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    start = time.process_time()
    with pytest.raises(InputError, match=words):
        read_source(tmp_path / name if what == "samples" else tmp_path)
    assert time.process_time() - start < TOO_LONG_S


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("resumed capture.json", ("frames", 3, "joints", 0), [[]]),
        ("resumed capture.json", ("frames", 3, "joints"), {"a": [{}]}),
        ("camera_info.yaml", ("distortion_model",), "plumb\0bob"),
        ("added/capture.json", ("added_to",), "a\0b"),
    ],
)
def test_what_further_values_found_stays_closed(
    targets: dict[str, tuple[Target, Any]], name: str, place: Place, value: object
):
    assert tried(*targets[name], place, value)[0] == "refused"
