"""What `jcr check` names before heavy work: a camera at rest, poses that were exchanged, images that show nothing."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import capture_writers as writers
import jcr
from conftest import shrunk_capture
from jcr.calibration.checks.left_out import left_out_poses
from jcr.capture.images import BLURRED_EDGE, edge_width, read_image
from jcr.cli import dispatch
from jcr.estimation.hand_eye import fit_hand_eye
from jcr.findings import FindingKind
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks
from simulation.problems import hand_eye_problem

RNG = np.random.default_rng(0)
INTRINSICS = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)


def written(folder: Path, images: list[np.ndarray], frames: list[dict]) -> Path:
    (folder / "images").mkdir(parents=True)
    for image, frame in zip(images, frames, strict=True):
        cv2.imwrite(str(folder / frame["image"]), image)
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": None}))
    return folder


def test_a_camera_at_rest_is_named_before_anything_is_matched(tabletop: Path, tmp_path: Path, capsys):
    frames = json.loads((tabletop / "capture.json").read_text())["frames"][:4]
    one = cv2.imread(str(tabletop / frames[0]["image"])).astype(float)
    noisy = [np.clip(one + RNG.normal(0, 6, one.shape), 0, 255).astype(np.uint8) for _ in frames]
    assert dispatch(["check", str(written(tmp_path / "still", noisy, frames)), "--json"]) == 3
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["verdict"] == "rejected" and "all images show the same view" in found["warnings"][0]
    assert not said.err


def test_blur_is_measured_by_the_image_itself(tabletop: Path):
    """Not against the other images, which may all be blurred; a plain wall with noise has no edges to judge by."""
    sharp = [read_image(tabletop / f"images/{k:02d}.jpg") for k in range(12)]
    assert max(edge_width(image) for image in sharp) < 0.6 * BLURRED_EDGE
    along = np.zeros((21, 21), np.float32)
    along[10] = 1 / 21
    for blurred in (cv2.GaussianBlur(sharp[0], (0, 0), 5), cv2.filter2D(sharp[0], -1, along)):
        assert edge_width(np.asarray(blurred, np.uint8)) > BLURRED_EDGE
    assert edge_width(RNG.normal(120, 4, sharp[0].shape).astype(np.uint8)) == 0.0


@pytest.mark.slow
def test_a_wrong_focal_length_is_named_before_what_follows_from_it(tabletop: Path, tmp_path: Path, capsys):
    """Half as long again: 303.9 px are true."""
    folder = shrunk_capture(tabletop, tmp_path / "capture", 8, 320)
    content = json.loads((folder / "capture.json").read_text())
    content["intrinsics"] |= {name: 1.5 * content["intrinsics"][name] for name in ("fx", "fy")}
    (folder / "capture.json").write_text(json.dumps(content))
    assert dispatch(["check", str(folder)]) == 0  # the calibration estimates it
    said = capsys.readouterr().out
    first = next(line for line in said.splitlines() if line.startswith("WARNING"))
    assert re.search(
        r"show focal lengths of \(30[345]\.\d, .*\) ± \S+ px where \(456\.0, 456\.0\) is given",
        first,
    )
    assert said.startswith("ACCEPTED with 1 warning") and "add images" not in said


def test_poses_that_were_exchanged_are_named_and_one_that_is_wrong_too():
    problem = hand_eye_problem(np.random.default_rng(1), 12, robot_noise=(2e-4, 5e-4))
    gripper = problem.base_from_gripper.copy()
    gripper[[3, 8]] = gripper[[8, 3]]
    gripper[5, :3, 3] += 0.08
    names = tuple(f"{k}.png" for k in range(12))
    made = Reconstruction(
        image_index=np.arange(12),
        recon_from_camera=problem.recon_from_camera,
        intrinsics=INTRINSICS,
        tracks=Tracks(
            image=np.zeros(0, int),
            x_px=np.zeros((0, 2)),
            point=np.zeros(0, int),
            points_in_recon=np.zeros((0, 3)),
        ),
        backend="given",
    )
    hand_eye = fit_hand_eye(gripper, problem.recon_from_camera)
    assert hand_eye.converged and not hand_eye.inliers[[3, 5, 8]].any()
    found = left_out_poses(
        Capture(folder=Path(), images=names, base_from_gripper=gripper, image_size=(640, 480)), made, hand_eye
    )
    assert [(one.kind, one.severity, one.images) for one in found] == [
        (FindingKind.POSES_SWAPPED, "rejects", ("3.png", "8.png")),
        (FindingKind.POSE_CONTRADICTS_IMAGE, "warns", ("5.png",)),
    ]
    assert found[1].value == pytest.approx(0.08 * np.sqrt(3), rel=0.05)
    right = problem.base_from_gripper
    of_right = fit_hand_eye(right, problem.recon_from_camera)
    assert not left_out_poses(
        Capture(folder=Path(), images=names, base_from_gripper=right, image_size=(640, 480)),
        made,
        replace(of_right, inliers=np.arange(12) != 4),
    )


@pytest.mark.slow
def test_exchanged_poses_are_found_where_the_matching_leaves_their_images_out(
    tabletop: Path, tmp_path: Path, capsys
):
    content = json.loads((tabletop / "capture.json").read_text())
    frames = content["frames"]
    first, second = (frames[k]["base_from_gripper"] for k in (3, 8))
    frames[3]["base_from_gripper"], frames[8]["base_from_gripper"] = second, first
    shutil.copytree(tabletop / "images", tmp_path / "images")
    (tmp_path / "capture.json").write_text(
        json.dumps({"frames": frames, "intrinsics": content["intrinsics"]})
    )
    assert dispatch(["check", str(tmp_path)]) == 3
    said = capsys.readouterr()
    assert "\nCause       images/03.jpg and images/08.jpg have each other's gripper pose" in said.out
    assert "Agreement" not in said.out and "Expected" not in said.out


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["ur", "yaskawa"])
def test_columns_rx_ry_rz_are_read_as_the_images_show(
    convention: str, tabletop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    capture = jcr.read_capture(tabletop)
    few = replace(capture, images=capture.images[:8], base_from_gripper=capture.base_from_gripper[:8])
    writers.write_table(tmp_path, few, convention, "image,x,y,z,rx,ry,rz")
    with pytest.raises(jcr.InputError, match=r"say which, or find out from the images with jcr check"):
        jcr.read_capture(tmp_path)
    assert dispatch(["check", str(tmp_path), "--json"]) == 0
    said = capsys.readouterr().out
    (note,) = (remark for remark in json.loads(said)["notes"] if "rx, ry, rz" in remark)
    assert f"read with --pose-convention {convention}: these poses agree" in note and "jcr check" not in said
