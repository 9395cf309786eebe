"""The map and a robot against a scene whose every distance is known: a table with a box and a ball."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.special import expit

import analytic_scene
from analytic_scene import BALL_CENTER, BOX_CENTER, BOX_HALF, WORKSPACE, signed_distance
from jcr.records import MATCHED, PRIOR, PointCloud
from jcr.scene.map_file import load_map
from jcr.scene.options import MapOptions
from places import ROOT
from refusal import refused

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


pytestmark = pytest.mark.slow

OPTIONS = MapOptions(workspace=WORKSPACE)
INSIDE_BOX = BOX_CENTER - [0, 0, 0.01]
UNDER_TABLE = np.array([0.0, 0.0, -0.08])
FREE_SPOT = np.array([0.0, 0.2, 0.15])
OUTSIDE = np.array([2.0, 0.0, 0.1])


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return analytic_scene.cloud()


@pytest.fixture(scope="module")
def scene(cloud: PointCloud) -> "SceneMap":
    """The map of the analytic scene."""
    from jcr.scene.build import build_scene

    return build_scene(cloud, OPTIONS)


def uniform(count: int, seed: int = 0) -> np.ndarray:
    low, high = np.reshape(WORKSPACE, (2, 3))
    return np.random.default_rng(seed).uniform(low + 0.001, high - 0.001, (count, 3))


def near_surface(count: int) -> np.ndarray:
    """Points within 6 cm of the true surface."""
    x = uniform(20 * count)
    return x[np.abs(signed_distance(x)) < 0.06][:count]


def test_what_no_ray_crossed_and_what_is_outside_is_unknown(scene: "SceneMap"):
    hidden = np.stack([INSIDE_BOX, BALL_CENTER, UNDER_TABLE, [0.0, 0.0, -0.02], OUTSIDE])
    sample = scene.query(hidden)
    assert sample.unknown.all() and (sample.occupancy == 0.5).all() and (sample.label == 0).all()
    assert repr(sample) == "<Sample of 5 points, 5 unseen>" and " % unseen; occupancy, color" in repr(scene)
    assert (scene.query(hidden, unknown="occupied").occupancy == 1).all()
    assert (scene.query(hidden, unknown="free").occupancy == 0).all()
    just_out = np.array([[0.0, 0.0, 0.601], [0.0, 0.0, 5.0], [-0.451, 0, 0.3], [1e30, 0, 0], [0, -3e9, 0]])
    sample = scene.query(just_out)
    assert sample.unknown.all()
    assert all(np.isnan(values).all() for values in (sample.distance, sample.gradient, sample.color))


def test_hidden_places_are_not_free_and_seen_space_is_not_solid(scene: "SceneMap"):
    x = uniform(200_000)
    true, sample = signed_distance(x), scene.query(x)
    deep, clear, solid = true < -0.005, true > 0.005, sample.occupancy >= 0.5
    assert deep.sum() > 1000 and (~sample.unknown & ~solid)[deep].mean() < 0.001
    assert (~sample.unknown)[clear].mean() > 0.3 and (solid & ~sample.unknown)[clear].mean() < 0.002


def test_the_planner_chooses_how_unknown_counts(scene: "SceneMap"):
    from jcr.scene.scene_map import FREE, OCCUPIED, UNKNOWN

    centers = np.stack([FREE_SPOT, UNDER_TABLE, BOX_CENTER + [0, 0, BOX_HALF[2]], OUTSIDE])
    radii = np.array([0.05, 0.01, 0.02, 0.05])
    state = scene.check_spheres(centers, radii, unknown="report").tolist()
    assert state == [FREE, UNKNOWN, OCCUPIED, UNKNOWN]
    assert scene.check_spheres(centers, radii).tolist() == [False, True, True, True]
    assert scene.check_spheres(centers, radii, unknown="free").tolist() == [False, False, True, False]


def test_distances_and_gradients_are_those_of_the_box_and_the_ball(scene: "SceneMap"):
    x = uniform(200_000)
    true = signed_distance(x)
    beside = (true > 0.01) & (true < 0.15) & ~scene.query(x).unknown
    x, true = x[beside], true[beside]
    sample = scene.query(x)
    assert np.percentile(np.abs(sample.distance - true), 95) < 0.0025
    step = 1e-4 * np.eye(3)
    gradient = np.stack([(signed_distance(x + h) - signed_distance(x - h)) / 2e-4 for h in step], -1)
    smooth = np.linalg.norm(gradient, axis=1) > 0.99
    alike = (gradient * sample.gradient).sum(1)[smooth]
    assert np.median(alike) > 0.99
    assert np.percentile(np.linalg.norm(sample.gradient, axis=1), 90) < 1.1


def test_noise_of_the_points_does_not_move_the_surface():
    from jcr.scene.build import build_scene

    noisy = build_scene(analytic_scene.cloud(30_000, noise=0.0016), OPTIONS)
    x = uniform(200_000)
    true = signed_distance(x)
    near = (true > 0.005) & (true < 0.03) & ~noisy.query(x).unknown
    assert abs(np.median(noisy.query(x[near], "free").distance - true[near])) < 0.0005


def test_spheres_touch_what_they_reach_and_nothing_else(scene: "SceneMap"):
    centers = uniform(100_000)
    radii = np.random.default_rng(1).uniform(0.005, 0.05, len(centers))
    true = signed_distance(centers)
    answer = scene.check_spheres(centers, radii, unknown="free")
    seen = (true > 0) & ~scene.query(centers).unknown  # the table's lower side is known to nobody
    assert answer[seen & (true < radii - 0.006)].mean() > 0.998
    assert answer[seen & (true > radii + 0.006)].mean() < 0.001
    # To be careful frees nothing, but for the half cell that two distance grids may differ by.
    assert scene.check_spheres(centers, radii + scene.cell / 2)[answer].all()


def test_colours_and_labels_are_learnt(scene: "SceneMap", cloud: PointCloud):
    x = cloud.points_in_base
    sample = scene.query(x)
    assert np.abs(sample.color - analytic_scene.true_color(x)).mean() < 0.03
    assert (sample.label == cloud.label).mean() > 0.99
    assert scene.label_names == analytic_scene.LABELS


@pytest.fixture(scope="module")
def untrained(cloud: PointCloud) -> "SceneMap":
    """The published representation without a step of training."""
    from jcr.paper.fields import published_scene

    return published_scene(cloud, replace(OPTIONS, preset="paper", max_seconds=0.0, cell=0.03))


def test_the_published_representation_is_plain_torch(untrained: "SceneMap"):
    import torch

    scene = untrained
    box, x = torch.tensor(scene.box, dtype=torch.float32), torch.rand(50, 3)
    field = next(one for one in scene.fields.of if "color" in one.heads)
    # The longest side spans [-1, 1].
    scale = 2 * np.pi / float((box[1] - box[0]).max())
    angle = torch.cat([(x - box.mean(0)).T * scale * 2.0**k for k in range(10)])
    plain = torch.nn.Sequential(field.hidden, torch.nn.ReLU(), field.heads["color"])
    torch.testing.assert_close(
        field(x)["color"], plain(torch.cat([angle.sin(), angle.cos()]).T), rtol=1e-4, atol=1e-4
    )
    assert field.hidden.weight.shape == (256, 60)


@pytest.mark.long
def test_the_published_representation_learns_the_scene(cloud: PointCloud):
    import torch

    from jcr.paper.fields import train_fields

    fields, _ = train_fields(cloud, MapOptions(steps=250))
    surface = torch.tensor(cloud.points_in_base[:20_000], dtype=torch.float32)
    points = uniform(100_000)
    free = torch.tensor(points[signed_distance(points) > 0.03], dtype=torch.float32)
    assert (fields["occupancy"](surface)["occupancy"] > 0).float().mean() > 0.85
    assert (fields["occupancy"](free)["occupancy"] < 0).float().mean() > 0.9
    color = analytic_scene.true_color(cloud.points_in_base[:20_000])
    assert np.abs(fields["color"](surface)["color"].numpy() - color).mean() < 0.12
    assert (fields["label"](surface)["label"].argmax(1).numpy() == cloud.label[:20_000]).mean() > 0.95


def test_published_networks_answer_everywhere_and_unknown_stands_beside(untrained: "SceneMap"):
    import torch

    scene = untrained
    x = np.concatenate([uniform(5000), OUTSIDE[None], UNDER_TABLE[None]])
    raw = scene.fields(torch.tensor(x).float(), scene.properties)
    for unknown in ("occupied", "free", "report"):
        sample = scene.query(x, unknown)  # pyright: ignore[reportArgumentType]
        np.testing.assert_allclose(sample.occupancy, expit(raw["occupancy"][:, 0].numpy()), atol=1e-6)
        np.testing.assert_allclose(sample.color, raw["color"].clamp(0, 1).numpy(), atol=1e-6)
        assert np.array_equal(sample.label, raw["label"].argmax(1).numpy())
        assert sample.unknown[-2] and np.isnan(sample.std).all()
    assert 0.2 < sample.unknown.mean() < 0.8
    z = torch.tensor(x[:10], dtype=torch.float32, requires_grad=True)
    (gradient,) = torch.autograd.grad(scene.query(z).occupancy.sum(), z)
    assert (gradient.norm(dim=1) > 0).all()


@pytest.fixture(scope="module")
def uncertain(scene: "SceneMap", cloud: PointCloud, tmp_path_factory: pytest.TempPathFactory) -> "SceneMap":
    """The map with a calibration that has errors of 2 mm, 0.2° and 0.3 % per axis."""
    from jcr.scene.uncertainty import MapUncertainty, _depth_std

    scene.save(file := tmp_path_factory.mktemp("uncertain") / "map.safetensors")
    made = load_map(file)
    spread = np.diag(np.r_[[2e-3] * 3, [np.radians(0.2)] * 3, 0.003] ** 2)
    made.set_uncertainty(
        MapUncertainty(
            order=("a", "b"),
            joint=np.array([[2.0, 0.5], [0.5, 1.0]]),
            middle=np.zeros(3),
            similarity=spread,
            shape_m=3e-4,
            look_std_m=2e-3,
            lower=made.box[0],
            block_m=4 * made.cell,
            depth_std=_depth_std(made, cloud),
        )
    )
    return made


def test_std_covers_the_errors_of_drawn_calibrations(uncertain: "SceneMap"):
    """Draw the true surface about the map's, as often as the covariance says; spheres at 0.95 and their probability."""
    from jcr.geometry import rotation_exp

    draw, x = np.random.default_rng(0), near_surface(8000)
    seen = uncertain.query(x, unknown="free")
    x = x[(seen.distance > 0.01) & (seen.distance < 0.05) & ~uncertain.query(x).unknown]
    sample = uncertain.query(x, unknown="free")
    radius = sample.distance + draw.uniform(-0.008, 0.004, len(x))
    free = ~uncertain.check_spheres(x, radius, "free", confidence=0.95)
    probability = uncertain.check_spheres(x, radius, "free", probability=True)
    assert np.array_equal(free, probability < 0.05) or (free != (probability < 0.05)).mean() < 0.001
    off, wrong, collided = [], 0, 0
    for step in draw.multivariate_normal(np.zeros(7), uncertain.uncertainty.similarity, 60):
        in_map = (x - step[:3]) @ rotation_exp(step[3:6]) / np.exp(step[6])
        true = signed_distance(in_map)
        off.append((true - sample.distance) / sample.std)
        wrong += int((free & (true < radius)).sum())
        collided += int((true < radius).sum())
    assert 0.6 < np.std(off) < 1.2
    assert wrong < 0.05 * collided
    assert free.mean() > 0.05
    # Spheres that another image located are less certain.
    elsewhere = uncertain.check_spheres(
        x, radius, "free", confidence=0.95, center_std=uncertain.uncertainty.look_std_m
    )
    assert elsewhere[~free].all() and elsewhere.sum() > (~free).sum()


