"""Whether a calibration is still valid: by new images and by touched points, with false alarms at their rate."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import jcr
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.drift import Change, Located, Reference, Step, check_series, step_of
from jcr.calibration.record import write_calibration
from jcr.camera import project
from jcr.capture.formats import capture_json
from jcr.capture.images import read_image
from jcr.cli import dispatch
from jcr.estimation.absolute_pose import CameraPose
from jcr.estimation.problem import pose_problem
from jcr.estimation.robot_noise import smooth_errors
from jcr.estimation.solve import solve
from jcr.files import write_bytes
from jcr.geometry import (
    Similarity,
    apply,
    inverse,
    retract,
    rotation_exp,
    rotation_log,
    scale_translation,
    step_between,
    transform,
)
from jcr.pipeline import recalibrate as recalibrating
from jcr.pipeline.calibrated_scene import OldScene
from jcr.pipeline.stages import begun, keep_reconstruction
from jcr.pipeline.touch import CLICK_PX, error_covariance, touch
from jcr.pipeline.verify import TOLERANCE, of_two_poses
from jcr.pipeline.verify_history import History, Verified, without_part
from jcr.records import Capture, RobotNoise, Uncertainty
from jcr.result import RunOptions, RunResult
from jcr.sfm.register import Registration
from refusal import refused
from scenes import hand_eye_of, reconstruction_of, reference_of
from simulation.capture import with_robot_noise
from simulation.poses import gripper_poses
from simulation.problems import INTRINSICS

pytestmark = pytest.mark.slow

OLD = 9
"""Images of the bundled capture that calibrate; the other three are of the day after."""
SCALE = 0.37
BUMP = transform(rotation_exp(np.radians(1.0) * np.array([0.0, 0.6, 0.8])), np.array([0.003, 0.0, 0.0]))
NUDGE = transform(rotation_exp(np.array([0.0, 0.0, 0.02])), np.array([0.02, -0.01, 0.0]))
"""Of the table, in the base frame."""


@pytest.fixture(scope="module")
def capture(half_capture: Path) -> Capture:
    return jcr.read_capture(half_capture)


@pytest.fixture(scope="module")
def x(tabletop: Path) -> np.ndarray:
    return reference_of(tabletop)


def cameras(capture: Capture, x: np.ndarray) -> np.ndarray:
    """recon_from_camera of every image, in a frame and unit of no meaning."""
    recon_from_base = transform(rotation_exp(np.array([0.3, -0.8, 0.5])), np.array([0.2, 0.1, -0.4]))
    return scale_translation(recon_from_base @ capture.base_from_gripper @ x, 1 / SCALE)


def series(
    capture: Capture, x: np.ndarray, seed: int, captures: list[list[int]], noise=(0.5, 0.1), **changed
) -> tuple[Reference, list[Located], np.ndarray]:
    """A calibration and later captures of images `captures` by poses alone, with drawn errors of robot and cameras.

    `bump` and `nudge` move the camera and the table before capture `at`.
    """
    rng, at = np.random.default_rng(seed), changed.get("at", 0)
    camera_std = np.r_[np.full(3, 3e-4 / SCALE), np.full(3, 5e-4)]
    places, gripper = cameras(capture, x), capture.base_from_gripper
    start = (
        x, SCALE, inverse(transform(rotation_exp(np.array([0.3, -0.8, 0.5])), np.array([0.2, 0.1, -0.4]))),
    )  # fmt: skip
    old = with_robot_noise(gripper[:OLD], *noise, rng)
    fit = solve(*pose_problem(old, places[:OLD], start)).state
    poses = {"base_from_gripper": old, "recon_from_camera": places[:OLD]}
    reference = Reference(x=fit.x[0], scale=fit.scale, z=fit.z[0], **poses)
    later = list[Located]()
    for k, rows in enumerate(captures):
        there = gripper[rows]
        if k >= at and "bump" in changed:
            there = there @ x @ inverse(x @ changed["bump"])
        if k >= at and "nudge" in changed:
            there = changed["nudge"] @ there
        motion = camera_std * rng.normal(size=(len(rows), 6))
        located = places[rows] @ transform(rotation_exp(motion[:, 3:]), motion[:, :3])
        spread = np.broadcast_to(np.diag(camera_std**2), (len(rows), 6, 6))
        reported = with_robot_noise(there, *noise, rng)
        later.append(
            Located(
                base_from_gripper=tuple(reported), recon_from_camera=tuple(located), covariance=tuple(spread)
            )
        )
    every = np.concatenate([old, *(np.stack(one.base_from_gripper) for one in later)])
    return reference, later, smooth_errors(every)


def test_p_values_of_one_capture_are_true(capture: Capture, x: np.ndarray):
    p = []
    for seed in range(200, 212):
        for k, rows in enumerate(([9], [9, 10, 11])):
            reference, (one,), systematic = series(capture, x, 7 * seed + k, [rows])
            p.append(step_of(reference, one, systematic, "camera").p_value)
    p = np.array(p)
    # Binomial: 5 % of 24 is 1.2 ± 1.1, 50 % is 12 ± 2.4.
    assert (p < 0.05).sum() <= 5
    assert 5 <= (p < 0.5).sum() <= 19
    assert (p < 1e-3).sum() <= 1


def test_what_is_called_detectable_is_detected_nine_times_in_ten(capture: Capture, x: np.ndarray):
    found = []
    for seed in range(12):
        reference, (one,), systematic = series(capture, x, seed, [[9, 10]])
        detectable = check_series(reference, [one], systematic).detectable[0]
        shape = step_of(reference, one, systematic, "camera").covariance[:3, :3]
        shift = detectable * np.linalg.eigh(shape)[1][:, -1]
        bump = transform(np.eye(3), x[:3, :3].T @ shift)
        test = check_series(*series(capture, x, seed, [[9, 10]], bump=bump))
        found.append(bool(test.changes) or test.wrong_image is not None)
    # Binomial: 90 % of 12 is 10.8 ± 1.0.
    assert sum(found) >= 8


def test_a_moved_table_is_distinguished_from_a_moved_camera(capture: Capture, x: np.ndarray):
    exact = (0.05, 0.01)
    for rows in ([9, 10, 11], [9]):
        (table,) = check_series(*series(capture, x, 0, [rows], exact, nudge=NUDGE)).changes
        (camera,) = check_series(*series(capture, x, 0, [rows], exact, bump=BUMP)).changes
        if len(rows) == 1:  # both fit a single image exactly
            assert {"camera", "scene"} <= {table.cause, *table.rivals}
            continue
        assert (table.cause, table.rivals) == ("scene", ())
        assert (camera.cause, camera.rivals) == ("camera", ())
        np.testing.assert_allclose(camera.motion, step_between(x, x @ BUMP), atol=5e-4)
        turned, shift = rotation_log(NUDGE[:3, :3]), NUDGE[:3, 3]
        np.testing.assert_allclose(table.motion[3:], turned, atol=5e-4)
        assert np.linalg.norm(table.motion[:3] - shift) < 0.5 * np.linalg.norm(shift)


def test_captures_together_find_a_bump_that_one_does_not_and_a_later_push_of_the_table(capture, x):
    rows, bump = [9, 10, 11], transform(np.eye(3), np.array([1.2e-3, 0.0, 0.0]))
    push = transform(np.eye(3), np.array([0.0, 0.01, 0.0]))
    reference, later, _ = series(capture, x, 5, 9 * [rows], (0.2, 0.03), bump=bump, at=3)
    for k in (7, 8):
        moved = tuple(push @ pose for pose in later[k].base_from_gripper)
        later[k] = later[k].model_copy(update={"base_from_gripper": moved})
    systematic = smooth_errors(
        np.concatenate([np.stack(one.base_from_gripper) for one in (reference, *later)])
    )
    changes, found = (), []
    for n in range(1, len(later) + 1):
        size = 6 * (OLD + len(rows) * n)
        test = check_series(reference, later[:n], systematic[:size, :size], changes)
        changes = test.changes
        found.append([(one.cause, one.first) for one in changes])
    assert found[:4] == 4 * [[]], "nothing moved, and then by less than one capture shows"
    assert found[4] == [("camera", 3)]
    assert found[8] == [("camera", 3), ("scene", 7)]
    assert np.linalg.norm(changes[0].motion[:3]) == pytest.approx(1.2e-3, abs=4e-4)
    assert changes[1].motion[1] == pytest.approx(0.01, abs=1e-3)


def test_one_wrong_pose_is_named_and_joints_set_to_zero_again_are_the_robots(capture: Capture, x: np.ndarray):
    exact, rows = (0.05, 0.01), [9, 10, 11, 2, 5]
    reference, later, systematic = series(capture, x, 1, [rows, rows], exact)
    wrong = list(later[1].base_from_gripper)
    wrong[3] = transform(rotation_exp(np.array([0.0, 0.01, 0.0])), np.zeros(3)) @ wrong[3]
    replaced = later[1].model_copy(update={"base_from_gripper": tuple(wrong)})
    assert check_series(reference, [later[0], replaced], systematic).wrong_image == 3
    for count in (2, 1):  # captures, of which the last is the first one after the change
        size = 6 * (OLD + len(rows) * count)
        known = systematic[:size, :size]
        errors = np.linalg.cholesky(known + 1e-9 * np.eye(size))[-30:]
        strain = 0.004 * (errors @ np.random.default_rng(2).normal(size=size)).reshape(5, 6)
        bent = tuple(retract(np.stack(later[count - 1].base_from_gripper), strain))
        replaced = later[count - 1].model_copy(update={"base_from_gripper": bent})
        test = check_series(reference, [*later[: count - 1], replaced], known)
        assert [(one.cause, one.first) for one in test.changes] == [("robot", count - 1)]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory, capture: Capture, x: np.ndarray) -> Path:
    """The run folder of a calibration from the first nine images, with the noise of a good robot."""
    folder = tmp_path_factory.mktemp("run")
    content = json.loads((capture.folder / "capture.json").read_text())
    noisy = with_robot_noise(capture.base_from_gripper, 0.2, 0.03, np.random.default_rng(1))
    for frame, pose in zip(content["frames"], noisy, strict=True):
        frame["base_from_gripper"] = pose.tolist()
    old = write_capture(folder / "yesterday", capture, noisy, range(OLD))
    (folder / "out").mkdir()
    # As a structure from motion without error would give.
    reconstruction = reconstruction_of(cameras(capture, x)[:OLD], intrinsics=capture.intrinsics)
    hand_eye = calibrate_reconstruction(old, reconstruction)
    assert hand_eye.converged
    write_calibration(folder / "out/calibration.json", hand_eye)
    begin = begun(folder / "out", jcr.read_capture(old.folder), RunOptions())
    keep_reconstruction(begin, reconstruction)
    return folder / "out"


@pytest.fixture
def out(calibrated: Path, tmp_path: Path) -> Path:
    """A copy of the run folder, because the history of verifications is in it."""
    return Path(shutil.copytree(calibrated, tmp_path / "run"))


def write_capture(folder: Path, capture: Capture, poses: np.ndarray, rows) -> Capture:
    few = replace(capture, folder=folder, base_from_gripper=poses).of_rows(rows)
    for name in few.images:
        write_bytes(folder / name, (capture.folder / name).read_bytes())
    capture_json.write(folder, replace(few, intrinsics=None))
    return few


def test_the_command_is_content_with_what_has_not_moved(out: Path, capture: Capture, tmp_path: Path, capsys):
    poses = with_robot_noise(capture.base_from_gripper, 0.2, 0.03, np.random.default_rng(2))
    write_capture(tmp_path / "today", capture, poses, [10, 11])
    assert dispatch(["verify", str(out), str(tmp_path / "today"), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("ACCEPTED: no drift is detected")


def test_images_of_a_calibration_are_refused_by_content(out: Path, capture: Capture, tmp_path: Path, capsys):
    today = write_capture(tmp_path / "today", capture, capture.base_from_gripper, [10, 3])
    old = today.folder / capture.images[3]
    old.rename(old.with_name("fresh.jpg"))
    file = today.folder / "capture.json"
    file.write_text(file.read_text().replace(Path(capture.images[3]).name, "fresh.jpg"))
    assert dispatch(["verify", str(out), str(today.folder)]) == 2
    assert (
        f"fresh.jpg: is the same image as {capture.images[3]} of the calibration" in capsys.readouterr().err
    )


def test_the_command_finds_a_bump_from_one_image_and_shows_what_to_do(out, capture, x, tmp_path, capsys):
    poses = capture.base_from_gripper @ x @ inverse(x @ BUMP)
    write_capture(tmp_path / "today", capture, poses, [10])
    assert dispatch(["verify", str(out), str(tmp_path / "today"), "--quiet"]) == 3
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith(
        "REJECTED: the camera or the scene or the robot's reported poses have changed"
    )
    assert printed[1].startswith("Remedy ") and "calibrate again" in printed[1]
    assert dispatch(["verify", str(out), str(tmp_path / "today"), "--quiet", "--json"]) == 3
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["moved"] and found["p_value"] < 1e-3
    assert {"camera", "scene"} <= set(found["moves"][0]["causes"])
    assert np.linalg.norm(found["drift_mm"]) == pytest.approx(3.0, abs=2.0)
    assert np.linalg.norm(found["drift_deg"]) == pytest.approx(1.0, abs=0.3)
    assert not printed.err


def test_the_output_says_of_which_capture_it_is_and_how_to_go_on(out, capture, x, tmp_path, capsys):
    slipped = capture.base_from_gripper @ x @ inverse(x @ BUMP)
    write_capture(tmp_path / "good", capture, capture.base_from_gripper, [9])
    write_capture(tmp_path / "slip", capture, slipped, [10, 11])
    printed = []
    for name in ("good", "slip", "good"):
        dispatch(["verify", str(out), str(tmp_path / name), "--quiet"])
        printed.append(capsys.readouterr().out)
    assert "axes) of good\n" in printed[0] and "Next" not in printed[0] and "Note" not in printed[0]
    assert "axes) of slip\n" in printed[1] and "delete verify.json" in printed[1]
    assert printed[2].startswith("REJECTED") and "since capture slip" in printed[2]
    assert (
        "axes) of good\n" in printed[2]
        and "good was verified before slip, and does not count again" in printed[2]
    )


def test_a_start_check_in_python_counts_an_image_once(out: Path, capture: Capture):
    rng = np.random.default_rng(2)
    poses = with_robot_noise(capture.base_from_gripper, 0.2, 0.03, rng)
    files, run = [capture.folder / name for name in capture.images], jcr.load_run(out)
    first = run.verify([files[10]], poses[[10]], name="start")
    assert not first.moved and len(first.history) == 1
    # One image more of the same check takes its place; the same images again change nothing.
    images = [read_image(file) for file in files[10:12]]
    both = run.verify(images, poses[10:12], name="start")
    assert len(both.history) == 1 and len(both.images) == 2
    assert both.detectable[0] < first.detectable[0]
    again = run.verify(files[10:12], poses[10:12])
    assert [row.name for row in again.history] == ["start"]
    run.verify([files[9]], poses[[9]], name="next")
    with refused("verified before"):
        run.verify(files[9:11], poses[9:11])
    with refused("for 2 images; give a pose"):
        run.verify(files[9:11], poses[[9]])
    far = np.array(poses[6:9])
    far[:, :3, 3] *= 1e3
    with refused("these look like millimetres"):
        run.verify(files[6:9], far, name="far")
    assert [row.name for row in run.verify(files[10:12], poses[10:12]).history] == ["start", "next"]


def test_a_change_goes_with_the_capture_that_showed_it_where_more_images_take_its_place():
    step = Step(step=np.zeros(6), covariance=np.eye(6), p_value=1.0)
    facts = {
        "images": ("0.png",),
        "located": None,
        "camera": step,
        "scene": step,
        "detectable": (1.0, 1.0),
        "odds": 1.0,
    }
    rows = tuple(Verified(name=name, digests=(name,), **facts) for name in ("monday", "tuesday"))
    changes = tuple(Change(cause="camera", first=0, named=k) for k in range(2))
    history = History(calibration="c", captures=rows, changes=changes)
    assert without_part(history, ["wednesday"]) == history
    before = without_part(history, ["tuesday", "more"])
    assert before.captures == rows[:1] and [one.named for one in before.changes] == [0]


def test_the_poses_that_tell_most_are_those_of_the_run(done: Path, capsys):
    assert dispatch(["verify", str(done), "--check-poses", "--json"]) == 0
    poses = json.loads(capsys.readouterr().out)["poses"]
    assert len(poses) == 5 and len({one["image"] for one in poses}) == 5
    old = jcr.load_run(done).capture
    for one in poses:
        pose = old.base_from_gripper[old.images.index(one["image"])]
        np.testing.assert_allclose(one["base_from_gripper"], pose)
    found = [one["detectable_mm"] for one in poses]
    assert found == sorted(found, reverse=True) and found[-1] < 0.8 * found[0]


def test_images_of_another_scene_cannot_tell(out: Path, capture: Capture, tmp_path: Path, capsys):
    today = write_capture(tmp_path / "today", capture, capture.base_from_gripper, [10])
    Image.new("RGB", capture.image_size, (90, 90, 90)).save(today.folder / today.images[0], format="PNG")
    assert dispatch(["verify", str(out), str(tmp_path / "today"), "--quiet"]) == 3
    assert "cannot tell" in (said := capsys.readouterr().err) and "--new-scene" in said
    assert dispatch(["verify", str(out), str(tmp_path / "nothing"), "--quiet"]) == 2
    assert "no such capture" in capsys.readouterr().err


def test_a_new_image_of_a_fixed_camera_shows_rotation(out, capture, x, tmp_path, capsys):
    """A rotation about the camera's own centre moves pixels by a homography, whatever the scene."""
    run = out
    intrinsics = capture.intrinsics
    content = json.loads((capture.folder / "capture.json").read_text())
    (tmp_path / "camera.json").write_text(json.dumps(content["intrinsics"]))
    image = cv2.imread(str(capture.folder / capture.images[10]))
    cv2.imwrite(str(tmp_path / "overhead.png"), image)
    given = ["--name", "overhead", "--intrinsics", str(tmp_path / "camera.json")]
    assert dispatch(["add-camera", str(run), str(tmp_path / "overhead.png"), *given, "--quiet"]) == 0
    k = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]])
    axis, base_from_camera = np.array([0.6, -0.64, 0.48]), capture.base_from_gripper[10] @ x
    for deg in (0.0, 0.3):
        now_from_then = k @ rotation_exp(np.radians(deg) * axis) @ np.linalg.inv(k)
        seen = cv2.warpPerspective(image, now_from_then, image.shape[1::-1], flags=cv2.INTER_CUBIC)
        noise = np.random.default_rng(3).normal(0, 2, image.shape)
        today = write_capture(tmp_path / f"today{deg}", capture, capture.base_from_gripper, [10])
        new = np.clip(seen + noise, 0, 255).astype(np.uint8)
        cv2.imwrite(str(today.folder / "overhead_today.png"), new)
        facts = json.loads((today.folder / "capture.json").read_text())
        facts["cameras"] = {"overhead": {"mount": "base", "images": ["overhead_today.png"]}}
        (today.folder / "capture.json").write_text(json.dumps(facts))
        capsys.readouterr()
        status = dispatch(["verify", str(run), str(today.folder), "--json"])
        found = json.loads(capsys.readouterr().out)["cameras"]["overhead"]
        assert (status, found["moved"]) == ((3, True) if deg else (0, False))
        # Points that rotate by R in the camera's axes are seen by a camera that rotated by its inverse.
        along = found["drift_deg"] @ (-base_from_camera[:3, :3] @ axis)
        assert [along, np.linalg.norm(found["drift_deg"])] == pytest.approx([deg, deg], abs=0.06)


