"""Segments and sizes: known tables with noise, and what users and networks may get wrong."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float
from numpy import ndarray

import scenes
from jcr.camera import project
from jcr.errors import InputError
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Capture, Intrinsics, PointCloud, Reconstruction
from jcr.segments.measure import measure_objects
from jcr.segments.options import SegmentOptions
from jcr.segments.segmentation import label_cloud, read_labels
from jcr.segments.tabletop import fit_support, label_tabletop
from refusal import refused
from scenes import capture_of, hand_eye_of, maps_of, reconstruction_of

NOISE = 5e-4
UPRIGHT = np.eye(4)
IMAGES = 6
EYES = np.array([[0.3 * np.cos(a), 0.3 * np.sin(a), 0.5] for a in np.linspace(0, 5, IMAGES)])


def rectangle(
    rng, low: Sequence[float], high: Sequence[float], density: float = 4e5
) -> Float[ndarray, "n 3"]:
    """Points on an axis-aligned rectangle: one of its three sides is zero."""
    low, high = np.array(low), np.array(high)
    area = np.prod([side for side in high - low if side > 0])
    return rng.uniform(low, high, (int(density * area), 3))


def table(rng, x: float = 0.3, y: float = 0.3) -> Float[ndarray, "n 3"]:
    return rectangle(rng, (-x, -y, 0), (x, y, 0), density=1e5)


def box(
    rng, size: Sequence[float], at: Sequence[float] = (0, 0), rotation: float = 0.0
) -> Float[ndarray, "n 3"]:
    """Top and sides of a box on z = 0."""
    a, b, h = size[0] / 2, size[1] / 2, size[2]
    faces = [((-a, -b, h), (a, b, h))]
    faces += [((s * a, -b, 0), (s * a, b, h)) for s in (-1, 1)] + [
        ((-a, s * b, 0), (a, s * b, h)) for s in (-1, 1)
    ]
    points = np.concatenate([rectangle(rng, low, high) for low, high in faces])
    return apply(transform(rotation_exp(np.array([0.0, 0.0, rotation])), np.array([*at, 0.0])), points)


def ring(
    rng, inner: float, outer: float, height: float, at: Sequence[float] = (0, 0), foot: float = 0.0
) -> Float[ndarray, "n 3"]:
    """The flat top of a roll or a cup, and its outside down to `foot`."""
    top, side = (int(4e5 * np.pi * area) for area in (outer**2 - inner**2, 2 * outer * (height - foot)))
    radius = np.append(np.sqrt(rng.uniform(inner**2, outer**2, top)), np.full(side, outer))
    z = np.append(np.full(top, height), rng.uniform(foot, height, side))
    rotation = rng.uniform(0, 2 * np.pi, top + side)
    return np.stack([radius * np.cos(rotation) + at[0], radius * np.sin(rotation) + at[1], z], -1)


def cloud_of(
    rng,
    *surfaces: Float[ndarray, "_ 3"],
    noise: float = NOISE,
    base_from_table: Float[ndarray, "4 4"] = UPRIGHT,
) -> PointCloud:
    """The surfaces, given in the table's frame, as images from above saw them."""
    x = np.concatenate(surfaces)
    x = apply(base_from_table, x + rng.normal(0, noise, x.shape))
    centers = apply(base_from_table, EYES)
    return scenes.cloud_of(x, image=rng.integers(IMAGES, size=len(x)), camera_centers_in_base=centers)


def sizes_of(cloud: PointCloud) -> list[ndarray]:
    return [size.box_size for size in measure_objects(label_tabletop(cloud)).objects]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_sizes_are_recovered_on_a_tilted_table(rng: np.random.Generator):
    base_from_table = transform(rotation_exp(np.array([0.5, -0.3, 1.0])), np.array([0.4, 0.1, 0.7]))
    things = box(rng, (0.12, 0.07, 0.05), (0.1, 0.05), 0.6), ring(rng, 0.02, 0.04, 0.11, (-0.1, -0.1))
    cloud = label_tabletop(cloud_of(rng, table(rng), *things, base_from_table=base_from_table))
    assert cloud.label_names == ("none", "table", "object 1", "object 2")
    measured = measure_objects(cloud)
    up = measured.support.base_from_support[:3, 2]
    np.testing.assert_allclose(up, base_from_table[:3, 2], atol=2e-4)
    lying, standing = measured.objects
    np.testing.assert_allclose(lying.box_size, [0.12, 0.07, 0.05], atol=0.003)
    np.testing.assert_allclose(standing.box_size, [0.08, 0.08, 0.11], atol=0.003)
    assert abs(lying.height - 0.05) < 2e-4 and abs(standing.height - 0.11) < 2e-4
    table_from_box = inverse(base_from_table) @ lying.base_from_box
    np.testing.assert_allclose(table_from_box[:3, 3], [0.1, 0.05, 0.025], atol=0.002)
    rotation = np.arctan2(table_from_box[1, 0], table_from_box[0, 0]) % np.pi
    assert rotation == pytest.approx(0.6, abs=0.02)
    # The outline lies on the table and holds the box's corners.
    outline = apply(inverse(base_from_table), lying.footprint_in_base)
    np.testing.assert_allclose(outline[:, 2], 0, atol=3e-4)
    assert cv2.contourArea(outline[:, :2].astype(np.float32)) == pytest.approx(0.12 * 0.07, rel=0.05)