def test_a_point_about_which_the_scene_may_be_rotated_is_certain_and_others_move_by_their_lever():
    from jcr.scene.uncertainty import MapUncertainty

    rng = np.random.default_rng(0)
    middle, pivot, turn, lever = rng.normal(size=(4, 3))
    step = np.r_[np.cross(turn, middle - pivot), turn, 0.0]
    made = MapUncertainty(
        order=(), joint=np.zeros((0, 0)), middle=middle, similarity=np.outer(step, step), shape_m=0.0,
        look_std_m=0.0, lower=np.zeros(3), block_m=1.0, depth_std=np.zeros((1, 1, 1)),
    )  # fmt: skip
    std = made.surface_std(np.stack([pivot, pivot + lever]), np.tile([[0.0, 0.6, 0.8]], (2, 1)))
    moved = np.cross(turn, lever)
    np.testing.assert_allclose(std, [0.0, abs(0.6 * moved[1] + 0.8 * moved[2])], atol=1e-7)


def test_the_file_keeps_the_joint_covariance_and_the_answers(uncertain: "SceneMap", tmp_path: Path):
    uncertain.save(tmp_path / "map.safetensors")
    fresh, x = load_map(tmp_path), uniform(2000)
    assert fresh.uncertainty is not None and uncertain.uncertainty is not None
    assert fresh.uncertainty.order == ("a", "b")
    for name, value in vars(uncertain.uncertainty).items():
        assert np.array_equal(getattr(fresh.uncertainty, name), value), name
    assert np.array_equal(fresh.query(x).std, uncertain.query(x).std, equal_nan=True)
    assert np.array_equal(
        fresh.check_spheres(x, 0.02, confidence=0.95), uncertain.check_spheres(x, 0.02, confidence=0.95)
    )
    assert 0.003 < fresh.margin_95 < 0.02
    for wrong in (0.0, 1.0, -0.5):
        with refused("between 0 and 1"):
            fresh.check_spheres(x, 0.02, confidence=wrong)


