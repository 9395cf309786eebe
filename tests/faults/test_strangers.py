"""Files of strangers: what each promise of SECURITY.md refuses, by inputs that once broke it."""

import json
import math
import os
import shutil
import sqlite3
import struct
import subprocess
import sys
import time
import urllib.request
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import capture_writers as writers
import jcr
from corpus import small_capture as noise_capture
from jcr.capture.documents import Table
from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png, read_image
from jcr.capture.options import ReadOptions
from jcr.capture.pairing import natural, pair
from jcr.capture.read import read_source
from jcr.capture.ros_messages import read_ros_depth, read_ros_image
from jcr.cli import dispatch
from jcr.errors import InputError, shown
from jcr.geometry import Similarity, transform
from jcr.records import Intrinsics, Reading, Tracks
from jcr.records.reconstruction_npz import read_reconstruction
from jcr.scene.cloud import read_cloud, write_cloud
from jcr.segments.segmentation import read_labels
from jcr.sfm.given import reconstruct_given
from places import contents
from refusal import refused
from scenes import NO_TRACKS, capture_of, cloud_of, hand_eye_of, maps_of, reconstruction_of
from scripted_capture import a_capture, still_frames
from simulation.problems import hand_eye_problem

SIZE = (96, 72)
CAMERA = Intrinsics(90.0, 90.0, 47.5, 35.5, *SIZE)
HUGE = (10_000, 10_000)
"""Size of an image of 100 million pixels, which Pillow's own limit lets pass; as grey PNG of zeros it has 0.1 MB."""