def test_a_run_is_calibrated_again_unless_the_camera_moved(out, capture, x, tmp_path, monkeypatch):
    made = list[Capture]()

    def calibrate(one: Capture, folder: Path, options: RunOptions, progress: object) -> RunResult:
        made.append(one)
        return begun(folder, one, options)

    monkeypatch.setattr(recalibrating, "calibrate", calibrate)
    rng = np.random.default_rng(4)
    still = with_robot_noise(capture.base_from_gripper, 0.2, 0.03, rng)
    bumped = with_robot_noise(capture.base_from_gripper @ x @ inverse(x @ BUMP), 0.2, 0.03, rng)
    old = jcr.load_run(out).capture
    taken = {"monday": write_capture(tmp_path / "monday", capture, still, [9, 10])}
    found = jcr.verify_run(out, taken)
    result = recalibrating.recalibrate(out, taken, tmp_path / "second", found)
    assert len(made[0]) == len(old) + 2 and made[0].intrinsics == old.intrinsics
    np.testing.assert_allclose(made[0].base_from_gripper[-2:], still[[9, 10]], atol=1e-9)
    np.testing.assert_array_equal(
        read_image(made[0].folder / made[0].images[0]), read_image(old.folder / old.images[0])
    )
    assert (result.state.version, result.state.predecessor) == (2, str(out.resolve()))
    # What is written to the folder later keeps the version.
    assert begun(tmp_path / "second", made[0], RunOptions()).state.version == 2
    taken["tuesday"] = write_capture(tmp_path / "tuesday", capture, bumped, [11])
    found = jcr.verify_run(out, taken)
    assert [move.since for move in found.moves] == ["tuesday"]
    recalibrating.recalibrate(out, taken, tmp_path / "third", found)
    assert len(made[1]) == 1
    with refused("holds a run"):
        recalibrating.recalibrate(out, taken, tmp_path / "third", found)