def test_a_wall_behind_with_more_points_is_no_table_and_no_object(rng: np.random.Generator):
    wall = rectangle(rng, (-0.6, 0.31, -0.2), (0.6, 0.31, 0.6), density=1e5)
    cloud = cloud_of(rng, table(rng), wall, box(rng, (0.1, 0.1, 0.05)))
    assert len(wall) > 2 * len(table(rng))
    measured = measure_objects(label_tabletop(cloud))
    assert measured.support.base_from_support[2, 2] > 0.999
    assert len(measured.objects) == 1 and abs(measured.objects[0].height - 0.05) < 2e-4


def test_objects_that_touch_are_one_and_those_with_space_between_are_two(rng: np.random.Generator):
    left = box(rng, (0.06, 0.06, 0.05), (-0.03, 0.0))
    (touching,) = sizes_of(cloud_of(rng, table(rng), left, box(rng, (0.06, 0.06, 0.08), (0.03, 0.0))))
    np.testing.assert_allclose(touching, [0.12, 0.06, 0.08], atol=0.003)
    apart = sizes_of(cloud_of(rng, table(rng), left, box(rng, (0.06, 0.06, 0.08), (0.048, 0.0))))
    assert sorted(round(size[2], 2) for size in apart) == [0.05, 0.08]


def test_stray_points_do_not_lift_a_narrow_top_and_a_board_does_not_lift_the_plane(rng: np.random.Generator):
    tape = ring(rng, 0.038, 0.05, 0.048)
    stray = tape[tape[:, 2] > 0.0479][:200] + rng.uniform(0, [[0, 0, 0.01]], (200, 3))
    far = np.array([[1e5, -1e5, 0.05], [-1e5, 1e5, 0.05]])  # whose grid would take all memory
    (size,) = sizes_of(cloud_of(rng, table(rng), tape, stray, far))
    assert size[2] == pytest.approx(0.048, abs=3e-4)
    board = rectangle(rng, (-0.1, -0.1, 0.006), (0.1, 0.1, 0.006))
    (size,) = sizes_of(cloud_of(rng, table(rng), board, box(rng, (0.05, 0.05, 0.05), (0.2, 0.2))))
    assert abs(size[2] - 0.05) < 4e-4