def png_of_zeros(width: int, height: int, bits: int) -> bytes:
    """Return a grey PNG that is whole, whose zeros pack 1000 to 1."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    line = b"\0" * (1 + width * bits // 8)
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(line) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


# Names of files in files


def table_capture(folder: Path, named: Callable[[str], str]) -> Path:
    """Write images and a poses.csv whose image names are changed."""
    capture = noise_capture(folder.with_name("images of " + folder.name), SIZE, 5, "")
    writers.write_table(folder, capture)
    file = folder / "poses.csv"
    header, *rows = file.read_text().splitlines()
    file.write_text(
        "\n".join([header, *(f"{named(name)},{row}" for name, _, row in (r.partition(",") for r in rows))])
    )
    return folder


def test_no_name_in_a_file_is_written_outside_of_the_run_folder(tmp_path, capsys):
    """The names lead out of the capture and back in, and out of the run folder for good."""
    capture = table_capture(tmp_path / "in/cap", lambda name: f"../../in/cap/{name}")
    (tmp_path / "results/deep").mkdir(parents=True)
    before = contents(tmp_path)
    made = tmp_path / "results/deep/out"
    # The images are found by their last names inside the capture, and noise is rejected.
    assert dispatch(["calibrate", str(capture), str(made), "--backend", "colmap", "--quiet"]) == 3
    capsys.readouterr()
    after = contents(tmp_path)
    assert {file: after[file] for file in after if not file.startswith("results/deep/out/")} == before
    assert not list(tmp_path.glob("results/*/in"))


def test_a_link_of_the_user_to_the_folder_of_the_images_is_followed(tmp_path: Path):
    capture = noise_capture(tmp_path / "capture", SIZE, 5).folder
    (capture / "images").rename(tmp_path / "elsewhere")
    (capture / "images").symlink_to(tmp_path / "elsewhere")
    read = jcr.read_capture(capture)
    assert len(read) == 5 and not read.notes
    (tmp_path / "link").symlink_to(capture)
    assert len(jcr.read_capture(tmp_path / "link")) == 5


def test_a_link_to_poses_elsewhere_is_refused_and_no_linked_folder_is_searched(tmp_path: Path):
    capture = table_capture(tmp_path / "cap", str)
    for k in range(40):
        (capture / f"here{k}").symlink_to(".")
    (capture / "all").symlink_to("/")
    (capture / "log").mkdir()
    (capture / "log/deep").symlink_to(tmp_path)
    read = jcr.read_capture(capture)
    assert len(read) == 5 and "linked folders are left out: all, here0, here1" in "".join(read.notes)
    for link in capture.glob("[ah]*"):
        link.unlink()
    assert "linked folders are left out: log/deep;" in "".join(jcr.read_capture(capture).notes)
    (capture / "poses.csv").rename(tmp_path / "private")
    (capture / "poses.csv").symlink_to(tmp_path / "private")
    with refused("leads out of"):
        jcr.read_capture(capture)
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked/rgb").symlink_to(capture)
    with refused("holds no images .*; linked folders are left out: rgb: copy them"):
        jcr.read_capture(tmp_path / "linked")


def test_numbers_of_any_length_are_names(tmp_path: Path):
    capture = table_capture(tmp_path / "cap", str)
    table = Table(
        file=capture, columns=("x",), rows=((1.0,),) * 5, keys=tuple(f"{k}" * 5000 for k in range(5)),
        words="",
    )  # fmt: skip
    assert not pair(table, [f"{k}.png" for k in range(5)]).is_by_name


def test_a_run_folder_with_links_is_not_written_through(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    capture = table_capture(tmp_path / "cap", str)
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim/.lock").write_text("precious")
    for name, target in (("capture", tmp_path / "victim"), (".lock", tmp_path / "victim/.lock")):
        out = tmp_path / f"out of {name[-4:]}"
        out.mkdir()
        (out / name).symlink_to(target)
        assert dispatch(["calibrate", str(capture), str(out), "--quiet"]) == 2
        assert capsys.readouterr().err.startswith("error: ")
    assert contents(tmp_path / "victim") == {".lock": b"precious"}
    (tmp_path / "pipe").mkdir()
    os.mkfifo(tmp_path / "pipe/.lock")
    assert dispatch(["calibrate", str(capture), str(tmp_path / "pipe"), "--quiet"]) == 2
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["0²0", "½", "٣", "௧", "a" * 60 + "⑦"])
def test_digits_of_other_scripts_are_names(name: str):
    assert natural(f"{name}.png")


def test_devices_and_ports_are_decimal_numbers():
    from jcr.live.cameras import open_camera
    from jcr.live.robot import states_of

    with refused("no such video file"), open_camera("²"):
        pass
    for port in ("²", "9" * 5000):
        with refused("no address"):
            states_of(f"ur:host:{port}")


# Messages


def test_messages_quote_80_characters_without_building_the_rest():
    """A text of 10 to the power of 40 letters would never be built; one of itself has no end."""
    deep: Any = ["lol"]
    for _ in range(40):
        deep = [deep] * 10
    itself: dict[str, Any] = {}
    itself["me"] = [itself]
    start = time.process_time()
    for value in (deep, itself, "x" * 10**8, 10**1000, [10**1000], {"k": "v" * 200}):
        assert len(shown(value)) <= 81
    assert time.process_time() - start < 1
    small = {"a": [1, (2.5, None), "é"], b"b": {}}
    assert shown(small) == repr(small)


# Images


MEASURED = """
import resource, sys
from pathlib import Path
from types import SimpleNamespace
sys.path[:0] = {paths}
import numpy as np
import jcr
from jcr.capture.images import read_depth_images, read_image
from jcr.capture.ros_messages import image_of, read_ros_image
from jcr.segments.segmentation import read_labels
from scenes import capture_of, maps_of, reconstruction_of
folder = Path({folder!r})
images, poses = ("0.png", "1.png", "2.png"), np.stack([np.eye(4)] * 3)
capture = capture_of(poses, folder=folder, images=images, image_size=(96, 72))
camera = jcr.Intrinsics(90.0, 90.0, 47.5, 35.5, 96, 72)
made = reconstruction_of(poses, intrinsics=camera, pointmaps=maps_of(np.zeros((3, 72, 96, 3)), camera))
image = SimpleNamespace(format="png", data=(folder / "image.png").read_bytes())
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before = peak()
for read in (
    lambda: read_depth_images(folder / "depth.png", {size}), lambda: read_labels(capture, made),
    lambda: read_ros_image(image), lambda: read_image(image_of(image, "x")[0], "x"),
):
    try:
        read()
        print("read", end=" ")
    except jcr.InputError as error:
        print("refused", end=" ")
