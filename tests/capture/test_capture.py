"""Reading a capture: what is sound is read as it is, and each fault is named with its place and remedy."""

import json
import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import jcr
from in_process import run_jcr
from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png, read_image
from jcr.geometry import scale_translation
from refusal import refused


@pytest.fixture
def capture(tmp_path: Path, tabletop: Path) -> Path:
    """Four frames of the bundled capture."""
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    content = json.loads((tabletop / "capture.json").read_text())
    for frame in content["frames"][:4]:
        shutil.copy(tabletop / frame["image"], folder / frame["image"])
    (folder / "capture.json").write_text(json.dumps(content | {"frames": content["frames"][:4]}))
    return folder


def edit(folder: Path, change) -> None:
    content = json.loads((folder / "capture.json").read_text())
    change(content)
    (folder / "capture.json").write_text(json.dumps(content))


def change_poses(folder: Path, change, rows=(1,)) -> None:
    """Replace the gripper poses of some frames by a function of them."""

    def changed(content: dict) -> None:
        for k in rows:
            pose = np.array(content["frames"][k]["base_from_gripper"])
            content["frames"][k]["base_from_gripper"] = change(pose).tolist()

    edit(folder, changed)


def test_a_folder_of_captures_is_refused(capture: Path):
    with refused(f"holds captures, not images; did you mean {capture}"):
        jcr.read_capture(capture.parent)


def test_options_that_a_capture_json_states_itself_are_refused_and_so_is_the_capture_as_out(capture: Path):
    """They were ignored in silence, and the results were written among the files of the capture."""
    for option in ("--camera-info", "--poses", "--pose-units", "--mount"):
        value = {"--pose-units": "mm-deg", "--mount": "base"}.get(option, "nowhere.yaml")
        done = run_jcr("check", capture, option, value)
        assert done.returncode == 2 and f"and {option} would change them" in done.stderr
    done = run_jcr("calibrate", capture, capture)
    assert done.returncode == 2 and "is a capture, and the results need a folder of their own" in done.stderr


def test_a_sound_capture_is_read_as_it_is(capture: Path):
    content = json.loads((capture / "capture.json").read_text())
    read = jcr.read_capture(capture)
    assert read.images == tuple(frame["image"] for frame in content["frames"])
    assert np.allclose(read.base_from_gripper[2], content["frames"][2]["base_from_gripper"], atol=1e-9)
    assert read.image_size == (640, 480)
    assert read.intrinsics is not None and read.intrinsics.fx == content["intrinsics"]["fx"]
    assert len(jcr.read_capture(capture / "capture.json")) == 4
    # Other keys are ignored, and a byte order mark, which some editors put before JSON, is no fault.
    edit(capture, lambda c: c.update(intrinsics=None, anything={"else": 1}))
    file = capture / "capture.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert jcr.read_capture(capture).intrinsics is None


def test_standard_deviations_that_are_stated_are_read_and_written_again(capture: Path):
    stated = {"fx": 2.0, "fy": 3.0, "distortion": [0.01, 0]}
    edit(capture, lambda content: content.update(intrinsics_std=stated))
    read = jcr.read_capture(capture)
    expected = [2.0, 3.0, np.nan, np.nan, 0.01, 0.0, np.nan, np.nan, np.nan]
    np.testing.assert_array_equal(read.intrinsics_std, expected)
    capture_json.write(capture, read)
    np.testing.assert_array_equal(jcr.read_capture(capture).intrinsics_std, expected)


def test_cmyk_is_read(tmp_path: Path):
    Image.new("CMYK", (64, 48), (0, 255, 255, 0)).save(tmp_path / "red.jpg")
    assert read_image(tmp_path / "red.jpg")[0, 0, 0] > 200


def second(change: Callable[[Path], object]) -> Callable[[Path], object]:
    """A fault of the second image."""
    return lambda capture: change(capture / "images/01.jpg")


def named(name: str) -> Callable[[Path], None]:
    """A fault of its name."""
    return lambda capture: edit(capture, lambda content: content["frames"][1].update(image=name))


def link_out(file: Path) -> None:
    file.rename(file.parents[2] / "secret.jpg")
    file.symlink_to(file.parents[2] / "secret.jpg")


def link_to_itself(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.symlink_to(path.name)


def bomb(file: Path) -> None:
    """A PNG whose header promises 60000 x 60000 pixels, with little behind it."""
    data = encode_png(np.zeros((48, 64, 3), np.uint8))
    header = data[12:16] + struct.pack(">II", 60_000, 60_000) + data[24:29]
    file.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])


def animate(file: Path) -> None:
    frames = [Image.new("RGB", (640, 480), color) for color in ("red", "green")]
    frames[0].save(file, format="GIF", save_all=True, append_images=frames[1:])


def turn(file: Path, orientation: int = 6) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.open(file).save(file, exif=exif)


def misspell(content: dict) -> None:
    frame = content["frames"][1]
    frame["base_from_griper"] = frame.pop("base_from_gripper")


truncate = second(lambda file: file.write_bytes(file.read_bytes()[:2000]))


