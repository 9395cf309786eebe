"""Names, images, messages and tables of every kind: read as they are or refused with one line.

JCR_TEST_FUZZ=20 looks twenty times as long.
"""

import io
import os
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from jcr.capture.images import read_image, read_one_channel
from jcr.capture.pairing import natural
from jcr.capture.ros_messages import image_of, read_ros_depth, read_ros_image
from jcr.errors import InputError
from jcr.export.nerfstudio_colmap import _file_names
from jcr.files import path_inside
from jcr.live.page import PACKAGE
from jcr.report.render import render

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
@given(st.lists(NAMES.filter(lambda name: name.isprintable() and "\\" not in name), max_size=4, unique=True))
def test_names_stay_themselves_on_pages_and_in_exports(names: list[str]):
    try:
        "".join(names).encode()
    except UnicodeEncodeError:
        return
    cards = [{"number": k, "name": name, "fault": "", "state": "new"} for k, name in enumerate(names, 1)]
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