print(round(peak() - before))
"""
"""Reads a depth, a label and two images, and prints how each ended and by how much the peak memory grew (MB)."""


@pytest.mark.slow
def test_large_images_are_refused_before_they_are_unpacked(tmp_path: Path):
    """Less than a megabyte each as a file, 0.2 to 0.3 GB unpacked."""
    noise_capture(tmp_path, SIZE, 3, "labels/")
    large = png_of_zeros(*HUGE, 16)
    for name in ("depth", *(f"labels/{k}" for k in range(3))):
        (tmp_path / f"{name}.png").write_bytes(large)
    (tmp_path / "image.png").write_bytes(png_of_zeros(*HUGE, 8))
    program = MEASURED.format(paths=sys.path, folder=str(tmp_path), size=HUGE)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    *ended, grown = done.stdout.split()
    assert ended == 4 * ["refused"] and int(grown) < 150


def test_a_file_that_starts_a_program_is_no_image(tmp_path: Path):
    """Pillow reads PostScript by Ghostscript, whatever the file is called."""
    file = tmp_path / "0.png"
    Image.new("RGB", SIZE).save(file, format="EPS")
    with refused("not a readable image"):
        read_image(file)


def tiff_of_tiles(image: tuple[int, int], tile: tuple[int, int], data: bytes) -> bytes:
    """Return a grey TIFF whose tiles, of any size, are packed by Deflate."""
    shape = (256, image[0]), (257, image[1]), (258, 8), (259, 8), (262, 1), (277, 1)
    entries = [*shape, (322, tile[0]), (323, tile[1]), (324, 8), (325, len(data))]
    listed = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    start = b"II*\0" + struct.pack("<I", 8 + len(data)) + data
    return start + struct.pack("<H", len(entries)) + listed + bytes(4)


def test_a_small_image_in_a_large_tile_is_refused(tmp_path: Path):
    file = tmp_path / "a.tif"
    file.write_bytes(tiff_of_tiles(SIZE, (112, 80), zlib.compress(bytes(112 * 80))))
    assert read_image(file).shape == (72, 96, 3)
    file.write_bytes(tiff_of_tiles(SIZE, HUGE, zlib.compress(bytes(1000))))
    with refused("over 64 million pixels"):
        read_image(file)


def test_a_jpeg_of_many_scans_is_refused(tmp_path: Path):
    """Each of the scans decodes all pixels again: 12 MB took 12 s."""
    file = tmp_path / "0.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    Image.fromarray(noise).save(file, progressive=True)
    assert read_image(file).shape == (480, 640, 3)
    data = file.read_bytes()
    last = data[data.rfind(b"\xff\xda") : -2]
    file.write_bytes(data[:-2] + 200 * last[:500] + b"\xff\xd9")
    with refused("a JPEG of 2[01][0-9] scans"):
        read_image(file)


def ros_image(height: int, width: int, encoding: str, data: bytes | None = None, /, **facts: Any) -> Any:
    channels = {"rgb8": 3, "rgba8": 4, "16UC1": 2, "32FC1": 4, "yuv422": 2}.get(encoding, 1)
    data = bytes(height * width * channels) if data is None else data
    usual = {"step": width * channels, "is_bigendian": 0}
    return SimpleNamespace(
        **{"height": height, "width": width, "encoding": encoding, "data": data} | usual | facts
    )


def compressed(data: bytes, kind: str = "jpeg") -> Any:
    return SimpleNamespace(format=kind, data=data)


WRONG_MESSAGES: dict[str, tuple[Any, Callable[[Any], object]]] = {
    "no pixels": (ros_image(0, 0, "mono8"), read_ros_image),
    "no rows": (ros_image(0, 4, "rgba8"), read_ros_image),
    "odd width of two pixels each": (ros_image(3, 5, "yuv422"), read_ros_image),
    "negative size": (ros_image(-4, -4, "rgb8", b"\0" * 48), read_ros_image),
    "size in words": (ros_image(2, 2, "rgb8", width="2"), read_ros_image),
    "data of numbers": (ros_image(2, 2, "rgb8", data=None, step=None), read_ros_image),
    "encoding that is a list": (ros_image(2, 2, "rgb8", b"\0" * 12, encoding=["rgb8"]), read_ros_image),
    "a JPEG of three bytes": (compressed(b"\xff\xd8\xff"), read_ros_image),
    "a JPEG that is cut": (
        compressed(cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()[:200]),
        read_ros_image,
    ),
    "empty depth": (ros_image(0, 0, "16UC1"), read_ros_depth),
    "depth without data": (compressed(b"", "16UC1; compressedDepth"), read_ros_depth),
    "depth that is cut": (compressed(b"\x89PNG\r\n", "16UC1; compressedDepth"), read_ros_depth),
    "depth in colours": (compressed(encode_png(np.zeros((4, 4, 3), np.uint8)), "16UC1"), read_ros_depth),
}


@pytest.mark.parametrize("what", WRONG_MESSAGES)
def test_images_in_messages_are_read_or_refused(what: str):
    message, read = WRONG_MESSAGES[what]
    with refused("^(image|depth): "):
        read(message)


def test_images_of_a_bag_that_cannot_be_read_are_left_out_with_their_reason(tmp_path: Path):
    """Three images of each stop are damaged, as by a camera that is switched on."""
    from jcr.capture.frame_extraction import Recording, capture_of_recording

    poses = np.repeat(hand_eye_problem(np.random.default_rng(0), 6).base_from_gripper, 5, axis=0)
    draw = np.random.default_rng(1)
    good = [encode_png(draw.integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)) for _ in range(30)]
    damaged = {row: good[row][:300] for row in range(30) if row % 5 in (1, 2)}
    recording = Recording(
        source=tmp_path / "scan.bag", options=ReadOptions(frames=6), names=[str(k) for k in range(30)],
        base_from_gripper=poses, speed=np.zeros(30) + np.where(np.arange(30) % 5 == 0, 1.0, 0.0),
        gap_ns=np.zeros(30, np.int64),
        images_of_rows=lambda rows: ((row, damaged.get(row, good[row]), ".png") for row in rows.tolist()),
    )  # fmt: skip
    capture = capture_of_recording(recording, tmp_path / "into", lambda *_: None)
    assert len(capture) == 6 and not {int(Path(name).stem) for name in capture.images} & damaged.keys()
    (note,) = [note for note in capture.notes if "cannot be read" in note]
    assert note.startswith("left out: ") and "not a readable image" in note
    everything = replace(
        recording, images_of_rows=lambda rows: ((row, b"\xff\xd8\xff", ".jpg") for row in rows.tolist())
    )
    with refused("not a readable image"):
        capture_of_recording(everything, tmp_path / "nothing", lambda *_: None)


# Data sets


@pytest.mark.slow
@pytest.mark.parametrize("what", ["a state of zeros", "too many frames"])
def test_a_data_set_unpacks_to_no_more_than_a_few_times_its_size(tmp_path, monkeypatch, what: str):
    """Whole: 0.1 MB of zeros took 7.6 GB, and three million frames in 0.8 MB 3.4 GB and 41 s."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    capture = noise_capture(tmp_path / "images", SIZE, 5)
    pixels = [read_image(capture.folder / name) for name in capture.images]
    states = writers.rows_as("rpy", capture.base_from_gripper)
    names = ["x", "y", "z", "roll", "pitch", "yaw"]
    folder = writers.write_lerobot(
        tmp_path / "set", [(pixels, states)], "v2.1", "observation.state", names, codec=None
    )
    if what == "too many frames":
        monkeypatch.setattr("jcr.capture.formats.lerobot.MOST_FRAMES", 4)
    else:
        monkeypatch.setattr("jcr.capture.formats.lerobot.USUAL_BYTES", 10**6)
        (file,) = (folder / "data").rglob("*.parquet")
        table = pq.ParquetFile(file).read()
        zeros = pa.array([[0.0] * 10**5] * 5)
        place = table.column_names.index("observation.state")
        pq.write_table(table.set_column(place, "observation.state", zeros), file, compression="zstd")
    with refused("over 4 frames in episode 0|unpacks to 0.0 GB"):
        read_source(folder, ReadOptions(frames=3), into=tmp_path / "into")


