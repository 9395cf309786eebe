"""A calibration that grows with its capture: the same as the batch in the end, and faults named where they happen."""

import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import jcr
from jcr.capture.images import read_image
from jcr.findings import FindingKind
from jcr.geometry import rotation_exp, scale_translation, step_between, transform
from jcr.live.calibration import LiveCalibration
from jcr.live.progress import FIRST_ADVICE, LiveProgress
from jcr.records import Capture, LeaveOneOut
from refusal import refused
from scripted_capture import REQUIRED, a_hand_eye, still


@pytest.fixture(scope="module")
def capture(half_capture: Path) -> Capture:
    """Nine images of the bundled capture, 320 pixels wide."""
    return jcr.read_capture(half_capture).of_rows(range(9))


def image_of(capture: Capture, k: int) -> np.ndarray:
    return read_image(capture.folder / capture.images[k])


@pytest.fixture(scope="module")
def grown(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[LiveProgress]]:
    """The capture fed image by image, and the state after each."""
    folder = tmp_path_factory.mktemp("live") / "capture"
    live = LiveCalibration(folder, intrinsics=capture.intrinsics, options={"require": REQUIRED})
    states = [live.add(image_of(capture, k), pose) for k, pose in enumerate(capture.base_from_gripper)]
    live.close()
    return folder, states