def test_a_table_without_objects_and_a_scene_without_a_plane_are_reported(rng: np.random.Generator):
    cloud, notes = label_cloud(cloud_of(rng, table(rng)), SegmentOptions())
    assert cloud.label_names == ("none", "table") and "no object" in notes[0]
    assert measure_objects(cloud).objects == ()
    ball = rng.normal(size=(3000, 3))
    scatter = cloud_of(rng, 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
    cloud, notes = label_cloud(scatter, SegmentOptions())
    assert cloud.label_names == ("none",) and "no plane" in notes[0]
    with refused("no plane carries the scene"):
        label_cloud(scatter, SegmentOptions(segments="tabletop"))
    with refused("10 points"):
        fit_support(cloud_of(rng, ball[:10]))


def test_labels_that_came_with_the_images_are_kept_and_measured(rng: np.random.Generator):
    things = table(rng), box(rng, (0.1, 0.1, 0.05), (-0.1, 0)), box(rng, (0.05, 0.05, 0.08), (0.1, 0))
    label = np.repeat([7, 3, 5], [len(part) for part in things])
    names = ("none", "1", "2", "book", "4", "block", "6", "table")
    cloud = replace(cloud_of(rng, *things), label=label, label_names=names)
    kept, notes = label_cloud(cloud, SegmentOptions())
    assert kept is cloud and notes == ()
    assert [(size.name, round(size.height, 3)) for size in measure_objects(cloud).objects] == [
        ("book", 0.05),
        ("block", 0.08),
    ]


@pytest.mark.slow
def test_the_stated_sigma_of_a_height_covers_its_error(rng: np.random.Generator):
    """Depth errs together within an image: plane and top are off by 2 mm each, again in every image."""
    misses, stated = [], []
    for _ in range(25):
        cloud = cloud_of(rng, table(rng, 0.1, 0.1), box(rng, (0.05, 0.05, 0.06)), noise=3e-4)
        x = cloud.points_in_base.copy()
        shift = rng.normal(0, 2e-3, (2, IMAGES))
        x[:, 2] += np.where(x[:, 2] > 0.03, shift[1][cloud.image], shift[0][cloud.image])
        (size,) = measure_objects(label_tabletop(replace(cloud, points_in_base=x))).objects
        misses.append(size.height - 0.06)
        stated.append(size.height_std)
    sigmas = np.abs(misses) / stated
    assert (sigmas < 1).mean() > 0.6 and (sigmas < 2).mean() > 0.93
    assert np.mean(stated) < 3 * np.std(misses)
    scaled = measure_objects(label_tabletop(cloud), scale_std=0.05).objects[0].height_std
    assert scaled == pytest.approx(0.05 * 0.06, rel=0.1)


INTRINSICS = Intrinsics(90.0, 90.0, 39.5, 29.5, 80, 60, (-0.1, 0.0, 0.0, 0.0, 0.0))
PINHOLE = Intrinsics(60.0, 60.0, 19.5, 14.5, 40, 30)


def labelled_capture(folder: Path, rows: tuple[int, ...] = (0, 1)) -> tuple[Capture, Reconstruction]:
    images = {"images": ("images/a.png", "images/b.png"), "image_size": (80, 60), "intrinsics": INTRINSICS}
    capture = capture_of(np.stack([np.eye(4)] * 2), folder=folder, **images)
    m = len(rows)
    grid = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 40), np.linspace(-0.15, 0.15, 30)), -1)
    points = np.concatenate([grid, np.full((30, 40, 1), 0.5)], -1)
    reconstruction = reconstruction_of(
        np.stack([np.eye(4)] * m), intrinsics=INTRINSICS, image_index=np.array(rows),
        pointmaps=maps_of(np.stack([points] * m), PINHOLE),
    )  # fmt: skip
    (folder / "labels").mkdir(exist_ok=True)
    return capture, reconstruction


def write_label(folder: Path, name: str, label: ndarray) -> None:
    assert cv2.imwrite(str(folder / "labels" / f"{name}.png"), label)


def test_label_images_are_read_where_the_pointmap_looks_through_the_distortion(tmp_path: Path):
    capture, reconstruction = labelled_capture(tmp_path)
    halves = np.ones((60, 80), np.uint16)
    halves[:, 40:] = 300
    # Where the camera model puts the ray of the grid's pixel (35, 15).
    ray = np.array([[(35 - PINHOLE.cx) / PINHOLE.fx, (15 - PINHOLE.cy) / PINHOLE.fy, 1.0]])
    x, y = np.rint(project(INTRINSICS, ray)[0]).astype(int)
    halves[y - 1 : y + 2, x - 1 : x + 2] = 9
    for name in "ab":
        write_label(tmp_path, name, halves)
    (tmp_path / "labels" / "names.json").write_text(json.dumps({"1": "left\nhand", "300": ""}))
    labels = read_labels(capture, reconstruction)
    assert labels is not None and labels[0].shape == (2, 30, 40)
    assert (labels[0][:, :, :20] == 1).all() and labels[0][0, 15, 35] == 9 and (labels[0] == 9).sum() <= 8
    assert (labels[0][:, :10, 20:] == 300).all()
    assert len(labels[1]) == 301 and labels[1][1] == "left hand" and labels[1][300] == "300"
    # A pixel beyond the image has no label.
    pointmaps = replace(reconstruction.dense, intrinsics=replace(PINHOLE, fx=10.0, fy=10.0))
    labels = read_labels(capture, replace(reconstruction, pointmaps=pointmaps))
    assert labels is not None and labels[0][0, 0, 0] == 0 and labels[0][0, 15, 18] == 1


@pytest.mark.parametrize(("label", "words"), [
    (None, "not found"),
    (np.zeros((60, 79), np.uint8), "is .79, 60. pixels"),
    (np.zeros((60, 80, 3), np.uint8), "one channel"),
    (np.full((60, 80), 5000, np.uint16), "holds label 5000"),
    (b"no picture", "not a readable image"),
])  # fmt: skip
def test_unusable_label_images_are_named(tmp_path: Path, label: ndarray | bytes | None, words: str):
    capture, reconstruction = labelled_capture(tmp_path)
    write_label(tmp_path, "a", np.ones((60, 80), np.uint8))
    if isinstance(label, bytes):
        (tmp_path / "labels" / "b.png").write_bytes(label)
    elif label is not None:
        write_label(tmp_path, "b", label)
    with pytest.raises(InputError, match=words) as caught:
        read_labels(capture, reconstruction)
    assert "b.png" in str(caught.value)
    # What did not register needs no label.
    assert read_labels(*labelled_capture(tmp_path, rows=(0,))) is not None