# Images are told apart by their paths


def test_two_images_share_no_label_image(tmp_path: Path):
    images = ("left/1.png", "right/1.png", "images/2.png")
    (tmp_path / "labels/left").mkdir(parents=True)
    (tmp_path / "labels/right").mkdir(parents=True)
    for value, name in enumerate(("left/1", "right/1", "2"), start=1):
        cv2.imwrite(str(tmp_path / f"labels/{name}.png"), np.full(SIZE[::-1], value, np.uint8))
    poses = np.stack([np.eye(4)] * 3)
    made = reconstruction_of(
        poses, intrinsics=CAMERA, pointmaps=maps_of(np.zeros((3, *SIZE[::-1], 3)), CAMERA)
    )
    capture = capture_of(poses, folder=tmp_path, images=images, image_size=SIZE)
    labels = read_labels(capture, made)
    assert labels is not None and [np.unique(label).tolist() for label in labels[0]] == [[1], [2], [3]]
    with refused("share one label image"):
        read_labels(replace(capture, images=("images/1.jpg", "images/1.png", "2.png")), made)


@pytest.mark.parametrize("undistort", [False, True])
def test_two_images_are_exported_to_two_files(tmp_path: Path, undistort: bool):
    from jcr.export.nerfstudio_colmap import PosedImages, write_nerfstudio
    from jcr.export.options import ExportOptions

    images = ("1.jpg", "1.png", "1.PNG")
    for k, name in enumerate(images):
        Image.new("RGB", SIZE, (80 * k, 0, 0)).save(tmp_path / name)
    poses = np.stack([transform(np.eye(3), np.array([k, 0.0, 0.0])) for k in range(3)])
    views = PosedImages(
        folder=tmp_path, images=images, base_from_camera=poses, base_from_gripper=poses, intrinsics=CAMERA,
        tracks=NO_TRACKS, points_in_base=np.zeros((0, 3)), base_from_recon=Similarity(np.eye(4), 1.0),
    )  # fmt: skip
    write_nerfstudio(
        tmp_path / "out", views, cloud_of(np.zeros((1, 3))), {}, ExportOptions(undistort=undistort)
    )
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    files = [frame["file_path"] for frame in frames]
    assert len({file.casefold() for file in files}) == 3
    for k, frame in enumerate(frames):
        assert frame["transform_matrix"][0][3] == k
        assert abs(int(read_image(tmp_path / "out" / frame["file_path"])[0, 0, 0]) - 80 * k) < 4