def test_a_calibration_of_another_scene_is_compared(out: Path, capture: Capture, x: np.ndarray, monkeypatch):
    before = jcr.load_run(out).found
    offset = np.array([3e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
    for step, moved in ((0.0, False), (1.0, True)):
        now = replace(before, on_gripper=retract(before.gripper_from_camera, step * offset))
        monkeypatch.setattr(
            recalibrating, "calibrate", lambda *_, now=now, **__: RunResult("new", calibration=now)
        )
        found = recalibrating.verify_by_new_scene(out, "other", capture)
        assert found.moved is moved and found.offset[0] == pytest.approx(step * 3e-3, abs=1e-9)
        assert ("the camera has moved by 3.00 mm" in found.finding) is moved
        np.testing.assert_allclose(found.covariance, 2 * before.covariance[:6, :6])


@pytest.mark.parametrize(("std_mm", "is_blind"), [(0.5, False), (20.0, True)])
def test_images_that_would_not_show_a_drift_that_matters_are_a_warning(std_mm: float, is_blind: bool):
    covariance = np.diag([*3 * [(1e-3 * std_mm) ** 2], *3 * [np.radians(0.05) ** 2]])
    judged = of_two_poses(np.zeros(6), covariance, TOLERANCE, ["0.png"], ())
    assert not judged.moved and judged.verdict == "accepted"
    assert any("would not be noticed" in note for note in judged.notes) is is_blind
    shift = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert of_two_poses(shift, covariance, TOLERANCE, ["0.png"], ()).moved is not is_blind


@pytest.fixture(scope="module")
def touched(done: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where images of the bundled run show six points, and where these are by its simulated truth."""
    from jcr.geometry import apply
    from jcr.pipeline.touch import surface_at

    calibration, capture, reconstruction = RunResult(done).of_wrist_camera()
    rng = np.random.default_rng(0)
    true = reference_of(capture.folder)
    lines = ["image, x_px, y_px, x_m, y_m, z_m"]
    for k in (0, 2, 4):
        name = capture.images[reconstruction.image_index[k]]
        found = 0
        while found < 2:
            x_px = rng.uniform((80, 60), (560, 420)).round()
            if (surface := surface_at(capture, reconstruction, name, x_px, "test")) is None:
                continue
            seen = surface[0]
            # By the true transform and this image's own gripper pose, at the depth that was found.
            recon_from_camera = reconstruction.recon_from_camera[k]
            assert calibration.scale is not None
            in_camera = calibration.scale * apply(np.linalg.inv(recon_from_camera), seen)
            pose = capture.base_from_gripper[reconstruction.image_index[k]]
            tip = apply(pose @ true, in_camera)
            lines.append(f"{name}, {x_px[0]}, {x_px[1]}, " + ", ".join(f"{v:.6f}" for v in tip))
            found += 1
    path = tmp_path_factory.mktemp("touch") / "touched.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_true_points_agree_and_a_tip_that_is_off_is_named_by_its_mean(done, touched, tmp_path, capsys):
    found = touch(done, touched)
    assert found.p_value > 0.01 and len(found.error) == 6 and found.rms < 3 * found.expected
    lines = [line.split(",") for line in touched.read_text().splitlines()]
    off = [lines[0], *([*line[:5], f" {float(line[5]) + 0.02:.6f}"] for line in lines[1:])]
    path = tmp_path / "off.csv"
    path.write_text("\n".join(",".join(line) for line in off))
    assert dispatch(["touch", str(done), str(path), "--json"]) == 3
    printed = json.loads(capsys.readouterr().out)
    assert printed["mean_mm"][2] == pytest.approx(20, abs=3) and printed["p"] < 1e-3


def test_rows_without_a_surface_or_repeated_are_left_out_and_named(done, touched, tmp_path, capsys):
    """One pixel without depth refused the whole table; a row that was copied counted twice."""
    from jcr.pipeline.touch import surface_at

    _, capture, reconstruction = RunResult(done).of_wrist_camera()
    lines = touched.read_text().splitlines()
    name = lines[1].split(",")[0]
    pixels = ((x, y) for x in range(0, 640, 8) for y in range(0, 480, 8))
    at = (capture, reconstruction, name)
    x, y = next(one for one in pixels if surface_at(*at, np.array(one, float), "test") is None)
    short = [line.replace("images/", "") for line in lines[1:]]
    path = tmp_path / "rows.csv"
    path.write_text("\n".join([lines[0], *short, short[1], f"{name}, {x}, {y}, 0.5, 0, 0"]))
    assert dispatch(["touch", str(done), str(path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [point["line"] for point in printed["points"]] == [2, 3, 4, 5, 6, 7]
    assert printed["points"][0]["image"] == name
    same, lost = printed["notes"]
    assert "line 8" in same and "line 3" in same and f"line 9: {name}, pixel {x}, {y}" in lost
    path.write_text("\n".join([lines[0], *short[:2], f"{name}, {x}, {y}, 0.5, 0, 0"]))
    with refused(f"2 points with a surface .line 4: {name}, pixel {x}, {y}"):
        touch(done, path)


HEADER = "image, x_px, y_px, x_m, y_m, z_m\n"
FAULTS = {
    "has no column y_px, x_m": "image, x_px\n", "line 2": f"{HEADER}images/0.png, 1, 2, a, 0, 0\n",
    "in metres": f"{HEADER}images/0.png, 1, 2, 300, 0, 0\n", "0 points; touch 3 or more": HEADER,
    "line 2: nothing.png, pixel 1, 2: nothing.png is not an image": HEADER + 3 * "nothing.png, 1, 2, 0, 0, 0\n",
    "outside of the image": f"{HEADER}00.jpg, 700, 2, 0, 0, 0\n",
}  # fmt: skip


@pytest.mark.parametrize("words", FAULTS)
def test_what_is_no_list_of_touched_points_is_refused(done: Path, tmp_path: Path, words: str):
    (tmp_path / "points.csv").write_text(FAULTS[words])
    with refused(words):
        touch(done, tmp_path / "points.csv")


def test_the_expected_errors_of_a_touch_are_those_of_its_click_depth_and_pose():
    """The p-value is uniform: errors drawn from the truth are as large as expected."""
    rng, count, draws = np.random.default_rng(0), 6, 400
    x = transform(rotation_exp(np.array([1.1, -0.7, 0.9])), np.array([0.03, -0.02, 0.06]))
    gripper = gripper_poses("varied", 3, np.array([0.5, 0.0, 0.0]), x, rng)[np.arange(count) // 2]
    in_camera = rng.uniform([-0.15, -0.1, 0.4], [0.15, 0.1, 0.6], (count, 3))
    noise = RobotNoise(translation=1e-3, rotation=np.radians(0.2), estimated=True)
    exact = Uncertainty(covariance=1e-14 * np.eye(7))
    calibration = hand_eye_of(x, uncertainty=exact, robot_noise=noise, intrinsics=INTRINSICS.with_std(None))
    std = np.full(count, 2e-3)
    covariance = error_covariance(calibration, gripper, np.arange(count) // 2, in_camera, std)
    squared = np.empty(draws)
    for k in range(draws):
        step = rng.normal(size=(3, 6)) * np.repeat([noise.translation, noise.rotation], 3)
        true = retract(gripper[::2], step)[np.arange(count) // 2]
        seen = in_camera.copy()
        seen *= 1 + std[:, None] * rng.normal(size=(count, 1)) / seen[:, 2:]
        seen[:, :2] += CLICK_PX * rng.normal(size=(count, 2)) * seen[:, 2:] / [INTRINSICS.fx, INTRINSICS.fy]
        tip = np.stack([apply(one @ x, p) for one, p in zip(true, in_camera, strict=True)])
        tip += noise.translation * rng.normal(size=(count, 3))
        surface = np.stack([apply(one @ x, p) for one, p in zip(gripper, seen, strict=True)])
        error = (tip - surface).ravel()
        squared[k] = error @ np.linalg.solve(covariance, error)
    assert squared.mean() == pytest.approx(3 * count, rel=0.1)


@pytest.mark.parametrize("kept", [0.0, 0.2])
def test_a_place_that_few_points_are_left_of_has_changed(kept: float):
    """A place with a fifth of its points, as unchanged ones seen from other poses may have, is not called changed."""
    rng = np.random.default_rng(0)
    middles = np.array([[-0.15, -0.05, 0.65], [0.05, -0.05, 0.65], [0.15, 0.05, 0.65]])
    x = (middles[:, None] + rng.uniform(-0.04, 0.04, (3, 50, 3))).reshape(-1, 3)
    left = np.r_[rng.random(50) < kept, np.ones(100, bool)]
    scene: Any = SimpleNamespace(
        tracks=SimpleNamespace(points_in_recon=x),
        known=SimpleNamespace(camera=INTRINSICS, recon_from_camera=np.eye(4)[None]),
        seen=np.ones((1, len(x)), bool),
        similarity=Similarity(np.eye(4), 1.0),
    )
    pose = CameraPose(
        a_from_camera=np.eye(4), covariance=np.eye(6), camera=INTRINSICS, inlier=left[left], std_px=0.3,
        rms_px=0.3,
    )  # fmt: skip
    none, x_px = np.zeros(0, int), project(INTRINSICS, x[left])
    placed = Registration(
        pose=pose, points_in_recon=x[left], x_px=x_px, row=none, row_x_px=np.zeros((0, 2)), row_point=none
    )
    share, places = OldScene._left(scene, [placed])
    assert share == pytest.approx(left.mean(), abs=0.05)
    assert len(places) == (kept == 0)
    if places:
        np.testing.assert_allclose(places[0], middles[0], atol=0.02)
