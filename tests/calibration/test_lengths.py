"""Lengths beside the robot's positions, and depth cameras whose scale is wrong: weighed or named, and corrected."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from analytic_scene import FOCAL_PX, HEIGHT, WIDTH, cast_depth, looking_at_table
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.checks.lengths import depth_check
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration, validated
from jcr.calibration.summary import details, summary
from jcr.camera import rays
from jcr.capture.images import encode_png, read_depth_images
from jcr.capture.read import read_capture
from jcr.depth.depth_camera import with_measured_depth
from jcr.files import write_bytes
from jcr.findings import Finding, FindingKind, sentence
from jcr.geometry import apply, inverse, rotation_exp, step_between, transform
from jcr.records import MATCHED, PRIOR, Capture, DepthCheck, Intrinsics, Reconstruction, Tracks
from refusal import refused
from scenes import capture_of, maps_of, no_depth, reconstruction_of
from simulation.boards import Sheet, with_sheet
from simulation.faults import Faults, faulty_capture, reconstructed

pytestmark = pytest.mark.slow


def calibrated(sheet: Sheet | None, pose_scale: float = 1.0, seed: int = 0) -> tuple[Calibration, np.ndarray]:
    """12 images, and the true transform."""
    rng = np.random.default_rng([seed, 12])
    bare = faulty_capture(rng, 12, Faults(pose_scale=pose_scale))
    found = bare if sheet is None else with_sheet(bare, rng, sheet)
    capture, reconstruction = reconstructed(bare, estimated=False)
    hand_eye = calibrate_reconstruction(capture, replace(reconstruction, tracks=found.tracks))
    return hand_eye, found.gripper_from_camera


@cache
def calibrated_alone(seed: int) -> Calibration:
    """The calibration of the same 12 images without a board."""
    return calibrated(None, seed=seed)[0]


def of_kind(hand_eye: Calibration, kind: FindingKind) -> Finding:
    (found,) = (one for one in hand_eye.findings if one.kind is kind)
    return found


def test_a_board_that_agrees_with_the_robot_makes_the_scale_more_certain():
    alone = calibrated_alone(0)
    both, x = calibrated(Sheet())
    assert both.covariance[6, 6] < 0.9 * alone.covariance[6, 6]
    (board,) = both.lengths
    assert board.name == "board" and board.used and abs(board.robot_longer_percent) < 1
    assert not any(one.kind is FindingKind.SCALE_FROM_ROBOT for one in both.findings)
    assert both.converged and not both.warnings
    step = step_between(both.gripper_from_camera, x)
    assert (np.abs(step) < 3 * np.sqrt(np.diag(both.covariance)[:6])).all()
    assert both.uncertainty.budget is not None
    assert np.allclose(
        np.sum(list(vars(both.uncertainty.budget).values()), axis=0), both.covariance, rtol=0, atol=1e-9
    )


def test_the_stated_error_of_the_depth_images_refers_to_the_scale_that_a_board_has_changed(monkeypatch):
    alone = calibrated_alone(0).scale

    def off_percent(scale: float) -> float:
        return 100 * (1.004 * alone / scale - 1)

    def measured(_: Capture, __: Reconstruction, hand_eye: Calibration) -> DepthCheck:
        facts = {"noise_m": 0.0, "noise_per_m": 0.0, "distances_m": (0.4, 0.8), "images": 12, "features": 500}
        return DepthCheck(off_percent=off_percent(hand_eye.scale), std_percent=0.1, **facts)

    monkeypatch.setattr("jcr.calibration.checks.lengths.depth_check", measured)
    found, _ = calibrated(Sheet())
    assert found.depth_check is not None and abs(off_percent(found.scale) - 0.4) > 0.01
    assert found.depth_check.off_percent == pytest.approx(off_percent(found.scale), abs=1e-6)


@pytest.mark.parametrize("pose_scale", [1.015, 0.95])
def test_a_board_that_contradicts_the_robot_s_lengths_is_named_and_not_used(pose_scale: float):
    """A misprinted board is likelier than positions that are all too long, which no image shows."""
    hand_eye, _ = calibrated(Sheet(bend_m=2e-3), pose_scale)
    named = of_kind(hand_eye, FindingKind.BOARD_SIZE)
    assert named.std is not None and named.value == pytest.approx(pose_scale - 1, abs=3 * named.std)
    assert hand_eye.converged and named.shift is None and not hand_eye.lengths[0].used


def test_a_board_of_30_mm_given_for_one_of_25_rejects_the_calibration_in_one_line():
    hand_eye, _ = calibrated(Sheet(stated_m=0.030))
    assert not hand_eye.converged
    (line,) = hand_eye.warnings
    assert "16.6 ± 0.2" in line and "% smaller than given; measure its squares" in line


@pytest.mark.parametrize(("sheet", "kind"), [
    (Sheet(stretch=0.01), FindingKind.BOARD_STRETCHED),
    (Sheet(moved_m=3e-3), FindingKind.BOARD_MOVED),
    (Sheet(moved_m=1e-3), FindingKind.BOARD_MOVED),
    (Sheet(size_error=0.02), FindingKind.BOARD_SIZE),
    (Sheet(bend_m=3e-3), FindingKind.BOARD_BENT),
])  # fmt: skip
def test_a_wrong_board_is_named_and_leaves_the_result_as_it_is_without(sheet: Sheet, kind: FindingKind):
    alone = calibrated_alone(1)
    hand_eye, x = calibrated(sheet, seed=1)
    named = of_kind(hand_eye, kind)
    if kind is FindingKind.BOARD_STRETCHED:
        assert named.value is not None and named.std is not None
        assert named.value == pytest.approx(sheet.stretch, abs=3 * named.std) and named.std < 1e-3
    assert named.severity == ("informs" if kind is FindingKind.BOARD_BENT else "warns")
    # The shape of a bent board, and the corners of a moved one in most images, are still good.
    is_used = kind in {FindingKind.BOARD_BENT, FindingKind.BOARD_MOVED}
    assert hand_eye.converged and any(one.used for one in hand_eye.lengths) == is_used
    std, without = (np.sqrt(np.diag(one.covariance)) for one in (hand_eye, alone))
    assert (std < 1.1 * without).all()
    assert (np.abs(step_between(hand_eye.gripper_from_camera, x)) < 3 * std[:6]).all()


def test_the_side_of_a_board_of_unknown_size_is_stated_by_the_robot():
    hand_eye, _ = calibrated(Sheet(stated_m=None), pose_scale=1.016)
    side = of_kind(hand_eye, FindingKind.BOARD_SIDE)
    assert side.value is not None and side.std is not None
    assert side.value == pytest.approx(1.016 * 0.025, abs=3 * side.std) and side.std < 1e-4
    assert hand_eye.converged and hand_eye.lengths == ()
    assert f"\nNote        {sentence(side)}\n" in summary(hand_eye)


INTRINSICS = Intrinsics(FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
OFF, NOISE_PER_M, SCALE = 1.03, 0.004, 0.1
"""Too long by 3 %; sigma 2 mm at 0.7 m."""
X = transform(rotation_exp(np.array([0.1, -0.2, 1.5])), np.array([0.05, -0.02, 0.08]))


def with_depth(capture: Capture, reconstruction: Reconstruction, hand_eye: Calibration) -> Calibration:
    found = depth_check(capture, reconstruction, hand_eye)
    return replace(hand_eye, depth_check=found)


@pytest.fixture(scope="module")
def measured(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Capture, Reconstruction, Calibration, np.ndarray]:
    """A capture with depth images, its features, the calibration, and the true depth."""
    folder, draw = tmp_path_factory.mktemp("depth"), np.random.default_rng(0)
    base_from_camera = looking_at_table(12)
    true = np.stack([cast_depth(pose, INTRINSICS) for pose in base_from_camera])
    wrong = OFF * true + NOISE_PER_M * true**2 * draw.normal(size=true.shape)
    wrong[:, 50:60, 100:120] = 0
    names = tuple(f"depth/{k}.png" for k in range(len(true)))
    for name, depth in zip(names, wrong, strict=True):
        write_bytes(folder / name, encode_png(np.rint(1e3 * depth).clip(0, 65535).astype(np.uint16)))
    gripper = base_from_camera @ inverse(X)
    gripper[:, :3, 3] += 3e-4 * draw.normal(size=(12, 3))
    facts = {"image_size": (WIDTH, HEIGHT), "intrinsics": INTRINSICS, "depths": names}
    capture = capture_of(gripper, folder=folder, **facts)
    base_from_recon = transform(rotation_exp(np.array([0.3, -2.0, 0.5])), np.array([0.4, 0.2, -0.7]))
    cameras = inverse(base_from_recon) @ base_from_camera
    cameras[:, :3, 3] /= SCALE
    return capture, _reconstruction(cameras, true, draw), solve_hand_eye(gripper, cameras), true


def _reconstruction(cameras: np.ndarray, true: np.ndarray, draw: np.random.Generator) -> Reconstruction:
    count = 150
    image = np.repeat(np.arange(len(true)), count)
    v, u = draw.integers(1, HEIGHT - 1, image.shape), draw.integers(1, WIDTH - 1, image.shape)
    hit = true[image, v, u] > 0
    image, v, u = image[hit], v[hit], u[hit]
    z = true[image, v, u] / SCALE * (1 + 1e-3 * draw.normal(size=len(u)))
    points = np.stack(
        [apply(cameras[i], d * r) for i, d, r in zip(image, z, rays(INTRINSICS)[v, u], strict=True)]
    )
    x_px, point = np.stack([u, v], 1).astype(float), np.arange(len(image))
    tracks = Tracks(image=image, x_px=x_px, point=point, points_in_recon=points)
    maps = maps_of(np.zeros((*true.shape, 3)), INTRINSICS, **no_depth(true.shape))
    return reconstruction_of(cameras, intrinsics=INTRINSICS, tracks=tracks, backend="cast", pointmaps=maps)


def test_the_robot_shows_that_the_depth_is_too_long_and_how_noisy(measured: tuple):
    capture, reconstruction, hand_eye, _ = measured
    check = depth_check(capture, reconstruction, hand_eye)
    assert check is not None and check.images == 12 and check.features > 500
    assert check.off_percent == pytest.approx(3.0, abs=min(3 * check.std_percent, 0.5))
    depth = np.array([0.65, 0.75])
    noise = np.hypot(check.noise_m, check.noise_per_m * depth**2)
    assert noise == pytest.approx(NOISE_PER_M * depth**2, rel=0.35)
    assert (check.std_m(depth) > noise).all()
    content = replace(hand_eye, depth_check=check)
    said = f"{check.off_percent:+.2f} ± {check.std_percent:.2g} %"
    assert f"Depth camera: scale error, compared with the robot: {said}" in details(content)
    assert validated(json.loads(json.dumps(content.as_json())), Path("a")) == content
    assert depth_check(replace(capture, depths=None), reconstruction, hand_eye) is None
    # Depths that are 3 % too long make lengths by the robot look 3 % too short. So few observations are not adjusted,
    # which could not be done with points that one image shows.
    tracks = reconstruction.tracks
    tracks = replace(tracks, image=tracks.image[::10], x_px=tracks.x_px[::10], point=tracks.point[::10])
    (length,) = calibrate_reconstruction(capture, replace(reconstruction, tracks=tracks)).lengths
    assert length.name == "depth camera"
    assert length.robot_longer_percent == pytest.approx(100 * (1 / OFF - 1), abs=0.5)


def test_the_map_gets_the_depth_with_the_robots_scale_and_its_own_sigma(measured: tuple):
    capture, reconstruction, hand_eye, true = measured
    hand_eye = with_depth(capture, reconstruction, hand_eye)
    mapped, notes = with_measured_depth(capture, reconstruction, hand_eye.depth_check, hand_eye.scale)
    found = mapped.dense
    assert not notes and (found.reason == np.where(found.confidence > 0, MATCHED, 0)).all()
    there = found.confidence > 0
    assert there.mean() > 0.5 * (true > 0).mean() and not there[:, 51:59, 101:119].any()
    z = hand_eye.scale * np.stack(
        [
            apply(inverse(c), p)[..., 2]
            for c, p in zip(mapped.recon_from_camera, found.points_in_recon, strict=True)
        ]
    )
    off, sigma = (z - true)[there], hand_eye.scale * np.asarray(found.depth_std)[there]
    assert abs(np.median(off / true[there])) < 3e-3  # 3 % before
    assert (np.abs(off) < sigma).mean() > 0.6 and (np.abs(off) < 3 * sigma).mean() > 0.97


def test_what_several_images_show_stays_where_the_depth_camera_shows_otherwise(measured: tuple):
    capture, reconstruction, hand_eye, true = measured
    hand_eye = with_depth(capture, reconstruction, hand_eye)
    # A sheet that depth cameras see through: half of the matched depth lies 10 cm nearer; filled planes elsewhere.
    nearer = true.copy()
    nearer[:, :, : WIDTH // 2] -= 0.1
    matched = (true > 0.2).astype(float)
    points = np.stack(
        [
            apply(c, d[..., None] / SCALE * rays(INTRINSICS))
            for c, d in zip(reconstruction.recon_from_camera, nearer, strict=True)
        ]
    )
    reason = np.where(matched > 0, MATCHED, 0).astype(np.uint8)
    reason[:, :20] = np.where(matched[:, :20] > 0, PRIOR, 0)
    std = np.full(true.shape, 5e-4 / SCALE)
    dense = replace(
        reconstruction.dense, points_in_recon=points, confidence=matched, reason=reason, depth_std=std
    )
    mapped, notes = with_measured_depth(
        capture, replace(reconstruction, pointmaps=dense), hand_eye.depth_check, hand_eye.scale
    )
    found = mapped.dense
    assert notes and "differ" in notes[0]
    left = np.zeros(true.shape, bool)
    left[:, 20:, : WIDTH // 2] = matched[:, 20:, : WIDTH // 2] > 0
    assert (found.points_in_recon == points)[left].mean() > 0.99
    given_way = (found.reason == MATCHED) & (reason == PRIOR)
    assert given_way.sum() > 0.5 * (reason == PRIOR).sum()
    assert (np.asarray(found.depth_std) <= std + 1e-12)[(reason == MATCHED)].all()


def test_depth_of_another_unit_is_named_and_left_out(measured: tuple):
    capture, reconstruction, hand_eye, _ = measured
    check = depth_check(capture, reconstruction, hand_eye)
    assert check is not None
    found, notes = with_measured_depth(
        capture, reconstruction, replace(check, off_percent=900.0), hand_eye.scale
    )
    assert found is reconstruction and "+900 % off by the robot" in notes[0]
    _, notes = with_measured_depth(capture, reconstruction, hand_eye.depth_check, hand_eye.scale)
    assert "the robot cannot tell" in notes[0]


def test_depth_images_of_two_units_are_no_measure_of_the_scale(measured: tuple, tmp_path: Path):
    """Half of the images in twice the unit: no depth agreed with the median of all, which ended with a ValueError."""
    capture, reconstruction, hand_eye, true = measured
    for k, name in enumerate(capture.depths):
        depth = np.rint(1e3 * (1 + k % 2) * true[k]).clip(0, 65535).astype(np.uint16)
        write_bytes(tmp_path / name, encode_png(depth))
    assert depth_check(replace(capture, folder=tmp_path), reconstruction, hand_eye) is None


def test_depth_images_of_a_capture_are_found_and_faults_named(tmp_path: Path):
    folder = tmp_path / "capture"
    frames = []
    for k in range(4):
        write_bytes(folder / f"images/{k}.png", encode_png(np.full((20, 30, 3), 50 * k, np.uint8)))
        write_bytes(folder / f"depth/{k}.png", encode_png(np.full((20, 30), 700 + k, np.uint16)))
        pose = transform(rotation_exp(np.array([0, 0.1 * k, 0])), np.array([0.1 * k, 0, 0.3]))
        frames.append(
            {"image": f"images/{k}.png", "base_from_gripper": pose.tolist(), "depth": f"depth/{k}.png"}
        )
    del frames[3]["depth"]

    def written(**changed: object) -> Path:
        content = {"frames": [frames[0] | changed, *frames[1:]], "intrinsics": None}
        (folder / "capture.json").write_text(json.dumps(content))
        return folder

    capture = read_capture(written())
    assert capture.depths == ("depth/0.png", "depth/1.png", "depth/2.png", None)
    assert read_depth_images(folder / "depth/2.png", (30, 20))[5, 5] == pytest.approx(0.702)
    left = read_capture(written(depth=5))
    assert left.images == tuple(f"images/{k}.png" for k in (1, 2, 3))
    assert any("frame 0" in note and "Input should be a valid string" in note for note in left.notes)
    for wrong, said in (("../x.png", "depth of frame 0.*leads out of"), ("depth/9.png", "not there")):
        with refused(said):
            read_capture(written(depth=wrong))
    with refused("16 bits"):
        read_depth_images(folder / "images/0.png", (30, 20))
    with refused("align depth"):
        read_depth_images(folder / "depth/0.png", (60, 40))