@pytest.mark.parametrize(("images", "names", "words"), [
    ("left/1.png left/2.png left/3.png right/1.png", "1.png 2.png 3.png", "1.png could be"),
    ("1.png 2.png 3.png", "a/1.png b/1.png 2.png 3.png", "may both be 1.png"),
])  # fmt: skip
def test_an_image_of_a_model_is_one_of_the_capture(tmp_path: Path, images: str, names: str, words: str):
    import pycolmap

    from jcr.sfm.model import colmap_camera

    model, camera = pycolmap.Reconstruction(), colmap_camera(CAMERA, known=True)
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for k, name in enumerate(names.split(), start=1):
        pose = pycolmap.Rigid3d(np.c_[np.eye(3), [0.1 * k, 0.0, 0.0]])
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=k), pose)
    model.write_binary(str(tmp_path))
    poses, own = np.stack([np.eye(4)] * len(images.split())), tuple(images.split())
    with refused(words):
        reconstruct_given(capture_of(poses, folder=tmp_path, images=own, image_size=SIZE), tmp_path)


# Dense depth


def test_an_added_image_that_sees_no_point_is_named(tmp_path: Path):
    from jcr.depth.added_images import extend
    from jcr.depth.densify import densify, sweep_planes
    from scenes import no_depth

    capture = noise_capture(tmp_path / "capture", SIZE, 3)
    cameras = np.stack([transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(3)])
    draw = np.random.default_rng(0)
    points = draw.uniform([-0.3, -0.2, 1.0], [0.3, 0.2, 1.2], (40, 3))
    rows = np.repeat(np.arange(3), 40)
    tracks = Tracks(
        image=rows, x_px=np.ones((120, 2)), point=np.tile(np.arange(40), 3), points_in_recon=points
    )
    shape = 3, *SIZE[::-1]
    maps = maps_of(np.ones((*shape, 3)), CAMERA, **no_depth(shape))
    made = reconstruction_of(cameras, intrinsics=CAMERA, tracks=tracks, pointmaps=maps)
    away = np.diag([1.0, -1.0, -1.0, 1.0])[None]  # the camera looks the other way
    added = replace(capture.of_rows([0]), base_from_gripper=away)
    with refused(r"0\.png: sees no point"):
        extend(made, np.eye(4), hand_eye_of(np.eye(4)).base_from_recon, 3, added, lambda *_: None)
    # A file may list an image without any track, and points behind a camera.
    two = tracks.only(rows < 2)
    assert np.isfinite(sweep_planes(two, cameras)).all()
    assert np.isfinite(sweep_planes(replace(two, points_in_recon=-points), cameras)).all()
    assert len(densify(capture, replace(made, tracks=two, pointmaps=None)).dense.confidence) == 3


# Files of a run folder


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from jcr.scene.build import build_scene
    from jcr.scene.options import MapOptions

    draw = np.random.default_rng(3)
    cloud = cloud_of(draw.random((400, 3)), label=np.ones(400, int), label_names=("none", "cup"))
    file = tmp_path_factory.mktemp("map") / "map.safetensors"
    build_scene(cloud, MapOptions(cell=0.2, max_seconds=0.1)).save(file)
    return file


