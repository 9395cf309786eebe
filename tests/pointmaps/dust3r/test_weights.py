"""DUSt3R's weights, where they are found, and predictions of pairs: file, memory, pair graphs."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jcr.backends import BACKENDS, ReconstructOptions, network_weights
from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.hub import Weights
from jcr.pointmaps.image_grid import PreparedImages, image_grid
from jcr.pointmaps.pair_predictions import PairPredictions, complete_pairs, read_pairs
from jcr.records import Intrinsics
from refusal import refused
from simulation.pairs import write_pairs

if TYPE_CHECKING:
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r


pytestmark = pytest.mark.slow

CONFIG = {"head_type": "dpt", "enc_embed_dim": 32, "enc_depth": 1, "enc_num_heads": 2}
CONFIG |= {"dec_embed_dim": 32, "dec_depth": 10, "dec_num_heads": 2}
# Small files, where the head does not matter.
LINEAR_CONFIG = {**CONFIG, "head_type": "linear", "dec_depth": 2}


def random_network(config: dict[str, Any]) -> "Dust3r":
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    torch.manual_seed(0)
    return Dust3r(**config).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def network() -> "Dust3r":
    return random_network(CONFIG)


@pytest.fixture(scope="module")
def linear() -> "Dust3r":
    return random_network(LINEAR_CONFIG)


def write_folder(
    folder: Path, network: "Dust3r", config: dict[str, object] = CONFIG, **more: "torch.Tensor"
) -> Path:
    from safetensors.torch import save_file

    # Published safetensors name a tied tensor once and write Infinity into their JSON.
    state = {key: tensor for key, tensor in network.state_dict().items() if ".layer_rn." not in key} | more
    folder.mkdir(exist_ok=True)
    save_file(state, folder / "model.safetensors")
    infinite = {"depth_mode": ["exp", -float("inf"), float("inf")], "conf_mode": ["exp", 1, float("inf")]}
    (folder / "config.json").write_text(json.dumps({**infinite, "freeze": "none", **config}))
    return folder


def load(path: Path, device: str = "cpu") -> "Dust3r":
    """The network in a file or folder of unknown licence."""
    from jcr.pointmaps.dust3r.dust3r import load_weights

    return load_weights(Weights(path, str(path), "unknown"), device)


def assert_same_output(network: "Dust3r", loaded: "Dust3r") -> None:
    import torch

    image = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.inference_mode():
        for ours, theirs in zip(network(image, image.flip(3)), loaded(image, image.flip(3)), strict=True):
            torch.testing.assert_close(ours.points, theirs.points, rtol=1e-5, atol=1e-6)


def test_a_folder_or_file_is_a_network(tmp_path: Path, network: "Dust3r", capsys: pytest.CaptureFixture[str]):
    folder = write_folder(tmp_path / "folder", network)
    for source in (folder, folder / "model.safetensors", folder):
        loaded = load(source)
        assert_same_output(network, loaded)
        assert not loaded.is_metric
    assert capsys.readouterr().err.count(f"weights {folder}: licence unknown") == 1


def test_mast3r_is_the_same_network_in_metres(tmp_path: Path, network: "Dust3r") -> None:
    import torch

    config = {**CONFIG, "head_type": "catmlp+dpt", "output_mode": "pts3d+desc24", "two_confs": True}
    matching = {
        f"downstream_head{head}.head_local_features.fc{layer}.{leaf}": torch.zeros(4)
        for head in (1, 2)
        for layer in (1, 2)
        for leaf in ("weight", "bias")
    }
    loaded = load(write_folder(tmp_path / "mast3r", network, config, **matching))
    assert loaded.is_metric
    assert_same_output(network, loaded)


def test_files_that_cannot_be_used_are_named_in_one_line(tmp_path: Path, linear: "Dust3r") -> None:
    import torch

    def complaint(source: Path) -> str:
        with pytest.raises(InputError) as caught:
            load(source)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    folder = write_folder(tmp_path / "folder", linear, LINEAR_CONFIG)
    tensors = folder / "model.safetensors"
    if not torch.cuda.is_available():
        with refused("device cpu"):
            load(folder, "cuda")
    whole = tensors.read_bytes()
    tensors.write_bytes(whole[: len(whole) // 2])
    assert "damaged" in complaint(folder)
    tensors.write_bytes(whole)
    (folder / "config.json").write_text('{"enc_depth": ')
    assert "damaged" in complaint(folder)
    (folder / "config.json").write_text(json.dumps({**LINEAR_CONFIG, "enc_depth": 2}))
    assert "enc_blocks.1" in complaint(folder)
    (folder / "config.json").write_text(json.dumps({**LINEAR_CONFIG, "num_classes": 1000}))
    assert "num_classes" in complaint(folder)
    (folder / "config.json").unlink()
    assert "no such weights" in complaint(folder)
    for name in ("absent.safetensors", "weights.pth"):
        assert "no such weights" in complaint(tmp_path / name)
    write_folder(folder, linear, LINEAR_CONFIG, foreign=torch.zeros(1))
    assert 'Unexpected key(s) in state_dict: "foreign"' in complaint(folder)
    write_folder(folder, linear, LINEAR_CONFIG, **{"enc_norm.weight": torch.zeros(3)})
    assert "size mismatch for enc_norm.weight" in complaint(folder)


def test_a_network_runs_on_the_asked_device(tabletop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    used: list[str] = []

    def load(weights: Weights, device: str) -> None:
        used.append(device)
        raise InputError("far enough")

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("jcr.pointmaps.dust3r.dust3r.load_weights", load)
    options = ["--backend", "dust3r", "--weights", str(tmp_path)]
    for device in ("cpu", "auto"):
        assert dispatch(["run", str(tabletop), str(tmp_path / device), *options, "--device", device]) == 2
    assert used == ["cpu", "cuda"]


def test_a_hub_id_comes_from_the_cache(tmp_path: Path, linear: "Dust3r", monkeypatch: pytest.MonkeyPatch):
    import huggingface_hub.constants

    from jcr.pointmaps.dust3r.dust3r import load_weights

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    row = BACKENDS["dust3r"]
    assert not row.has_weights()
    repository = tmp_path / f"models--{row.hub_id.replace('/', '--')}"
    # Another commit than the pinned one is not used silently.
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text("0" * 40)
    (repository / "snapshots").mkdir()
    write_folder(repository / "snapshots" / ("0" * 40), linear, LINEAR_CONFIG)
    assert not row.has_weights()
    with refused("only revision 000000000000 is on this machine; jcr models get dust3r"):
        network_weights(ReconstructOptions(backend="dust3r"))
    write_folder(repository / "snapshots" / row.revision, linear, LINEAR_CONFIG)
    assert row.has_weights()
    weights = network_weights(ReconstructOptions(backend="dust3r"))
    assert weights.name == row.hub_id and weights.licence.startswith("CC BY-NC-SA 4.0")
    assert weights.path.name == row.revision
    assert_same_output(linear, load_weights(weights))


NAMES = ("a.png", "b.png", "c.png", "d.png")


@pytest.fixture(scope="module")
def images() -> PreparedImages:
    grid = dataclasses.replace(image_grid((640, 480)), size=(64, 48))
    colors = np.random.default_rng(0).integers(0, 256, (4, 48, 64, 3), dtype=np.uint8)
    return PreparedImages(colors=colors, grid=grid, intrinsics_of_capture=None, pinhole=None)


def predicted(linear: "Dust3r", images: PreparedImages) -> PairPredictions:
    from jcr.pointmaps.dust3r.dust3r import predict_pairs

    return predict_pairs(linear, images, NAMES, complete_pairs(4))[0]


def test_each_pair_is_what_the_network_shows_of_its_two_images(linear: "Dust3r", images: PreparedImages):
    import torch

    pairs = predicted(linear, images)
    assert pairs.edges.tolist() == complete_pairs(4).tolist()
    assert not pairs.is_metric and pairs.images == NAMES
    tensors = (torch.from_numpy(images.colors).permute(0, 3, 1, 2) / 255 - 0.5) / 0.5
    for e, (first, second) in enumerate(pairs.edges):
        with torch.inference_mode():
            view1, view2 = linear(tensors[first, None], tensors[second, None])
        np.testing.assert_allclose(pairs.pts3d[e], view1.points[0], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(pairs.conf2[e], view2.confidence[0], rtol=1e-4, atol=1e-5)


def test_a_batch_that_does_not_fit_is_halved_and_reported(linear, images, monkeypatch):
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
    pairs, notes = dust3r.predict_pairs(linear, images, NAMES, complete_pairs(4))
    assert [note.split(": ")[1] for note in notes] == ["2 pairs at a time", "1 pairs at a time"]
    largest = 0
    with refused("device cpu"):
        dust3r.predict_pairs(linear, images, NAMES, complete_pairs(4))
    monkeypatch.undo()
    undisturbed = predicted(linear, images)
    np.testing.assert_allclose(pairs.pts3d, undisturbed.pts3d, rtol=1e-4, atol=1e-5)


def test_file_round_trip_and_faults(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    edges = complete_pairs(3)
    pairs = PairPredictions(
        edges=edges, pts3d=rng.normal(size=(6, 8, 12, 3)).astype(np.float32),
        conf=rng.uniform(1, 5, (6, 8, 12)).astype(np.float32),
        pts3d_in_other_view=rng.normal(size=(6, 8, 12, 3)).astype(np.float32),
        conf2=rng.uniform(1, 5, (6, 8, 12)).astype(np.float32), images=NAMES[:3],
        colors=rng.integers(0, 256, (3, 8, 12, 3), dtype=np.uint8),
        intrinsics=Intrinsics(10.0, 10.5, 5.5, 3.5, 12, 8),
        grid=dataclasses.replace(image_grid((640, 480)), size=(12, 8)), is_metric=True,
    )  # fmt: skip
    path = tmp_path / "pairs.npz"
    write_pairs(path, pairs)
    back = read_pairs(path)
    for field in dataclasses.fields(pairs):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(pairs, field.name))

    arrays = {name: np.array(value) for name, value in np.load(path).items()}
    spoilt = {
        "no array 'conf2'": {"conf2": None}, "conf is float32 of shape": {"conf": arrays["conf"][:, :4]},
        "not finite": {"pts3d": np.where(arrays["pts3d"] > 2.5, np.nan, arrays["pts3d"])},
        "negative": {"conf": arrays["conf"] - 3}, "must join two": {"edges": edges + 1},
        "must be integers": {"edges": edges / 1.0}, "fx, fy, cx, cy": {"intrinsics": np.zeros(4)},
        "grid must be": {"grid": np.zeros((4, 2), int)}, "colors must be": {"colors": arrays["colors"][:2]},
        "give numbers E H W 3": {"pts3d": arrays["pts3d"][0]},
    }  # fmt: skip
    for message, change in spoilt.items():
        np.savez(path, **{k: v for k, v in {**arrays, **change}.items() if v is not None})
        with pytest.raises(InputError, match=message) as caught:
            read_pairs(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    path.write_bytes(path.read_bytes()[:-300])
    with refused("no readable npz"):
        read_pairs(path)


def test_the_robot_graph_has_near_pairs_and_joins_far_groups() -> None:
    from jcr.pointmaps.dust3r.dust3r import pairs_to_predict

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
