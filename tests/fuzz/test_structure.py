"""Each value of each structured file exchanged for one of another kind: read or refused, soon, and never status 1.

A share by default; JCR_TEST_FUZZ=2 or more tries all, as does `python tests/fuzz/structure.py`.
"""

import json
import os
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jcr
from fuzz_targets import SIZE
from jcr.capture.read import read_source
from jcr.capture.urdf_chain import read_chain
from jcr.errors import InputError
from structure import TOO_LONG_S, VALUES, Document, documents, places, tried

pytestmark = pytest.mark.slow

EVERY = 25 if os.environ.get("JCR_TEST_FUZZ", "1") == "1" else 1


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Document]:
    return documents(tmp_path_factory.mktemp("structure"))


def test_no_value_of_another_kind_makes_a_traceback_or_takes_long(readers: dict[str, Document]):
    cases = [
        (name, place, value)
        for name, document in readers.items()
        for place in places(document.content)
        for value in VALUES
    ]
    shuffled = np.random.default_rng(0).permutation(len(cases))[::EVERY]
    bad, ended = [], []
    for name, place, value in (cases[k] for k in shuffled):
        how, seconds = tried(readers[name], place, VALUES[value])
        readers[name].write(readers[name].content)
        ended.append(how)
        if how not in ("read", "status 2", "status 3") or seconds > TOO_LONG_S:
            bad.append(f"{name} {place} = {value}: {how} ({seconds:.1f} s)")
    assert not bad
    # Most values have a kind, and some may be anything: a fuzzer that is always refused tests nothing.
    assert 0.1 < ended.count("read") / len(ended) < 0.4


def test_thirty_thousand_missing_images_are_refused_at_once(tmp_path: Path):
    frames = [{"image": f"images/{k}.png", "base_from_gripper": np.eye(4).tolist()} for k in range(30_000)]
    (tmp_path / "capture.json").write_text(json.dumps({"frames": frames}))
    start = time.process_time()
    with pytest.raises(InputError, match="30000 frames; choose 1000 at most"):
        jcr.read_capture(tmp_path)
    assert time.process_time() - start < TOO_LONG_S


def link(folder: Path) -> None:
    for k in range(1001):
        os.link(folder / "0.png", folder / f"l{k}.png")


FRAME = {"image": "0.png", "base_from_gripper": np.eye(4).tolist()}
MANY = {
    "the same image": ("capture.json", {"frames": [FRAME] * 30_000}, "30000 frames; choose 1000 at most"),
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
    link(tmp_path)
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    start = time.process_time()
    with pytest.raises(InputError, match=words):
        read_source(tmp_path / name if what == "samples" else tmp_path)
    assert time.process_time() - start < TOO_LONG_S


@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("capture.json, gone on with", ("frames", 3, "joints", 0), [[]]),
        ("capture.json, gone on with", ("frames", 3, "joints"), {"a": [{}]}),
        ("camera_info.yaml", ("distortion_model",), "plumb\0bob"),
        ("camera_info.yaml", ("distortion_model",), {"a": [{}]}),
        ("added/capture.json", ("added_to",), "a\0b"),
    ],
)
def test_what_further_values_found_stays_closed(
    readers: dict[str, Document], name: str, place: tuple[str | int, ...], value: object
):
    try:
        assert tried(readers[name], place, value)[0] == "status 2"
    finally:
        readers[name].write(readers[name].content)


def test_joints_that_lead_back_are_refused(tmp_path: Path):
    joints = "".join(
        f'<joint name="{a}{b}" type="revolute"><parent link="{a}"/><child link="{b}"/><axis xyz="0 0 1"/></joint>'
        for a, b in ("ab", "bc", "ca")
    )
    (tmp_path / "ring.urdf").write_text(
        f'<robot name="ring"><link name="a"/><link name="b"/><link name="c"/>{joints}</robot>'
    )
    with pytest.raises(InputError, match="lead back"):
        read_chain(tmp_path / "ring.urdf", 3)