def changed_map(
    source: Path, file: Path, change: Callable[[dict[str, Any], dict[str, Any]], object], seals: bool
) -> None:
    """Write a map with other content; with `seals`, as its writer would, with the digest of the new content."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    from jcr.scene.scene_map import digest

    with safe_open(source, "pt") as stored:
        metadata = dict(stored.metadata())
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    about = json.loads(metadata["about"])
    change(about, tensors)
    metadata["about"] = json.dumps(about)
    if seals:
        metadata["digest"] = digest(tensors, metadata["about"])
    save_file(tensors, file, metadata=metadata)


def finer(cell: float, shape: Any) -> list[Any]:
    """Return a lattice that spans the workspace with ten nodes a cell."""
    return [cell / 10, [10 * count + 1 for count in shape]]


MAP_CHANGES: dict[str, Callable[[dict[str, Any], dict[str, Any]], object]] = {
    "cells ten times as large": lambda about, _: about.update(cell=10 * about["cell"]),
    "cells of NaN": lambda about, _: about.update(cell=math.nan),
    "cells of a negative side": lambda about, _: about.update(cell=-about["cell"]),
    "cells of 0": lambda about, _: about.update(cell=0),
    "a lattice of another spacing": lambda about, _: about["lattices"][1].__setitem__(0, 7.0),
    "a name too many": lambda about, _: about["label_names"].append("mug"),
    "names that are numbers": lambda about, _: about.update(label_names=[1, 2]),
    "a corner at infinity": lambda _, tensors: tensors["lower"].fill_(math.inf),
    "states of no meaning": lambda _, tensors: tensors["seen"].fill_(255),
    "a network of NaN": lambda _, tensors: tensors["fields.of.0.hidden.bias"].fill_(math.nan),
    "nodes 1000 times as many as cells": lambda about, tensors: about["lattices"].__setitem__(
        0, finer(about["cell"], tensors["seen"].shape)
    ),
    "a thousand networks": lambda about, _: about.update(networks=about["networks"][:1] * 1000),
    "no seen space": lambda _, tensors: tensors.update(seen=tensors["seen"][:0]),
    "nodes that are not there": lambda _, tensors: tensors["fields.lattices.0.nodes"].fill_(10**9),
}


@pytest.mark.slow
def test_a_map_that_was_changed_answers_nothing(tmp_path: Path, map_file: Path):
    file = tmp_path / "map.safetensors"
    changed_map(map_file, file, lambda *_: None, seals=True)
    assert jcr.load_map(file).check_spheres(np.zeros((1, 3)), 0.01).shape == (1,)
    cases = [(what, True) for what in MAP_CHANGES] + [("cells of NaN", False), ("no seen space", False)]
    for what, seals in cases:
        changed_map(map_file, file, MAP_CHANGES[what], seals)
        with refused(r"map\.safetensors: the map file is damaged"):
            jcr.load_map(file)
            pytest.fail(what)


def cloud_file(folder: Path, **facts: Any) -> Path:
    draw = np.random.default_rng(0)
    usual = {"label": np.arange(100) % 2, "label_names": ("none", "cup")}
    write_cloud(folder / "cloud.ply", cloud_of(draw.random((100, 3)), **(usual | facts)))
    return folder / "cloud.ply"


def cell_of(name: str, value: int) -> Callable[[bytes], bytes]:
    """Return a change of the last point's property of a cloud."""

    def change(data: bytes) -> bytes:
        header, mark, body = data.partition(b"end_header\n")
        lines = [line.split() for line in header.decode().splitlines() if line.startswith("property")]
        kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
        points = np.frombuffer(body, [(line[2], kinds[line[1]]) for line in lines]).copy()
        points[name][-1] = value
        return header + mark + points.tobytes()

    return change