FAULTS = {
    "no capture.json": (lambda c: (c / "capture.json").unlink(), "no gripper poses for its 4 images"),
    "text for a number": (lambda c: edit(c, lambda j: j["intrinsics"].update(fx="608 px")),
        "intrinsics.fx: '608 px': Input should be a valid number"),
    "not JSON": (lambda c: (c / "capture.json").write_text("{'frames': []"), "not JSON at line 1.*correct it"),
    "deeply nested": (lambda c: (c / "capture.json").write_text("[" * 100_000), "too deep"),
    "key twice": (lambda c: (c / "capture.json").write_text('{"frames": [], "frames": []}'), "appears twice"),
    "two frames": (lambda c: edit(c, lambda j: j.update(frames=j["frames"][:2])), "2 frames; at least 3"),
    "image name missing": (lambda c: edit(c, lambda j: j["frames"][1].pop("image")), 'frame 1 has no "image"'),
    "millimetres": (lambda c: change_poses(c, lambda pose: scale_translation(pose, 1e3), range(4)), "like millimetres"),
    "intrinsics outside": (lambda c: edit(c, lambda j: j["intrinsics"].update(cx=900)), "outside the 640x480"),
    "intrinsics short": (lambda c: edit(c, lambda j: j["intrinsics"].update(distortion=[0, 0])),
        "not the 5 of a pinhole"),
    "not UTF-8": (lambda c: (c / "capture.json").write_bytes(b'{"frames": "\xff\xfe"}'), "not UTF-8"),
    "number of 5000 digits": (lambda c: (c / "capture.json").write_text(f'{{"frames": [{"9" * 5000}]}}'), "4300 digits"),
    "path outside": (named("../x.jpg"), r"frame 1: '\.\./x\.jpg' leads out"),
    "absolute path": (named("/etc/hostname"), "no path inside"),
    "path with NUL": (named("a\0b"), "no path inside the capture"),
    "path of two lines": (named("images/0.png\n"), "no path inside the capture"),
    "path of 500 folders": (named("images/" + 500 * "a/" + "0.png"), "no path inside the capture"),
    "mount of the frames": (lambda c: edit(c, lambda j: j.update(mount="base")), '"mount" belongs to a camera'),
    "arm of the frames": (lambda c: edit(c, lambda j: j.update(arm="base")), '"arm" belongs to a camera'),
    "path with half a surrogate": (named("images/\ud800.png"), "no path inside"),
    "name of 300 letters": (named("images/" + "x" * 300), "no path inside"),
    "link outside": (second(link_out), "leads out"),
    "link to itself": (second(link_to_itself), "link back to itself"),
    "folder that is a link to itself": (lambda c: link_to_itself(c / "images"), "link back to itself"),
    "folder": (second(lambda p: (p.unlink(), p.mkdir())), "a folder, a pipe"),
    "pipe": (second(lambda p: (p.unlink(), os.mkfifo(p))), "a folder, a pipe"),
}  # fmt: skip
"""Faults of the capture."""
FRAME_FAULTS = {
    "image missing": (second(Path.unlink), r"01\.jpg: no such image"),
    "image of no bytes": (second(lambda p: p.write_bytes(b"")), "not a readable image"),
    "animation": (second(animate), "holds several images"),
    "decompression bomb": (second(bomb), "million pixels"),
    "100 million pixels": (second(lambda p: Image.new("1", (10_000, 10_000)).save(p, format="PNG")), "million pixels"),
    "image of fractions": (second(lambda p: Image.new("F", (640, 480), 0.5).save(p, format="TIFF")), "more than 8 bits"),
    "16 bits": (second(lambda p: cv2.imwrite(str(p.with_suffix(".png")), np.ones((480, 640, 3), np.uint16))
        and p.with_suffix(".png").rename(p)), "more than 8 bits"),
    "EXIF tag": (second(turn), "EXIF orientation 6, .*remove the tag"),
    "EXIF tag of a mirrored image": (second(lambda file: turn(file, 2)), "EXIF orientation 2, .*remove the tag"),
    "image truncated": (truncate, r"01\.jpg: not a readable image"),
    "wrong size": (second(lambda p: Image.open(p).resize((320, 240)).save(p)),
        r"01\.jpg: image of 320x240 pixels, images/00\.jpg of 640x480"),
    "same image": (lambda c: shutil.copy(c / "images/00.jpg", c / "images/01.jpg"),
        r"01\.jpg: the same image as images/00\.jpg"),
    "misspelt key": (lambda c: edit(c, misspell),
        "base_from_gripper: is missing, but there is 'base_from_griper'; correct it there"),
    "pose missing": (lambda c: edit(c, lambda j: j["frames"][1].pop("base_from_gripper")),
        r"frame 1 \(images/01\.jpg\): base_from_gripper: is missing"),
    "pose of NaN": (lambda c: change_poses(c, lambda pose: np.nan * pose), "frame 1 .*NaN"),
    "pose scaled": (lambda c: change_poses(c, lambda pose: pose @ np.diag([2, 2, 2, 1])), "frame 1 .*scaled by 2"),
    "pose reflected": (lambda c: change_poses(c, lambda pose: pose @ np.diag([1, 1, -1, 1])),
        "frame 1 .*reflection"),
    "pose transposed": (lambda c: change_poses(c, np.transpose), "frame 1 .*transposed"),
    "pose of words": (lambda c: edit(c, lambda j: j["frames"][1].update(base_from_gripper="here")), "frame 1 .*4x4"),
}  # fmt: skip
"""Faults of frame 1 alone."""


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_one_line_with_place_and_remedy(capture: Path, fault: str):
    plant, words = FAULTS[fault]
    plant(capture)
    with pytest.raises(jcr.InputError, match=words) as error:
        jcr.read_capture(capture)
    assert "\n" not in str(error.value)
    assert str(capture) in str(error.value)