def test_a_map_without_uncertainty_refuses_a_confidence(scene: "SceneMap"):
    with refused("no uncertainty"):
        scene.check_spheres(FREE_SPOT[None], 0.02, confidence=0.95)
    assert np.isnan(scene.query(FREE_SPOT[None]).std).all()


def test_the_same_seed_gives_the_same_map_and_torchs_own_state_stays():
    import torch

    from jcr.scene.build import build_scene

    cloud, coarse = analytic_scene.cloud(5000), replace(OPTIONS, cell=0.03)
    threads, state, x = torch.get_num_threads(), torch.get_rng_state(), uniform(20_000)
    one = build_scene(cloud, coarse)
    assert torch.get_num_threads() == threads and (torch.get_rng_state() == state).all()
    torch.rand(7)
    raw, again = (
        {name: value.numpy() for name, value in of.fields(torch.tensor(x).float(), of.properties).items()}
        for of in (one, build_scene(cloud, coarse))
    )
    outputs = {"occupancy": 1, "color": 3, "label": len(analytic_scene.LABELS)}
    assert {name: value.shape[1] for name, value in raw.items()} == outputs
    assert all(np.array_equal(again[name], value) for name, value in raw.items())
    seen = ~one.query(x).unknown
    np.testing.assert_allclose(expit(raw["occupancy"][seen, 0]), one.query(x).occupancy[seen], atol=1e-6)
    untrained = [build_scene(cloud, replace(coarse, map_seed=k, max_seconds=0.0)) for k in (0, 1)]
    assert not np.array_equal(untrained[0].query(x).color, untrained[1].query(x).color)