CLOUD_CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "label 999": cell_of("label", 999),
    "label -1": cell_of("label", -1),
    "image 77": cell_of("image", 77),
    "no point": lambda data: data.partition(b"end_header\n")[0] + b"end_header\n",
    "a quarter": lambda data: data[: -75 * ((len(data) - data.index(b"end_header\n") - 11) // 100)],
    "another byte order": lambda data: data.replace(b"little", b"big"),
    "axes in another order": lambda data: data.replace(
        b"float x\nproperty float y", b"float y\nproperty float x"
    ),
    "a camera that is not counted": lambda data: data.replace(b"comment camera 0", b"comment camera 1"),
    "many cameras": lambda data: data.replace(
        b"element", b"".join(b"comment camera %d 0 0 0\n" % k for k in range(1, 10**5)) + b"element", 1
    ),
    "margins below 0": cell_of("margin", -1),
    "points twice": lambda data: data + data.partition(b"end_header\n")[2],
}


@pytest.mark.parametrize("what", CLOUD_CHANGES)
def test_a_cloud_that_was_changed_is_refused(tmp_path: Path, what: str):
    file = cloud_file(tmp_path)
    assert len(read_cloud(file).label) == 100
    file.write_bytes(CLOUD_CHANGES[what](file.read_bytes()))
    with refused(r"cloud\.ply: "):
        read_cloud(file)


@pytest.mark.parametrize(
    "name", ["end_header", "element vertex 3", "property int image", "format ascii 1.0", " "]
)
def test_a_label_may_be_called_as_a_line_of_the_header(tmp_path: Path, name: str):
    names = ("none", name if name.strip() else "two words")
    assert read_cloud(cloud_file(tmp_path, label_names=names)).label_names == names


def test_depth_of_a_run_folder_is_checked(tmp_path: Path):
    from jcr.depth.densify import pointmaps_of
    from jcr.depth.depth_npz import read_depth, write_depth

    shape = 2, *SIZE[::-1]
    made = reconstruction_of(np.stack([np.eye(4)] * 2), intrinsics=CAMERA)
    layers = [np.full(shape, 0.01, np.float16), np.ones(shape, np.float16), np.ones(shape, np.uint8)]
    colors = np.zeros((*shape, 3), np.uint8)
    dense = pointmaps_of(np.ones(shape, np.float32), *layers, colors, made.recon_from_camera, CAMERA)
    write_depth(tmp_path / "depth.npz", replace(made, pointmaps=dense))
    with np.load(tmp_path / "depth.npz") as file:
        arrays = dict(file)
    for name, value in (("confidence", -1.0), ("relative_std", -1.0), ("depth", -1.0)):
        np.savez(tmp_path / "depth.npz", **arrays | {name: np.full_like(arrays[name], value)})
        with refused(r"depth\.npz: damaged"):
            read_depth(tmp_path / "depth.npz", made, None)


def test_a_reconstruction_is_not_compressed(tmp_path: Path):
    """Zeros pack 1000 to 1; jcr writes without compression."""
    about = np.array(json.dumps({"format": "jcr.reconstruction/9"}))
    np.savez_compressed(tmp_path / "reconstruction.npz", about=about)
    with refused("compressed"):
        read_reconstruction(tmp_path / "reconstruction.npz")


@pytest.mark.parametrize(
    "reading", [{"notation": "zz"}, {"notation": "euler:abc"}, {"units": "m"}, {"columns": "c" * 2000}]
)
def test_a_reading_is_one_that_jcr_writes(tmp_path: Path, reading: dict[str, str]):
    folder = noise_capture(tmp_path / "capture", SIZE, 5).folder
    content = json.loads((folder / "capture.json").read_text())
    for stated in ({"file": "poses.csv"}, {"file": "poses.csv", **reading}):
        (folder / "capture.json").write_text(json.dumps(content | {"reading": stated}))
        if reading.keys() <= stated.keys():
            with refused("reading"):
                jcr.read_capture(folder)
        else:
            assert jcr.read_capture(folder).reading == Reading(file="poses.csv")


def test_a_bag_with_computed_columns_is_refused(tmp_path: Path):
    with sqlite3.connect(tmp_path / "a.db3") as bag:
        bag.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(900000000)));"
            "INSERT INTO topics VALUES (1, '/image', 'sensor_msgs/msg/Image', 'cdr', '');"
            "INSERT INTO topics VALUES (2, '/tf', 'tf2_msgs/msg/TFMessage', 'cdr', '');"
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (2, 2);"
        )
    bag.close()
    with refused("computed columns"):
        jcr.read_capture(tmp_path / "a.db3", into=tmp_path / "into")


# Pages


@pytest.mark.slow
def test_an_image_of_any_name_is_on_the_live_page(tmp_path: Path):
    from jcr.live.server import LiveServer

    names = ["a b.png", "a%20b.png", "50%.png", "q?x=1.png", "h#1.png", "<b>.png", "é'\".png"]
    folder = noise_capture(tmp_path / "capture", SIZE, len(names), "").folder
    content = json.loads((folder / "capture.json").read_text())
    for frame, name in zip(content["frames"], names, strict=True):
        (folder / frame["image"]).rename(folder / name)
        frame["image"] = name
    (folder / "capture.json").write_text(json.dumps(content))
    session, scripted = a_capture(folder, still_frames(lambda: read_image(folder / names[0])))
    session._report(scripted.update())
    with LiveServer(session) as server:
        page = json.loads(urllib.request.urlopen(f"{server.address}state", timeout=10).read())
        html = page["parts"]["images"]
        found = [part.split('"')[0] for part in html.split('src="')[1:]]
        assert len(found) == len(names) and "<b>" not in html
        for url in found:
            with urllib.request.urlopen(f"{server.address}{url}", timeout=10) as answer:
                assert answer.headers["Content-Type"] == "image/jpeg"


def test_names_command_no_terminal(capsys: pytest.CaptureFixture[str]):
    from jcr.cli.output import Output, warn

    Output().result(["label \x1b]0;title\x07 ü °"], {})
    warn("image \x1b[2J\u202e.png")
    said = capsys.readouterr()
    assert said.out == "label \\x1b]0;title\\x07 ü °\n" and said.err == "warning: image \\x1b[2J\\u202e.png\n"


MARKUP = "<img src=x onerror=alert(1)>{1+1}**b**[a](javascript:x).png"