@pytest.mark.parametrize("fault", FRAME_FAULTS)
def test_a_frame_that_cannot_be_used_is_left_out_with_its_place_and_remedy(capture: Path, fault: str):
    plant, words = FRAME_FAULTS[fault]
    plant(capture)
    read = jcr.read_capture(capture)
    assert read.images == ("images/00.jpg", "images/02.jpg", "images/03.jpg")
    assert len(read.base_from_gripper) == 3
    (note,) = read.notes
    assert re.search(f"left out: .*{words}", note) and "\n" not in note and str(capture) in note


def test_several_frames_that_cannot_be_used_are_named_in_one_message(capture: Path):
    truncate(capture)
    change_poses(capture, lambda pose: np.nan * pose, (2,))
    (capture / "images/03.jpg").unlink()
    named = r"\(3 of 4 frames cannot be used: images/02\.jpg, images/01\.jpg, images/03\.jpg\)"
    with refused(r"01\.jpg: not a readable image.* " + named):
        jcr.read_capture(capture)


def test_joints_and_other_cameras_stay_with_the_frames_that_are_used(capture: Path):
    for k in range(4):
        Image.new("RGB", (32, 24), (60 * k, 0, 0)).save(capture / f"{k}.png")
    cameras = {"second": {"mount": "gripper", "images": ["0.png", "1.png", None, "3.png"]}}
    edit(capture, lambda c: (set_joints(c, JOINTS), c.update(cameras=cameras)))
    change_poses(capture, lambda pose: np.nan * pose)
    read = jcr.read_capture(capture)
    assert read.joints is not None and read.joints.tolist() == [JOINTS[k] for k in (0, 2, 3)]
    (second,) = read.others
    assert second.images == ("0.png", "3.png")
    assert second.frame is not None and second.frame.tolist() == [0, 2]


JOINTS = [[0.1 * k, -1.6, 1.9, -1.9, -1.5, 0.2 * k] for k in range(4)]


def set_joints(content: dict, rows: list) -> None:
    for frame, row in zip(content["frames"], rows, strict=True):
        frame["joints"] = row


def test_joints_and_the_robot_are_kept_and_written_again(capture: Path, tmp_path: Path):
    plain = jcr.read_capture(capture)
    assert plain.joints is None and plain.robot is None and plain.urdf is None
    (capture / "my_arm.urdf").write_text("<robot/>")
    edit(capture, lambda c: (set_joints(c, JOINTS), c.update(robot="ur5e", urdf="my_arm.urdf")))
    read = jcr.read_capture(capture)
    assert read.joints is not None and read.robot == "ur5e" and read.urdf == capture / "my_arm.urdf"
    np.testing.assert_array_equal(read.joints, JOINTS)
    # A copy of a capture that was read from elsewhere is complete in its folder.
    again = capture_json.kept(replace(read, source=capture), tmp_path / "copy")
    np.testing.assert_array_equal(again.joints, JOINTS)
    assert again.robot == "ur5e" and again.urdf == tmp_path / "copy" / "robot.urdf"
    assert again.urdf.read_text() == "<robot/>"
    edit(capture, lambda c: c.update(robot="panda"))
    with refused("frames have 6 joints, but a panda has 7; correct either"):
        jcr.read_capture(capture)
    edit(capture, lambda c: c.update(robot="cobot 9"))
    read = jcr.read_capture(capture)
    assert read.robot is None and "robot 'cobot 9' is not one of ur3e" in read.notes[0]


@pytest.mark.parametrize(("row", "words"), [
    (None, r"frame 3 .*: no joint angles, others have 6; give them for all"),
    (JOINTS[3][:5], r"frame 3 .*: 5 joint angles, others have 6"),
    ([float("nan")] * 6, r"frame 3 .*: joints.0: nan: Input should be a finite number"),
    ("0 1 2", r"frame 3 .*: joints: .0 1 2.: Input should be a valid list"),
])  # fmt: skip
def test_a_frame_with_unusable_joints_is_left_out(capture: Path, row, words: str):
    edit(capture, lambda c: set_joints(c, [*JOINTS[:3], row]))
    read = jcr.read_capture(capture)
    assert read.joints is not None and read.joints.tolist() == JOINTS[:3]
    assert re.search(words, read.notes[0])