def test_torch_differentiates_every_answer(scene: "SceneMap"):
    import torch

    def wanted(x: np.ndarray) -> torch.Tensor:
        return torch.tensor(x, dtype=torch.float32, requires_grad=True)

    near = near_surface(6000)
    near = near[~scene.query(near).unknown]
    beside, on = (np.abs(signed_distance(near)) > 0.02), np.abs(signed_distance(near)) < 0.004
    x = wanted(near[beside])
    sample = scene.query(x)
    (by_torch,) = torch.autograd.grad(sample.distance.sum(), x)
    # The one is of the trilinear interpolant, the other its smoothed gradient.
    assert (by_torch - sample.gradient).norm(dim=1).median() < 0.2
    assert (by_torch * sample.gradient).sum(1).median() > 0.97
    x = wanted(near[on])
    sample = scene.query(x)
    (of_color,) = torch.autograd.grad(sample.color.sum(), x)
    assert (of_color.norm(dim=1) > 1).float().mean() > 0.9
    (of_occupancy,) = torch.autograd.grad(sample.occupancy.sum(), x)
    step = 2e-5 * torch.nn.functional.normalize(of_occupancy, dim=1)
    with torch.no_grad():
        rise = scene.query(x + step).occupancy - sample.occupancy
    steep = of_occupancy.norm(dim=1) > 10
    assert steep.sum() > 20
    assert (rise[steep] / 2e-5 / of_occupancy.norm(dim=1)[steep]).median() == pytest.approx(1, abs=0.1)