def test_masks_of_different_images_become_objects_by_where_they_lie():
    """Two images see one plane from opposite sides; a third mask is seen by one image alone."""
    from jcr.segments.sam import merged

    grid = np.stack(np.meshgrid(np.linspace(0, 0.4, 40), np.linspace(0, 0.3, 30)), -1)
    plane = np.concatenate([grid, np.zeros((30, 40, 1))], -1)
    x_in_base = np.stack([plane, plane[::-1, ::-1]])
    everything, mug, ghost = np.ones((30, 40), bool), np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    mug[5:15, 5:15] = True
    ghost[20:28, 25:35] = True
    first = np.stack([mug, everything, ghost])
    second = np.stack([everything, mug[::-1, ::-1]])
    labels = merged([first, second], x_in_base, np.ones((2, 30, 40), bool))
    assert labels[1] == ("none", "segment 1", "segment 2")
    np.testing.assert_array_equal(labels[0][0], np.where(mug, 2, 1))
    np.testing.assert_array_equal(labels[0][1], np.where(mug, 2, 1)[::-1, ::-1])
    # The same pixels elsewhere in space are another object, here one that no other image shows.
    moved = x_in_base + np.array([0.0, 1.0])[:, None, None, None]
    assert merged([first, second], moved, np.ones((2, 30, 40), bool))[0].max() == 0
    nothing = [np.zeros((0, 30, 40), bool)] * 2
    assert merged(nothing, x_in_base, np.ones((2, 30, 40), bool))[1] == ("none",)


@pytest.fixture(scope="module")
def tiny_sam(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Segment Anything 2 with random weights, small enough for a test."""
    transformers = pytest.importorskip("transformers", reason="the extra `sam` is not installed")
    import torch

    torch.manual_seed(0)
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [128, 128],
        "embed_dim_per_stage": [8, 16, 32, 64], "num_attention_heads_per_stage": [1, 1, 1, 1],
        "blocks_per_stage": [1, 1, 2, 1], "window_size_per_stage": [4, 4, 4, 4],
        "window_positional_embedding_background_size": [2, 2], "global_attention_blocks": [3],
    }  # fmt: skip
    config = transformers.Sam2Config(
        vision_config={
            "backbone_config": backbone,
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
            "fpn_hidden_size": 32,
        },
        prompt_encoder_config={"hidden_size": 32, "image_size": 128, "patch_size": 16},
        mask_decoder_config={
            "hidden_size": 32,
            "mlp_dim": 32,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 16,
        },
    )
    folder = tmp_path_factory.mktemp("sam")
    transformers.Sam2Model(config).save_pretrained(folder)
    return folder


def test_segment_anything_gives_distinct_masks_of_the_image(tiny_sam, tmp_path, monkeypatch, capfd):
    """A random network is sure of nothing: its masks pass once the thresholds are gone."""
    from jcr.segments.sam import image_masks, load_sam, sam_labels

    model = load_sam(str(tiny_sam))
    assert capfd.readouterr() == ("", "")
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    assert len(image_masks(model, image)) == 0
    monkeypatch.setattr("jcr.segments.sam.LEAST_QUALITY", -np.inf)
    monkeypatch.setattr("jcr.segments.sam.LEAST_STABILITY", -np.inf)
    masks = image_masks(model, image)
    assert masks.shape[1:] == (30, 40) and masks.dtype == bool and len(masks) > 0
    flat = masks.reshape(len(masks), -1).astype(float)
    shared = flat @ flat.T
    iou = shared / (flat.sum(1)[:, None] + flat.sum(1) - shared)
    assert (iou[~np.eye(len(flat), dtype=bool)] <= 0.7).all()
    np.testing.assert_array_equal(image_masks(model, image), masks)
    # Both images look at the same place: all of their masks agree.
    _, reconstruction = labelled_capture(tmp_path)
    labels = sam_labels(
        model,
        replace(reconstruction, pointmaps=replace(reconstruction.dense, colors=np.stack([image, image]))),
        hand_eye_of(np.eye(4)),
    )
    assert labels[0].max() == len(labels[1]) - 1 > 0
    np.testing.assert_array_equal(labels[0][0], labels[0][1])
