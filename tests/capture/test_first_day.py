"""What a new user's table looks like: poses copied from a pendant, images left over, matrices by columns."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import jcr
from jcr.capture.conventions import numbers_from_poses
from jcr.capture.options import ReadOptions
from jcr.geometry import inverse, rotation_exp, transform

RNG = np.random.default_rng(3)
POSES = transform(rotation_exp(RNG.normal(size=(4, 3))), RNG.uniform(0.2, 0.6, (4, 3)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    for k in range(6):
        cv2.imwrite(str(tmp_path / f"images/{k}.png"), RNG.integers(0, 255, (24, 32, 3), dtype=np.uint8))
    return tmp_path


def written(folder: Path, lines: list[str]) -> Path:
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(
    "row", ["{k}.png, p[{numbers}]", "{k}.png; p [{numbers}]", '{k}.png\t"p[{numbers}]"']
)
@pytest.mark.parametrize("header", [[], ["image,pose"], ["# copied from the log"]])
def test_ur_poses_are_read_as_urscript_writes_them(folder: Path, row: str, header: list[str]):
    rows = numbers_from_poses(POSES, "ur")
    lines = [
        row.format(k=k, numbers=", ".join(f"{value:.9f}" for value in line)) for k, line in enumerate(rows)
    ]
    capture = jcr.read_capture(written(folder, header + lines))
    assert capture.images == tuple(f"images/{k}.png" for k in range(4))
    assert np.allclose(capture.base_from_gripper, POSES, atol=1e-8)
    (note,) = capture.notes
    assert "2 images have no pose in poses.csv and are left out: images/4.png, images/5.png" in note


def test_a_line_that_holds_no_pose_among_those_that_do_is_named(folder: Path):
    with pytest.raises(jcr.InputError, match="line 2 holds no p"):
        jcr.read_capture(written(folder, ["0.png p[0.4,0,0.5,0,3,0]", "1.png 0.4 0 0.5"]))


def test_images_that_are_not_there_are_all_named_with_those_that_have_no_pose(folder: Path):
    rows = [
        f"{k}.png," + ",".join(map(str, line))
        for k, line in zip((0, 1, 7, 8), numbers_from_poses(POSES, "rpy"), strict=True)
    ]
    with pytest.raises(
        jcr.InputError, match=r"2 of 4 images that are not in .*: 7.png, 8.png.*4 images have no pose"
    ):
        jcr.read_capture(written(folder, ["image,x,y,z,roll,pitch,yaw", *rows]))


def test_matrices_by_columns_and_inverted_poses_name_the_option_that_reads_them(folder: Path):
    by_columns = [
        ",".join([f"{k}.png", *map(str, line)]) for k, line in enumerate(numbers_from_poses(POSES, "franka"))
    ]
    with pytest.raises(jcr.InputError, match="--pose-convention franka"):
        jcr.read_capture(written(folder, by_columns))
    capture = jcr.read_capture(folder, ReadOptions(pose_convention="franka"))
    assert np.allclose(capture.base_from_gripper, POSES)
    inverted = jcr.read_capture(folder, ReadOptions(pose_convention="franka", pose_inverted=True))
    assert np.allclose(inverted.base_from_gripper, inverse(POSES))


HEADER = "image,x,y,z,qx,qy,qz,qw"


def rows_of(names: list[str], poses: np.ndarray = POSES, *, metre: float = 1.0) -> list[str]:
    numbers = numbers_from_poses(poses, "quat-xyzw") * ([metre] * 3 + [1] * 4)
    return [f"{name}," + ",".join(f"{x:.9f}" for x in row) for name, row in zip(names, numbers, strict=True)]


@pytest.mark.parametrize("header", [[HEADER.replace(",", ";")], []])
def test_a_spreadsheet_with_decimal_commas_is_read(folder: Path, header: list[str]):
    names = [f"{k}.png" for k in range(4)]
    lines = [line.replace(",", ";").replace(".", ",") for line in rows_of(names)]
    lines = [line.replace(",png", ".png") for line in lines]
    assert ",5" in "".join(lines) or "0," in lines[0]
    options = ReadOptions() if header else ReadOptions(pose_convention="quat-xyzw")
    capture = jcr.read_capture(written(folder, header + lines), options)
    assert np.allclose(capture.base_from_gripper, POSES, atol=1e-8)


def test_centimetres_are_named_and_read(folder: Path):
    written(folder, [HEADER, *rows_of([f"{k}.png" for k in range(4)], metre=100.0)])
    with pytest.raises(jcr.InputError, match="look like centimetres: add --pose-units cm-rad"):
        jcr.read_capture(folder)
    assert np.allclose(jcr.read_capture(folder, ReadOptions(pose_units="cm-rad")).base_from_gripper, POSES)
    in_header = HEADER.replace("x,y,z", "x_cm,y_cm,z_cm", 1)
    written(folder, [in_header, *rows_of([f"{k}.png" for k in range(4)], metre=100.0)])
    assert np.allclose(jcr.read_capture(folder).base_from_gripper, POSES)


@pytest.mark.parametrize("name", ["/home/robot/run 7/{}.png", r"C:\run\{}.PNG", "IMAGES/{}.JPG"])
def test_images_are_found_by_their_own_names(folder: Path, name: str):
    capture = jcr.read_capture(written(folder, [HEADER, *rows_of([name.format(k) for k in range(4)])]))
    assert capture.images == tuple(f"images/{k}.png" for k in range(4))
    assert any(name.format(0) in note and "images/0.png" in note for note in capture.notes)


def test_images_without_poses_are_named(folder: Path):
    with pytest.raises(
        jcr.InputError, match=r"no poses.csv beside its 6 images \(images/0.png … images/5.png\)"
    ):
        jcr.read_capture(folder)