def test_a_loaded_map_gives_eight_threads_the_answers_of_the_saved_one(scene: "SceneMap", tmp_path: Path):
    import torch

    x = np.concatenate([uniform(50_000), OUTSIDE[None]])
    names = ("occupancy", "unknown", "distance", "gradient", "color", "label")

    def answers(of: "SceneMap", at: "np.ndarray | torch.Tensor") -> list[np.ndarray]:
        sample = of.query(at)
        return [np.asarray(getattr(sample, name)) for name in names] + [of.check_spheres(x, 0.02)]

    expected = answers(scene, x)
    scene.save(tmp_path / "map.safetensors")
    fresh = load_map(tmp_path)  # nothing is cached yet, so that all threads compute the distances at once
    assert fresh.label_names == scene.label_names and np.array_equal(fresh.box, scene.box)
    assert fresh.history == scene.history
    tensor = torch.tensor(x, dtype=torch.float32)
    with ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda k: answers(fresh, tensor if k % 2 else x), range(16)):
            for answer, right in zip(found, expected, strict=True):
                assert np.array_equal(answer, right, equal_nan=answer.dtype.kind == "f")


def test_questions_and_clouds_that_make_no_sense_are_refused(scene: "SceneMap", cloud: PointCloud):
    from jcr.scene.build import build_scene

    for points, words in (
        (np.zeros((4, 2)), r"\(n, 3\)"),
        (np.array([[0.0, 0, 0], [0, np.nan, 0]]), "row 1 is not finite"),
    ):
        # Past the shape checks of the test run, as a user's call comes.
        with refused(words):
            scene._points(points, "points")
    for words, centers, radii in (
        ("negative", np.zeros((2, 3)), np.array([0.1, -0.1])),
        ("does not fit", np.zeros((2, 3)), np.zeros(3)),
        ("not finite", np.full((2, 3), np.nan), 0.1),
    ):
        with refused(words):
            scene.check_spheres(centers, radii)
    with refused("NaN or infinity"):
        replace(cloud, points_in_base=cloud.points_in_base + np.full((len(cloud.points_in_base), 1), np.nan))
    inverted, far = (0.4, -0.4, 0.0, -0.4, 0.4, 0.6), (3.0, 3.0, 3.0, 4.0, 4.0, 4.0)
    for words, points, options in (
        ("points lie in the workspace", cloud, replace(OPTIONS, workspace=far)),
        ("minima below", cloud, replace(OPTIONS, workspace=inverted)),
    ):
        with refused(words):
            build_scene(points, options)


