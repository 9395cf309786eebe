"""Test the pair graphs, the file of pairs, and the prediction of pairs with little memory."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jcr.errors import InputError
from jcr.pointmaps.dust3r.pair_graph import complete_pairs, pairs_to_predict, window_pairs
from jcr.pointmaps.grid import PreparedImages, image_grid
from jcr.pointmaps.pairs import PairPredictions, read_pairs
from jcr.records import Intrinsics
from simulation.pairs import write_pairs

if TYPE_CHECKING:
    from jcr.pointmaps.dust3r.network import Dust3r

pytestmark = pytest.mark.slow

NAMES = ("a.png", "b.png", "c.png", "d.png")


@pytest.fixture(scope="module")
def loaded() -> "Dust3r":
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    torch.manual_seed(0)
    network = Dust3r(
        enc_embed_dim=32, enc_depth=2, enc_num_heads=2, dec_embed_dim=32, dec_depth=2, dec_num_heads=2
    )
    network.is_metric = True
    return network.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def images() -> PreparedImages:
    grid = dataclasses.replace(image_grid((640, 480)), size=(64, 48))
    colors = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), dtype=np.uint8)
    return PreparedImages(colors=colors, grid=grid, intrinsics_of_capture=None, pinhole=None)


def predicted(loaded: "Dust3r", images: PreparedImages) -> PairPredictions:
    from jcr.pointmaps.dust3r.dust3r import predict_pairs

    return predict_pairs(loaded, images, NAMES, complete_pairs(4))[0]


def test_pair_graphs() -> None:
    assert complete_pairs(3).tolist() == [[1, 0], [2, 0], [2, 1], [0, 1], [0, 2], [1, 2]]
    assert window_pairs(4, 1).tolist() == [[1, 0], [2, 1], [3, 2], [0, 1], [1, 2], [2, 3]]
    assert len(window_pairs(5, 9)) == 20


def test_each_pair_is_what_the_network_shows_of_its_two_images(
    loaded: "Dust3r", images: PreparedImages
) -> None:
    import torch

    pairs = predicted(loaded, images)
    assert pairs.edges.tolist() == complete_pairs(4).tolist()
    assert pairs.is_metric and pairs.images == NAMES
    tensors = (torch.from_numpy(images.colors).permute(0, 3, 1, 2) / 255 - 0.5) / 0.5
    for e, (first, second) in enumerate(pairs.edges):
        with torch.inference_mode():
            view1, view2 = loaded(tensors[first, None], tensors[second, None])
        np.testing.assert_allclose(pairs.pts3d[e], view1.points[0], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(pairs.conf2[e], view2.confidence[0], rtol=1e-4, atol=1e-5)


def test_a_batch_that_does_not_fit_is_halved_and_reported(
    loaded: "Dust3r", images: PreparedImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    from jcr.pointmaps.dust3r import dust3r
    from jcr.pointmaps.dust3r.network import Dust3r

    encode, largest = Dust3r.encode, 1

    def encode_few(self, images):
        if len(images) > largest:
            raise torch.cuda.OutOfMemoryError("out of memory")
        return encode(self, images)

    monkeypatch.setattr(Dust3r, "encode", encode_few)
    monkeypatch.setitem(dust3r.MAX_BATCH, "cpu", 4)
    pairs, notes = dust3r.predict_pairs(loaded, images, NAMES, complete_pairs(4))
    assert [note.split(": ")[1] for note in notes] == ["2 pairs at a time", "1 pairs at a time"]
    largest = 0
    with pytest.raises(InputError, match="use --device cpu"):
        dust3r.predict_pairs(loaded, images, NAMES, complete_pairs(4))
    monkeypatch.undo()
    undisturbed = predicted(loaded, images)
    np.testing.assert_allclose(pairs.pts3d, undisturbed.pts3d, rtol=1e-4, atol=1e-5)


def test_file_round_trip_and_faults(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    edges = complete_pairs(3)
    pairs = PairPredictions(
        edges=edges,
        pts3d=rng.normal(size=(6, 8, 12, 3)).astype(np.float32),
        conf=rng.uniform(1, 5, (6, 8, 12)).astype(np.float32),
        pts3d_in_other_view=rng.normal(size=(6, 8, 12, 3)).astype(np.float32),
        conf2=rng.uniform(1, 5, (6, 8, 12)).astype(np.float32),
        images=NAMES[:3],
        colors=rng.integers(0, 256, (3, 8, 12, 3), dtype=np.uint8),
        intrinsics=Intrinsics(10.0, 10.5, 5.5, 3.5, 12, 8),
        grid=dataclasses.replace(image_grid((640, 480)), size=(12, 8)),
        is_metric=True,
    )
    path = tmp_path / "pairs.npz"
    write_pairs(path, pairs)
    back = read_pairs(path)
    for field in dataclasses.fields(pairs):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(pairs, field.name))

    arrays = {name: np.array(value) for name, value in np.load(path).items()}
    spoilt = {
        "no array 'conf2'": {"conf2": None},
        "conf is float32 of shape": {"conf": arrays["conf"][:, :4]},
        "not finite": {"pts3d": np.where(arrays["pts3d"] > 2.5, np.nan, arrays["pts3d"])},
        "negative": {"conf": arrays["conf"] - 3},
        "must join two": {"edges": edges + 1},
        "must be integers": {"edges": edges / 1.0},
        "fx, fy, cx, cy": {"intrinsics": np.zeros(4)},
        "grid must be": {"grid": np.zeros((4, 2), int)},
        "colors must be": {"colors": arrays["colors"][:2]},
        "must be numbers of shape E H W 3": {"pts3d": arrays["pts3d"][0]},
    }
    for message, change in spoilt.items():
        np.savez(path, **{k: v for k, v in {**arrays, **change}.items() if v is not None})
        with pytest.raises(InputError, match=message) as caught:
            read_pairs(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match="no readable npz"):
        read_pairs(path)


def test_the_robot_graph_has_near_pairs_and_joins_far_groups() -> None:
    # Two groups of images, 2 m apart, that share no view.
    base_from_gripper = np.tile(np.eye(4), (24, 1, 1))
    base_from_gripper[:, 0, 3] = 0.05 * np.arange(24) + 2.0 * (np.arange(24) >= 12)
    edges = pairs_to_predict(base_from_gripper)
    pairs = {tuple(edge) for edge in edges.tolist()}
    assert pairs == {(second, first) for first, second in pairs}
    across = {(first, second) for first, second in pairs if (first < 12) != (second < 12)}
    assert across == {(11, 12), (12, 11)}
    assert all((first, first + 1) in pairs for first in range(23)) and len(pairs) < 24 * 23 / 2
    assert len(pairs_to_predict(base_from_gripper[:12])) == 12 * 11