def test_the_viewer_shows_names_as_text(tmp_path: Path, small_done: Path):
    from jcr.report.scene3d import BY_LABEL
    from jcr.result import load_run
    from jcr.viewer.viewer import Viewer, open_server

    run = load_run(small_done)
    images = tuple(replace(one, image=MARKUP) for one in run.calibration.images)
    capture = tmp_path / "capture"
    shutil.copytree(run.capture.folder, capture)
    for one in run.capture.images:
        (capture / one).rename(capture / (own := f"{len(list(capture.iterdir()))}{MARKUP}"))
        images = tuple(replace(i, image=own) for i in images)
    scene = run.scene
    scene.label_names = tuple(MARKUP for _ in scene.label_names)
    run = run.with_parts(scene=scene)
    server = open_server(0, "test")
    try:
        viewer = Viewer(server, run)
        viewer.calibration = replace(viewer.calibration, images=images)
        viewer.choose_image()
        viewer.shown.value = BY_LABEL
        viewer.show_points()
        cloud = viewer.points
        viewer.click(cloud.mean(0) + [0, 0, 1.0], np.array([0.0, 0.0, -1.0]))
        middle = cloud[np.linalg.norm(cloud - cloud.mean(0), axis=1).argmin()]
        clicked = viewer.click(middle + [0, 0, 0.5], np.array([0.0, 0.0, -1.0]))
        assert "javascript" in clicked and "javascript" in viewer._about_image.content
        for text in (clicked, viewer._about_image.content, viewer._legend.content):
            assert "<img" not in text and "&lt;img" in text or "javascript" not in text
        # Markdown would make a link and bold letters of it; HTML does not.
        assert type(viewer._about_image).__name__ == type(viewer.clicked).__name__ == "GuiHtmlHandle"
    finally:
        server.stop()


# Records


GOOD = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx": -1.0}, {"fx": 0.0}, {"fy": math.nan}, {"cx": math.inf}, {"cy": "240"}, {"width": 0}, {"height": 10**6},
        {"width": 6.5}, {"distortion": (0.1,)}, {"distortion": (math.nan,) * 5}, {"model": "kannala"},
        {"distortion": (0.0,) * 5, "model": "fisheye"},
    ],
)  # fmt: skip
def test_intrinsics_check_their_numbers_when_they_are_made(wrong: dict[str, Any]):
    for _ in range(10):  # after some calls the tests' own checks of types rest
        assert Intrinsics(**GOOD).fx == 600
    with pytest.raises(InputError) as caught:
        Intrinsics(**GOOD | wrong)
    assert "\n" not in str(caught.value)


RECORDS: dict[str, Callable[[], object]] = {
    "a pose too few": lambda: capture_of(np.stack([np.eye(4)] * 3), images=("a.png", "b.png")),
    "a pose of NaN": lambda: capture_of(np.full((3, 4, 4), np.nan)),
    "poses of another shape": lambda: capture_of(np.zeros((3, 3, 4))),
    "a depth too few": lambda: capture_of(np.stack([np.eye(4)] * 3), depths=("a.png",)),
    "a point that is not there": lambda: replace(
        NO_TRACKS,
        image=np.zeros(1, int),
        point=np.ones(1, int),
        x_px=np.zeros((1, 2)),
        points_in_recon=np.zeros((1, 3)),
    ),
    "images that do not ascend": lambda: reconstruction_of(
        np.stack([np.eye(4)] * 2), image_index=np.array([1, 0])
    ),
    "a label that is not there": lambda: cloud_of(np.zeros((1, 3)), label=np.ones(1, int)),
    "a camera that is not there": lambda: cloud_of(np.zeros((1, 3)), image=np.ones(1, int)),
    "images of no size": lambda: capture_of(np.stack([np.eye(4)] * 3), image_size=(0, -1)),
    "noise below 0": lambda: jcr.RobotNoise(translation=-1.0, rotation=0.0, estimated=False),
    "a scale of 0": lambda: hand_eye_of(np.eye(4), scale=0.0),
    "transforms of two mounts": lambda: hand_eye_of(np.eye(4), on_base=np.eye(4)),
}


@pytest.mark.parametrize("what", RECORDS)
def test_records_check_their_fields_when_they_are_made(what: str):
    for _ in range(10):  # after some calls the tests' own checks of shapes rest
        capture_of(np.stack([np.eye(4)] * 3))
    with pytest.raises(InputError):
        RECORDS[what]()


def test_copies_are_made_after_every_name_was_checked(tmp_path: Path):
    capture = noise_capture(tmp_path / "capture", SIZE, 3)
    wrong = replace(
        capture, images=("images/0.png", "images/1.png", "../secret.png"), source=tmp_path / "table.csv"
    )
    (tmp_path / "secret.png").write_bytes(b"x")
    with refused("leads out of"):
        capture_json.kept(wrong, tmp_path / "out")
    assert not (tmp_path / "out").exists()
