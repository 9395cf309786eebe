"""Names, images, messages, tables and run folders of every kind: read as they are or refused with one line.

JCR_TEST_FUZZ=20 looks twenty times as long.
"""

import io
import json
import os
import struct
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import capture_writers as writers
from corpus import small_capture
from jcr.capture.formats.bag import _stamp
from jcr.capture.images import MAX_PIXELS, read_depth_images, read_image, read_one_channel
from jcr.capture.options import ReadOptions
from jcr.capture.pairing import natural
from jcr.capture.pose_track import TfTree
from jcr.capture.read import read_source
from jcr.capture.ros import image_of, read_ros_depth, read_ros_image
from jcr.errors import InputError
from jcr.export.views import _file_names
from jcr.files import path_inside
from jcr.live.page import PACKAGE
from jcr.records.npz import read_reconstruction
from jcr.report.render import render
from jcr.scene.cloud import read_cloud, write_cloud
from jcr.scene.map_file import load_map
from jcr.segments.segments import label_names_of
from scenes import cloud_of

pytestmark = [pytest.mark.slow, pytest.mark.long]

LONGER = int(os.environ.get("JCR_TEST_FUZZ", "1"))
TOO_LONG_S = 2.0
many = settings(
    max_examples=300 * LONGER,
    derandomize=LONGER == 1,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
few = settings(many, max_examples=60 * LONGER)

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


TRIED = Counter[str]()
"""Number of inputs that were read and refused, for the record."""


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
    TRIED["read" if ended else "refused"] += 1
    return ended


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


@many
@given(
    st.lists(
        NAMES.filter(lambda name: name.isprintable() and "\\" not in name),
        min_size=1,
        max_size=4,
        unique=True,
    )
)
def test_names_stay_themselves_on_pages_and_in_exports(names: list[str]):
    cards = [{"number": k, "name": name, "fault": "", "state": "new"} for k, name in enumerate(names, 1)]
    try:
        "".join(names).encode()
    except UnicodeEncodeError:
        return
    state = SimpleNamespace(is_over=True, names=names, images=names)
    content = {
        "state": state,
        "cards": cards,
        "has_report": False,
        "kind": "",
        "headline": "",
        "lines": [],
        "tiles": [],
    }
    html = render("images.html", content, PACKAGE)
    assert [unquote(part.split('"')[0]) for part in html.split('src="image/')[1:]] == names
    assert "<b>" not in html and "</script>" not in html
    images = [f"images/{name}" for name in names]
    for suffix in (None, ".png"):
        files = _file_names(images, suffix)
        assert len({file.casefold() for file in files}) == len(names) and not any(
            "/" in file for file in files
        )
    read_or_refused(lambda: label_names_of(images))


def test_labels_of_any_name_are_read_again(tmp_path: Path):
    @many
    @given(NAMES)
    def feed(name: str) -> None:
        line = " ".join(name.split())
        try:
            line.encode()
        except UnicodeEncodeError:
            return
        cloud = cloud_of(np.ones((3, 3)), label=np.ones(3, int), label_names=("none", line or "1"))
        write_cloud(tmp_path / "cloud.ply", cloud)
        assert read_cloud(tmp_path / "cloud.ply").label_names == cloud.label_names

    feed()


MODES = [
    "1",
    "L",
    "LA",
    "P",
    "PA",
    "RGB",
    "RGBA",
    "RGBX",
    "CMYK",
    "YCbCr",
    "LAB",
    "HSV",
    "I",
    "F",
    "I;16",
    "I;16B",
]
FORMATS = [
    "PNG",
    "JPEG",
    "TIFF",
    "BMP",
    "WEBP",
    "GIF",
    "PPM",
    "TGA",
    "ICO",
    "EPS",
    "PDF",
    "PCX",
    "SGI",
    "JPEG2000",
]


@few
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


SIDES = st.one_of(st.integers(0, 3), st.sampled_from([8000, 8001, 64_000, 100_000, 2**31 - 1]))


@few
@given(SIDES, SIDES, st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from([0, 2, 3, 4, 6]), st.booleans())
def test_images_of_every_size(
    tmp_path_factory: pytest.TempPathFactory,
    width: int,
    height: int,
    bits: int,
    colours: int,
    interlaced: bool,
):
    """Headers of all sizes, with the pixels of a small image."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, colours, 0, 0, interlaced)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"PLTE", bytes(6))
    data += chunk(b"IDAT", zlib.compress(bytes(200))) + chunk(b"IEND", b"")
    large = width * height > MAX_PIXELS
    for read in (read_image, read_one_channel):
        assert not (read_or_refused(lambda read=read: read(data, "image")) and large)
    file = tmp_path_factory.getbasetemp() / "size.png"
    file.write_bytes(data)
    read_or_refused(lambda: read_depth_images(file, (max(width, 1), max(height, 1))))
    raw = SimpleNamespace(
        width=width, height=height, step=width, encoding="mono8", data=bytes(9), is_bigendian=0
    )
    assert not (read_or_refused(lambda: image_of(raw, "x")) and large)


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


@many
@given(FIELDS)
def test_fields_of_messages_are_of_any_type(fields: dict[str, Any]):
    usual = {"width": 2, "height": 2, "step": 6, "is_bigendian": 0, "encoding": "rgb8", "data": bytes(12)}
    for message in (SimpleNamespace(**usual | fields), SimpleNamespace(**fields)):
        for read in (read_ros_image, read_ros_depth, lambda one: image_of(one, "x")):
            read_or_refused(lambda read=read, message=message: read(message))


@many
@given(ANYTHING, ANYTHING, ANYTHING, ANYTHING)
def test_stamps_and_transforms_are_of_any_type(sec: Any, nanosec: Any, frame: Any, number: Any):
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame)
    start = time.process_time()
    turned = SimpleNamespace(x=0.0, y=0.0, z=number, w=1.0)
    moved = SimpleNamespace(translation=turned, rotation=turned)
    tree = TfTree()
    for call in (
        lambda: _stamp(SimpleNamespace(header=header), 5),
        lambda: tree.add(
            [SimpleNamespace(header=header, child_frame_id="tool", transform=moved)], static=False
        ),
    ):
        # Errors of these kinds are stated by the reader of a bag as a message that is not the one of ROS.
        with suppress(AttributeError, TypeError, ValueError, OverflowError):
            call()
    stamps, numbers = next(iter(tree._samples.values()), ([], []))
    assert len(numbers) == 7 * len(stamps)
    assert time.process_time() - start < TOO_LONG_S


CELLS: dict[str, Callable[[int], list[Any]]] = {
    "null": lambda n: [None] * n,
    "one null": lambda n: [1.0] * (n - 1) + [None],
    "NaN": lambda n: [float("nan")] * n,
    "huge": lambda n: [1e300] * n,
    "large whole": lambda n: [2**62] * n,
    "negative": lambda n: [-1] * n,
    "text": lambda n: ["3"] * n,
    "bytes": lambda n: [b"\xff\xd8\xff"] * n,
    "truth": lambda n: [True] * n,
    "list": lambda n: [[1.0, 2.0]] * n,
    "ragged": lambda n: [[1.0] * (k % 2) for k in range(n)],
    "record": lambda n: [{"bytes": "text", "path": "../x"}] * n,
    "empty record": lambda n: [{"bytes": b"", "path": None}] * n,
    "record of damaged bytes": lambda n: [{"bytes": b"\x89PNG\r\n", "path": None}] * n,
    "the same": lambda n: [0] * n,
}


def test_columns_of_a_data_set_are_of_any_type(tmp_path: Path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    capture = small_capture(tmp_path / "images", (16, 12), 4)
    pixels = [read_image(capture.folder / name) for name in capture.images for _ in range(3)]
    states = np.repeat(writers.rows_as("rpy", capture.base_from_gripper), 3, axis=0)
    names, ended = ["x", "y", "z", "roll", "pitch", "yaw"], []
    for version, codec in (("v2.1", None), ("v3.0", None), ("v3.0", "mpeg4")):
        place = tmp_path / f"{version} {codec}"
        folder = writers.write_lerobot(
            place, [(pixels, states)], version, "observation.state", names, codec=codec
        )
        for file in sorted(folder.rglob("*.parquet")):
            whole, table = file.read_bytes(), pq.read_table(file, partitioning=None)
            for k, column in enumerate(table.column_names):
                for kind, cells in CELLS.items():
                    try:
                        changed = table.set_column(k, column, pa.array(cells(len(table))))
                    except pa.ArrowException:
                        continue
                    pq.write_table(changed, file)
                    into = tmp_path / f"into {len(ended)}"
                    read = partial(read_source, folder, ReadOptions(frames=3), into=into)
                    try:
                        ended.append(read_or_refused(read))
                    except Exception as error:
                        raise AssertionError(f"{version} {file.name}: {column} of {kind}") from error
            file.write_bytes(whole)
    assert len(ended) > 200 and 0.02 < np.mean(ended) < 0.6


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from corpus import corpus

    return next(
        one.file.parent
        for name, one in corpus(tmp_path_factory.mktemp("corpus") / "all").items()
        if name == "map.safetensors"
    )


VALUES: list[Any] = [0, -1, 10, 1e9, float("nan"), float("inf"), 255, 2**40]


def places(content: Any, place: tuple = ()) -> list[tuple]:
    inner = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    return [place, *(deeper for key, value in inner for deeper in places(value, (*place, key)))]


def test_maps_that_answer_are_maps(results: Path, tmp_path: Path):
    """Values of the header and of the tensors are exchanged, and the file gets the digest of its content."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    from jcr.scene.scene_map import digest

    with safe_open(results / "map.safetensors", "pt") as stored:
        metadata, tensors = dict(stored.metadata()), {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    about, file, ended = json.loads(metadata["about"]), tmp_path / "map.safetensors", []

    def answers(text: str, of: dict[str, Any]) -> None:
        save_file(of, file, metadata=metadata | {"about": text, "digest": digest(of, text)})

        def ask() -> None:
            scene = load_map(file)
            x = np.random.default_rng(0).uniform(-1, 2, (50, 3))
            scene.check_spheres(x, 0.05)
            at = scene.query(x, "occupied")
            assert np.isfinite(at.occupancy).all() and np.isfinite(at.color[~at.unknown]).all()
            assert at.label.max() < len(scene.label_names)

        ended.append(read_or_refused(ask))

    answers(metadata["about"], tensors)
    assert ended == [True]
    for place in places(about)[1:]:
        for value in (*VALUES, None, "", [], {}, "x"):
            changed = json.loads(metadata["about"])
            at = changed
            for key in place[:-1]:
                at = at[key]
            at[place[-1]] = value
            answers(json.dumps(changed), tensors)
    for name, tensor in tensors.items():
        for value in VALUES:
            try:
                answers(metadata["about"], tensors | {name: tensor.clone().fill_(value)})
            except (RuntimeError, OverflowError) as error:
                assert "value cannot be converted" in str(error) or "overflow" in str(error)
        for other in (tensor[:0].clone(), tensor.reshape(-1).clone(), tensor.double(), tensor[None].clone()):
            answers(metadata["about"], tensors | {name: other})
        answers(metadata["about"], {key: one for key, one in tensors.items() if key != name})
    assert len(ended) > 300 and np.mean(ended) < 0.5


def test_reconstructions_and_clouds_of_other_numbers(results: Path, tmp_path: Path):
    with np.load(results / "reconstruction.npz") as stored:
        arrays = dict(stored)
    ended = []
    for name, array in arrays.items():
        for change in (
            lambda a: a[:0], lambda a: a[:-1], lambda a: -a - 1, lambda a: a * np.nan, lambda a: a.astype(str),
            lambda a: a.astype(np.int64) + 10**6, lambda a: a[None], np.zeros_like, lambda a: a.astype(bool),
        ):  # fmt: skip
            try:
                with np.errstate(all="ignore"):
                    other = change(array)
            except (TypeError, ValueError, IndexError):
                continue
            np.savez(tmp_path / "r.npz", allow_pickle=False, **arrays | {name: other})

            def use() -> None:
                found = read_reconstruction(tmp_path / "r.npz")
                assert found.recon_from_camera[found.tracks.image].shape[1:] == (4, 4)
                assert found.tracks.points_in_recon[found.tracks.point].shape[1:] == (3,)

            ended.append(read_or_refused(use))
    assert len(ended) > 40 and np.mean(ended) < 0.5
    data = (results / "cloud.ply").read_bytes()
    header, mark, body = data.partition(b"end_header\n")
    draw = np.random.default_rng(0)
    for _ in range(300 * LONGER):
        changed = bytearray(body)
        for at in draw.integers(0, len(body), draw.integers(1, 4)):
            changed[at] = draw.integers(0, 256)
        cut = draw.integers(0, len(body)) if draw.random() < 0.3 else len(body)
        (tmp_path / "cloud.ply").write_bytes(header + mark + bytes(changed[:cut]))

        def use() -> None:
            cloud = read_cloud(tmp_path / "cloud.ply")
            assert len(cloud.image) == 200 and [cloud.label_names[k] for k in cloud.label]
            assert cloud.camera_centers_in_base[cloud.image].shape == (200, 3)

        read_or_refused(use)


@pytest.fixture(scope="module", autouse=True)
def counted() -> Iterator[None]:
    """Say how many inputs were tried (pytest -s shows it)."""
    yield
    sys.stderr.write(f"\n{TRIED['read']} inputs read, {TRIED['refused']} refused\n")