@pytest.fixture(scope="module")
def resumed(
    grown: tuple[Path, list[LiveProgress]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[LiveCalibration]:
    """The same capture without its last image, begun again from its files; the last of its tests changes it."""
    folder = shutil.copytree(grown[0], tmp_path_factory.mktemp("resumed") / "capture")
    live = LiveCalibration(folder, options={"require": REQUIRED})
    live.live.remove(live.live.names[-1])
    live.update()
    yield live
    live.close()


@pytest.mark.slow
def test_every_image_from_the_fifth_on_gives_a_calibration_and_it_becomes_more_exact(grown):
    _, states = grown
    assert all(state.added == state.images[-1] for state in states)
    assert all(state.hand_eye is None and state.findings for state in states[:2])
    assert all(state.hand_eye is not None and state.hand_eye.converged for state in states[4:])
    assert all(state.reached is None for state in states[:2])
    printed = [str(state).splitlines() for state in states[:3]]
    missed = [one.remedy for one in states[2].findings if one.kind is FindingKind.NOT_EXACT_ENOUGH]
    assert [lines[1] for lines in printed] == [FIRST_ADVICE, FIRST_ADVICE, *missed]
    assert "no calibration yet" in printed[1][0] and "3 of 3 images registered: ±" in printed[2][0]
    reached = [state.reached[0] for state in states[2:]]
    assert reached[-1] < 0.5 * reached[2]
    assert states[-1].registered == states[-1].images
    assert len(str(states[-1]).splitlines()) == 2 and "requirement met" in str(states[-1])
    # Points are on the table or on what stands there.
    points = states[-1].points_in_base
    assert points is not None and len(points) > 200 and -0.02 < np.median(points[:, 2]) < 0.2
    # A requirement that holds is confirmed by the leave-one-out error.
    met = [state.requirement_met for state in states]
    assert not any(met[:7]) and met[-1]
    error = states[-1].leave_one_out
    assert error is not None and error.translation_mm < REQUIRED[0] and error.rotation_deg < REQUIRED[1]


def test_the_end_is_the_batch_calibration_in_any_order(small_capture, small_done, tmp_path, monkeypatch):
    capture, batch = jcr.read_capture(small_capture), jcr.load_run(small_done)
    with closing(LiveCalibration(tmp_path / "capture", intrinsics=capture.intrinsics)) as live:
        for k in (3, 0, 4, 2, 1):
            live.add(image_of(capture, k), capture.base_from_gripper[k])
        result = live.finish()
    assert batch.covariance is not None and result.verdict == batch.verdict
    away = step_between(result.gripper_from_camera, batch.gripper_from_camera)
    assert np.abs(away / np.sqrt(np.diag(batch.covariance)[:6])).max() < 1e-3, "the files round"
    assert np.allclose(result.covariance, batch.covariance, rtol=1e-2, atol=0)
    # A run of the same folder begins with that reconstruction.
    monkeypatch.setattr("jcr.pipeline.backend_selection.reconstruct", lambda *_: pytest.fail("made again"))
    run = jcr.calibrate(tmp_path / "capture", tmp_path / "run")
    assert np.allclose(run.gripper_from_camera, result.gripper_from_camera, rtol=0, atol=1e-9)
    assert (tmp_path / "run" / "reconstruction.npz").is_file()


@pytest.mark.slow
def test_a_resumed_capture_stands_where_it_stood_and_a_retake_is_an_image(grown, resumed, capture):
    before = grown[1][7]
    std = np.sqrt(np.diag(before.hand_eye.covariance)[:6])

    def sigmas(state: LiveProgress) -> float:
        """Return the largest difference from the calibration before."""
        away = step_between(state.hand_eye.gripper_from_camera, before.hand_eye.gripper_from_camera)
        return float(np.abs(away / std).max())

    now, pose = resumed.progress, resumed.live.images[4].base_from_gripper
    assert now.registered == before.registered and now.images == before.images and sigmas(now) < 1
    resumed.remove(4)
    after = resumed.add(image_of(capture, 4), pose)
    assert len(after.images) == 8 and before.images[4] not in after.images
    assert after.images[-1] == after.added and after.registered == after.images and sigmas(after) < 1
    assert jcr.read_capture(resumed.live.folder).images == after.images
    resumed.undo()
    undone = resumed.undo()
    # The images after the one that is back are registered again, in another order of adjustments.
    assert undone.images == undone.registered == before.images and sigmas(undone) < 2


@pytest.mark.slow
def test_each_fault_is_named_at_the_image_where_it_happens(resumed: LiveCalibration, capture: Capture):
    pose, image = capture.base_from_gripper[8], image_of(capture, 8)

    def against(state: LiveProgress) -> dict[FindingKind, Any]:
        return {one.kind: one for one in state.findings if one.images == (state.added,)}

    noise = np.random.default_rng(0).integers(0, 255, image.shape, dtype=np.uint8)
    strange = resumed.add(noise, pose, time_s=10.0)
    assert against(strange)[FindingKind.NOT_REGISTERED].value == 0
    wrong = pose @ transform(rotation_exp(np.radians([3.0, 8.0, 0.0])), np.array([0.03, 0.0, 0.02]))
    contradicted = resumed.add(image, wrong, time_s=9.0)
    assert len(contradicted.images) == 10 and contradicted.added in contradicted.registered
    found = against(contradicted)
    assert found[FindingKind.POSE_CONTRADICTS_IMAGE].details["rotation"] == pytest.approx(
        np.radians(8.5), rel=0.1
    )
    resumed.remove(len(resumed.live.names) - 1)
    blurred = resumed.add(np.asarray(cv2.GaussianBlur(image, (0, 0), 9), np.uint8), pose)
    assert FindingKind.BLURRED in against(blurred)
    assert FindingKind.POSE_CONTRADICTS_IMAGE not in against(blurred)
    # What is wrong with single images has not harmed the others.
    assert blurred.hand_eye is not None and blurred.hand_eye.converged


@pytest.mark.slow
def test_a_wrong_pose_is_named_where_its_image_cannot_be_registered_with_it(
    grown, capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without three pairs that agree on the correction, "overlap too little" was stated in its place."""
    monkeypatch.setattr("jcr.features.pair_search._contradicted_by_all", lambda *_: set())
    folder = shutil.copytree(grown[0], tmp_path / "capture")
    turned = capture.base_from_gripper[8] @ transform(rotation_exp(np.array([0.0, 2.0, 0.0])), np.zeros(3))
    with closing(LiveCalibration(folder)) as live:
        live.live.remove(live.live.names[-1])
        state = live.add(image_of(capture, 8), turned)
    (found,) = (one for one in state.findings if one.kind is FindingKind.NOT_REGISTERED)
    assert found.images == (state.added,) and found.concerns == "poses"
    assert "another rotation than" in found.text and "check the pose" in found.remedy


def test_eight_used_images_confirm_an_accuracy_and_seven_do_not():
    error = LeaveOneOut(translation_mm=0.1, rotation_deg=0.01, reprojection_px=None, how="given camera poses")
    found = replace(a_hand_eye(met=True), held_out=error)
    for used in (7, 8):
        images = tuple(replace(one, used=k < used) for k, one in enumerate(found.images))
        names = tuple(one.image for one in images)
        state = LiveProgress(images=names, registered=names, hand_eye=replace(found, images=images))
        assert state.requirement_met is (used == 8) and (state.leave_one_out is None) is (used == 7)


def test_what_cannot_be_kept_is_named_and_nothing_is_written(tmp_path: Path, tabletop: Path):
    image, poses = still(tabletop, 0), jcr.read_capture(tabletop).base_from_gripper
    in_mm = scale_translation(poses[1], 1e3)
    other = still(tabletop, 1)
    path = tabletop / "images" / "00.jpg"
    with closing(LiveCalibration(tmp_path / "capture")) as live:
        live.add(image, poses[0])
        before = (live.live.folder / "capture.json").read_bytes()
        for wrong, pose, words in (
            (str(path), poses[1], "is a path; give the pixels"),
            (other / 255.0, poses[1], "float64 values; give uint8"),
            (np.dstack([other, other[..., :1]]), poses[1], r"image\[..., :3\]"),
            (other[::2, ::2], poses[1], "set its old resolution"),
            (other, poses[1][:3, :3], "a rotation .3x3. has no translation"),
            (other, poses[1][:3], "four rows"),
            (other, 2 * poses[1], "last row"),
            (other, in_mm, "look like millimetres: divide the translations by 1000"),
            (image, poses[1], "image 2: is the same as images/001.png, though the gripper moved by"),
            (image, poses[0], "image 2: repeats images/001.png, image and pose"),
        ):
            with refused(words):
                live.add(wrong, pose)
        with refused("bgr"):
            live.add(other, poses[1], color="grb")  # pyright: ignore[reportArgumentType]
        with refused("image 2: joints: up to 90 rad; these look like degrees"):
            live.add(other, poses[1], joints=[90.0] * 6)
        assert (live.live.folder / "capture.json").read_bytes() == before
        assert [file.name for file in (live.live.folder / "images").iterdir()] == ["001.png"]


def test_grey_and_bgr_images_are_converted_lists_are_poses_all_can_be_removed(tmp_path: Path, tabletop: Path):
    image, poses = still(tabletop, 0), jcr.read_capture(tabletop).base_from_gripper
    grey = np.asarray(cv2.cvtColor(still(tabletop, 1), cv2.COLOR_RGB2GRAY), np.uint8)
    with closing(LiveCalibration(tmp_path / "capture")) as live:
        live.add(image[..., ::-1], poses[0].tolist(), color="bgr")
        live.add(grey, poses[1].tolist())
        kept = [read_image(live.live.folder / name) for name in live.live.names]
        live.remove(live.live.names[1])
        assert live.remove(0).images == ()
        for missing in (0, -1, "images/005.png"):
            with refused(f"no image {missing}; the capture has 0"):
                live.remove(missing)
        assert len(live.add(still(tabletop, 2), poses[2]).images) == 1
    for change in (lambda: live.add(still(tabletop, 3), poses[3]), lambda: live.remove(0), live.undo):
        with refused("is closed"):
            change()
    assert np.array_equal(kept[0], image) and np.array_equal(kept[1], np.dstack([grey] * 3))
