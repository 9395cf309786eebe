"""Hostile bytes, values, names and numbers: a right reading, an InputError or an honest doubt, soon, and nothing else.

JCR_TEST_FUZZ=20 looks twenty times as long, and exchanges every value of the structured files.
"""

import io
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import jcr
from corpus import SIZE, STRUCTURES, Target, corpus
from jcr.capture.images import read_image, read_one_channel
from jcr.capture.pairing import natural
from jcr.capture.read import read_source
from jcr.capture.ros_messages import image_of, read_ros_depth, read_ros_image
from jcr.errors import InputError, RejectedError
from jcr.export.nerfstudio_colmap import _file_names
from jcr.files import path_inside
from jcr.geometry import rotation_exp, transform
from jcr.live.page import PACKAGE
from jcr.records.reconstruction_npz import read_reconstruction
from jcr.report.render import render
from refusal import refused
from simulation.poses import Pattern
from simulation.problems import HandEyeProblem, error, hand_eye_problem

pytestmark = pytest.mark.slow

LONGER = int(os.environ.get("JCR_TEST_FUZZ", "1"))
EVERY = 25 if LONGER == 1 else 1
"""One of so many exchanges of a value is tried."""
TOKENS = [
    b"NaN", b"-Infinity", b"1e999", b"1e-999", b"sNaN", b"1e99999999", b"9" * 5000, b"0x10", b"null", b"true", b"{}",
    b"[]", b"[[", b"}", b'"', b"'", b",", b":", b"\n", b"\t", b"- ", b"&a [*a]", b"*a", b"2001-99-99",
    b"!!python/name:os", b"? [x]\n: y", b"<<: 1", b"../", b"/etc/passwd", b"\0", b"\xff\xfe",
    b"\x1f\x8b", b"\xe2\x80\xa8", b"-1", b"0",
    b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"PK\x03\x04", b"\x93NUMPY\x03\x00",
]  # fmt: skip
bounded = settings(
    max_examples=60 * LONGER, derandomize=LONGER == 1, deadline=None, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
many = settings(bounded, max_examples=300 * LONGER)


@st.composite
def changes(draw: st.DrawFn) -> list[tuple[float, str, int, bytes]]:
    """Where in a file (a share of its length), what is done there, to how many bytes, and with which."""
    what = st.sampled_from(["replace", "insert", "delete", "repeat", "flip", "cut"])
    new = st.one_of(st.sampled_from(TOKENS), st.binary(min_size=1, max_size=8))
    where = st.floats(0, 1, exclude_max=True)
    return draw(st.lists(st.tuples(where, what, st.integers(1, 64), new), min_size=1, max_size=4))


def changed(data: bytes, edits: list[tuple[float, str, int, bytes]]) -> bytes:
    for share, what, length, new in edits:
        at = int(share * len(data))
        before, here, after = data[:at], data[at : at + length], data[at + length :]
        data = {
            "replace": before + new + data[at + len(new) :],
            "insert": before + new + data[at:],
            "delete": before + after,
            "repeat": before + here * 3 + after,
            "flip": before + bytes(byte ^ 1 << length % 8 for byte in here[:1]) + data[at + 1 :],
            "cut": before,
        }[what]
    return data


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return corpus(tmp_path_factory.mktemp("fuzz") / "targets")


def test_every_target_reads_as_it_is(targets: dict[str, Target]):
    for name, target in targets.items():
        valid = target.file.read_bytes()
        try:
            target.read(target.file)
        except InputError:
            assert name == "model.safetensors"  # of no network
        target.file.write_bytes(valid)  # a capture that is resumed is written again


def feed_changes(name: str, target: Target) -> None:
    valid = target.file.read_bytes()

    @bounded
    @given(changes())
    def feed(edits: list[tuple[float, str, int, bytes]]) -> None:
        try:
            target.feed(changed(valid, edits))
        except InputError as error:
            assert "\0" not in str(error), name

    try:
        feed()
    finally:
        target.file.write_bytes(valid)


@pytest.mark.long
def test_changed_bytes_are_read_or_refused(targets: dict[str, Target]):
    for name, target in targets.items():
        feed_changes(name, target)


@st.composite
def poses(draw: st.DrawFn) -> tuple[HandEyeProblem, bool]:
    """Poses of 2 to 14 images, degenerate, noisy, wrong or doubled as it comes; and whether their unit is true."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    robot = [size * draw(st.sampled_from([0, 1e-3, 0.3, 1, 5])) for size in (1e-3, np.radians(0.3))]
    camera = [size * draw(st.sampled_from([0, 0.3, 3])) for size in (1e-3, np.radians(0.1))]
    count = draw(st.integers(2, 14))
    pattern = draw(st.sampled_from(["varied", *get_args(Pattern)]))
    deviation = draw(st.sampled_from([0.0, 1e-6, 1e-3, 0.05, 0.3]))
    problem = hand_eye_problem(rng, count, pattern, (robot[0], robot[1]), (camera[0], camera[1]), deviation)
    gripper, cameras = problem.base_from_gripper.copy(), problem.recon_from_camera.copy()
    for wrong in rng.permutation(len(gripper))[: draw(st.integers(0, max(0, (count - 1) // 3)))]:
        rotation = rotation_exp(rng.normal(size=3) * draw(st.sampled_from([0, 0.05, 1])))
        off = rng.normal(size=3) * draw(st.sampled_from([0.005, 0.05, 0.5]))
        gripper[wrong] = gripper[wrong] @ transform(rotation, off)
    if draw(st.booleans()):
        gripper[0], cameras[0] = gripper[-1], cameras[-1]
    unit = draw(st.sampled_from([1.0, 1.0, 1e-9, 1e9]))
    cameras[:, :3, 3] *= unit
    return replace(problem, base_from_gripper=gripper, recon_from_camera=cameras), unit == 1.0


@pytest.mark.long
@settings(bounded, max_examples=60 * LONGER)
@given(poses())
def test_no_poses_make_the_solver_fail_or_trust_what_is_wrong(given_poses: tuple[HandEyeProblem, bool]):
    problem, unit_is_true = given_poses
    solved = jcr.solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    if solved.converged:
        off = error(problem, solved.gripper_from_camera, solved.scale)
        std = np.sqrt(np.diag(solved.covariance))
        known = slice(None) if unit_is_true else slice(6)
        assert (np.abs(off) <= 5 * std + 1e-7)[known].all(), off / std
    else:
        assert solved.warnings


TOO_LONG_S = 5.0
VALUES = {
    "null": None, "-1": -1, "0": 0, "1e309": float("inf"), "empty text": "", "list": [], "object": {},
    "text of 10⁶": "x" * 1_000_000,
}  # fmt: skip
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


def content_of(target: Target) -> Any:
    return STRUCTURES[target.file.suffix][0](target.file.read_text())


def tried(target: Target, place: Place, value: object) -> tuple[str, float]:
    """Return how reading ends: `read`, `refused`, or the exception that would be status 1; and the seconds."""
    valid, write = target.file.read_bytes(), STRUCTURES[target.file.suffix][1]
    data = write(exchanged(content_of(target), place, value)).encode()
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


@pytest.mark.long
def test_no_value_of_another_kind_makes_a_traceback_or_takes_long(targets: dict[str, Target]):
    cases = [
        (name, place, value)
        for name, target in targets.items()
        if target.file.suffix in STRUCTURES
        for place in places(content_of(target))
        for value in VALUES
    ]
    shuffled = np.random.default_rng(0).permutation(len(cases))[::EVERY]
    bad, ended = [], []
    for name, place, value in (cases[k] for k in shuffled):
        how, seconds = tried(targets[name], place, VALUES[value])
        ended.append(how)
        if how not in ("read", "refused") or seconds > TOO_LONG_S:
            bad.append(f"{name} {place} = {value}: {how} ({seconds:.1f} s)")
    assert not bad
    # Most values have a kind, and some may be anything: a fuzzer that is always refused tests nothing.
    assert 0.1 < ended.count("read") / len(ended) < 0.4


def test_a_reconstruction_of_other_numbers_is_refused_or_has_its_points(targets: dict[str, Target]):
    """The archive's check sums find no number that was changed before it was written."""
    with np.load(targets["reconstruction.npz"].file) as stored:
        arrays, ended = dict(stored), list[bool]()
    for name, array in ((name, array) for name, array in arrays.items() if array.dtype.kind in "if"):
        whole = array.astype(np.int64)
        for other in (
            array[:0], array[:-1], -array - 1, array * np.nan, array.astype(str), whole + 10**6, array[None],
        ):  # fmt: skip
            file = targets["reconstruction.npz"].file.with_name("other.npz")
            np.savez(file, allow_pickle=False, **arrays | {name: other})
            try:
                tracks = (found := read_reconstruction(file)).tracks
                assert found.recon_from_camera[tracks.image].shape[1:] == (4, 4)
                assert tracks.points_in_recon[tracks.point].shape[1:] == (3,)
                ended.append(True)
            except InputError:
                ended.append(False)
    assert len(ended) > 40 and np.mean(ended) < 0.5


FRAME = {"image": "0.png", "base_from_gripper": np.eye(4).tolist()}
MANY = {
    "missing images": (
        "capture.json",
        {"frames": [FRAME | {"image": f"images/{k}.png"} for k in range(30_000)]},
        "30000 frames; choose 5 to 15, 1000 at most",
    ),
    "this many images": (
        "capture.json",
        {"frames": [FRAME | {"image": f"l{k}.png"} for k in range(1001)]},
        "1001 frames; choose 5 to 15, 1000 at most",
    ),
    "samples": (
        "samples.yaml",
        [dict.fromkeys(("effector_wrt_world", "object_wrt_sensor"), np.eye(4).ravel().tolist())] * 1001,
        "1001 frames; choose 5 to 15, 1000 at most",
    ),
    "rows": (
        "poses.csv",
        "image,x,y,z,qx,qy,qz,qw\n" + "".join(f"{k}.png,0.5,0.1,0.4,0,0,0,1\n" for k in range(100_000)),
        "poses for 1002 images",
    ),
    "columns": (
        "poses.csv",
        ",".join(f"c{k}" for k in range(30_000)) + "\n" + ",".join("0" * 30_000),
        "no gripper poses for its 1002 images",
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
    with refused(words):
        read_source(tmp_path / name if what == "samples" else tmp_path)
    assert time.process_time() - start < TOO_LONG_S


@pytest.mark.parametrize(("name", "place", "value"), [
    ("resumed capture.json", ("frames", 3, "joints", 0), [[]]),
    ("resumed capture.json", ("frames", 3, "joints"), {"a": [{}]}),
    ("camera_info.yaml", ("distortion_model",), "plumb\0bob"),
    ("added/capture.json", ("added_to",), "a\0b"),
])  # fmt: skip
def test_what_values_found_stays_closed(targets: dict[str, Target], name: str, place: Place, value: object):
    assert tried(targets[name], place, value)[0] == "refused"


PIECES = [
    " ", ".", "..", "/", "\\", "'", '"', "<b>", "</script>", "&amp;", "{{x}}", "${x}", "**", "[a](b)", "²", "٣", "௧",
    "½", "⑦", "é", "e\u0301", "\u202e", "\u200b", "\u2028", "\x85", "\n", "\t", "\0", "%20", "%", "?", "#", ":", "*",
    "|", "~", "-", "--help", "CON", "end_header", "a" * 100, "🤖", "\ud800", "0", "10", "2",
]  # fmt: skip
NAMES = st.lists(st.one_of(st.sampled_from(PIECES), st.text(max_size=3)), min_size=1, max_size=6).map("".join)
"""Names of all of Unicode, with what paths, pages and terminals read in their own way."""
NUMBERS = [0, -1, 1, 3, 2**31, 2**63, 2**70, 0.0, -0.5, float("nan"), float("inf"), -1e300, True, None]
ANYTHING = st.one_of(
    st.sampled_from(
        [*NUMBERS, "", "2", b"", b"\xff\xd8\xff", [], [1], ["rgb8"], {}, {"a": []}, (), "x" * 1000]
    ),
    st.text(max_size=3),
    st.binary(max_size=8),
)


def read_or_refused(read: Callable[[], object]) -> bool:
    """Return whether something was read; fail if it takes long, or ends otherwise than by an InputError of one line."""
    start = time.process_time()
    try:
        read()
        ended = True
    except InputError as error:
        ended = False
        assert "\n" not in str(error) and "\0" not in str(error)
        assert len(str(error)) < 2000
    assert time.process_time() - start < TOO_LONG_S
    return ended


@pytest.mark.long
def test_names_lead_nowhere_else(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("names") / "inside"
    (folder / "images").mkdir(parents=True)
    found = []

    @many
    @given(NAMES)
    def feed(name: str) -> None:
        natural(name)

        def inside() -> None:
            path = path_inside(folder, name, "x")
            assert path.resolve().is_relative_to(folder.resolve()) and ".." not in path.parts
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"x")
            assert folder in path.parents and path.read_bytes() == b"x"
            path.unlink()

        try:
            found.append(read_or_refused(inside))
        except (IsADirectoryError, NotADirectoryError, FileExistsError):
            found.append(True)

    feed()
    assert not [one for one in folder.parent.iterdir() if one != folder]
    assert 0.3 < np.mean(found) < 0.98


@pytest.mark.long
@many
@given(st.lists(NAMES.filter(lambda name: name.isprintable() and "\\" not in name), max_size=4, unique=True))
def test_names_stay_themselves_on_pages_and_in_exports(names: list[str]):
    try:
        "".join(names).encode()
    except UnicodeEncodeError:
        return
    cards = [
        {"number": k, "name": name, "fault": "", "kind": "used", "state": "new"}
        for k, name in enumerate(names, 1)
    ]
    state = SimpleNamespace(is_over=True, names=names, images=names)
    content = {"state": state, "cards": cards, "has_report": False, "kind": "", "headline": "", "lines": []}
    html = render("images.html", content | {"tiles": []}, PACKAGE)
    assert [unquote(part.split('"')[0]) for part in html.split('src="image/')[1:]] == names
    assert "<b>" not in html and "</script>" not in html
    for suffix in (None, ".png"):
        files = _file_names([f"images/{name}" for name in names], suffix)
        assert len({file.casefold() for file in files}) == len(names) and "/" not in "".join(files)


MODES = [
    "1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "LAB", "HSV", "I", "F", "I;16", "I;16B",
]  # fmt: skip
FORMATS = [
    "PNG", "JPEG", "TIFF", "BMP", "WEBP", "GIF", "PPM", "TGA", "ICO", "EPS", "PDF", "PCX", "SGI", "JPEG2000",
]  # fmt: skip


@pytest.mark.long
@bounded
@given(
    st.sampled_from(MODES),
    st.sampled_from(FORMATS),
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(-1, 400),
)
def test_images_of_every_mode_and_format(mode: str, kind: str, width: int, height: int, cut: int):
    file = io.BytesIO()
    try:
        Image.new(mode, (width, height)).save(file, format=kind)
    except Exception:  # Pillow writes not every mode in every format
        return
    data = file.getvalue() if cut < 0 else file.getvalue()[:cut]
    pixels = []
    for read in (read_image, read_one_channel):
        if read_or_refused(lambda read=read: pixels.append(read(data, "image"))):
            assert pixels[-1].shape[:2] == (height, width)
    read_or_refused(lambda: read_ros_image(SimpleNamespace(format="jpeg", data=data)))
    read_or_refused(
        lambda: read_ros_depth(SimpleNamespace(format="16UC1; compressedDepth", data=b"12" + data))
    )


ENCODINGS = ["rgb8", "mono8", "bayer_rggb8", "yuv422", "16UC1", "32FC1", "8UC3", "bgra8"]
FIELDS = st.fixed_dictionaries(
    {},
    optional={
        **dict.fromkeys(("width", "height", "step", "is_bigendian"), st.one_of(st.integers(-2, 9), ANYTHING)),
        "encoding": st.one_of(st.sampled_from(ENCODINGS), ANYTHING),
        "data": st.one_of(st.binary(max_size=200), ANYTHING),
        "format": st.one_of(st.sampled_from(["jpeg", "png", "16UC1; compressedDepth"]), ANYTHING),
    },
)


@pytest.mark.long
@many
@given(FIELDS)
def test_fields_of_messages_are_of_any_type(fields: dict[str, Any]):
    usual = {"width": 2, "height": 2, "step": 6, "is_bigendian": 0, "encoding": "rgb8", "data": bytes(12)}
    for message in (SimpleNamespace(**usual | fields), SimpleNamespace(**fields)):
        for read in (read_ros_image, read_ros_depth, lambda one: image_of(one, "x")):
            read_or_refused(lambda read=read, message=message: read(message))