def test_damaged_and_foreign_map_files_are_named(scene: "SceneMap", tmp_path: Path):
    import torch

    path = tmp_path / "map.safetensors"
    with refused("no map here"):
        load_map(tmp_path)
    scene.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with refused("damaged"):
        load_map(tmp_path)
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(2)}, path)
    with refused("no map of jcr"):
        load_map(tmp_path)


def test_rays_cross_what_is_before_a_wall_and_hit_the_wall() -> None:
    from jcr.scene.seen_space import CROSSED, HIT, carve

    side = np.linspace(-0.05, 0.05, 101)
    wall = np.stack([*np.meshgrid(side, side), np.full((101, 101), 0.002)], -1).reshape(-1, 3)
    center = np.array([[0.0, 0.0, 0.5]])
    box = np.array([[-0.1, -0.1, -0.04], [0.1, 0.1, 0.3]])

    def states(measured: bool) -> np.ndarray:
        rows = np.zeros(len(wall), int)
        seen = carve(wall, rows, center, box, 0.01, np.full(len(wall), measured))
        return seen.state.numpy()[:, 10, 10]  # of the cells beside the axis, from z = -0.04 on

    column = states(True)
    assert column.tolist()[:4] == [0, 0, 0, HIT]  # half a cell behind the wall, and nothing farther behind
    assert column[4] & HIT
    assert (column[5:] & CROSSED).all()
    assert not (states(False) & CROSSED).any() and (states(False) & HIT).any()


def test_what_may_go_on_behind_an_unseen_cell_is_not_crossed() -> None:
    import torch

    from jcr.scene.seen_space import CROSSED, HIT, SeenGrid, without_doubts

    before, after = ([0, CROSSED, CROSSED | HIT, CROSSED, CROSSED], [0, 0, HIT, CROSSED, CROSSED])  # along z
    state = torch.tensor(before, dtype=torch.uint8)[:, None, None].repeat(1, 3, 3)
    found = without_doubts(SeenGrid(torch.zeros(3), 0.01, state)).state
    assert found[:, 1, 1].tolist() == found[:, 0, 2].tolist() == after


def test_priors_make_surfaces_and_nothing_free() -> None:
    from jcr.scene.build import build_scene
    from jcr.scene.options import MapOptions
    from jcr.scene.seen_space import CROSSED, HIT, carve

    whole = analytic_scene.cloud(20_000)
    left = whole.points_in_base[:, 0] < 0
    reason = np.where(left, PRIOR, MATCHED).astype(np.uint8)
    box = np.array([[-0.3, -0.3, -0.05], [0.3, 0.3, 0.45]])

    def seen(rows: np.ndarray, reasons: np.ndarray) -> np.ndarray:
        ends = whole.points_in_base[rows], whole.image[rows], whole.camera_centers_in_base
        return carve(*ends, box, 0.01, reasons[rows] != PRIOR).state.numpy()

    every = np.ones(len(left), bool)
    mixed, measured_alone = seen(every, reason), seen(~left, reason)
    assert not ((mixed & CROSSED) & ~(measured_alone & CROSSED)).any()
    assert ((mixed & HIT) & ~(measured_alone & HIT)).any()

    scene = build_scene(replace(whole, reason=reason), MapOptions(cell=0.02, max_seconds=5.0))
    on_left = whole.points_in_base[left & (np.abs(whole.points_in_base).max(1) < 0.2)]
    assert (scene.query(on_left, unknown="free").occupancy > 0.5).mean() > 0.3
    only = replace(whole, reason=np.full(len(left), PRIOR, np.uint8))
    x = np.random.default_rng(0).uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.4], (5000, 3))
    nothing_free = build_scene(only, MapOptions(cell=0.02, max_seconds=0.5))
    assert not (nothing_free.query(x, unknown="occupied").occupancy < 0.5).any()


def test_manual_of_maps_runs(scene: "SceneMap", tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    page = (ROOT / "docs" / "how-to" / "map.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(blocks) == 3
    scene.save(tmp_path / "out" / "table" / "map.safetensors")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks:
        exec(block, names)
    assert names["sample"].unknown.tolist() == [False, True, True]
