"""Published weights, their faults, and where they are found."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.hub import Weights
from jcr.reconstruct import BACKENDS, ReconstructOptions, network_weights

if TYPE_CHECKING:
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

pytestmark = pytest.mark.slow

CONFIG = {
    "head_type": "dpt",
    "enc_embed_dim": 32,
    "enc_depth": 1,
    "enc_num_heads": 2,
    "dec_embed_dim": 32,
    "dec_depth": 10,
    "dec_num_heads": 2,
}
# Small files, where the head does not matter.
LINEAR_CONFIG = {**CONFIG, "head_type": "linear", "dec_depth": 2}


@pytest.fixture(scope="module")
def network() -> "Dust3r":
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    torch.manual_seed(0)
    return Dust3r(**CONFIG).eval()


@pytest.fixture(scope="module")
def linear() -> "Dust3r":
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    torch.manual_seed(0)
    return Dust3r(**LINEAR_CONFIG).eval()


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
    from jcr.pointmaps.dust3r.weights import load_weights

    return load_weights(Weights(path, str(path), "unknown"), device)


def assert_same_output(network: "Dust3r", loaded: "Dust3r") -> None:
    import torch

    image = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.inference_mode():
        for ours, theirs in zip(network(image, image.flip(3)), loaded(image, image.flip(3)), strict=True):
            torch.testing.assert_close(ours.points, theirs.points, rtol=1e-5, atol=1e-6)


def test_a_folder_or_its_file_loads_to_the_same_network(
    tmp_path: Path, network: "Dust3r", capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "folder", network)
    for source in (folder, folder / "model.safetensors", folder):
        loaded = load(source)
        assert_same_output(network, loaded)
        assert not loaded.is_metric
    assert capsys.readouterr().err.count(f"weights {folder}: licence unknown") == 1


def test_mast3r_is_the_same_network_in_metres(tmp_path: Path, network: "Dust3r") -> None:
    import torch

    config = {
        **CONFIG,
        "head_type": "catmlp+dpt",
        "output_mode": "pts3d+desc24",
        "two_confs": True,
    }
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
        with pytest.raises(InputError, match="use --device cpu"):
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


@pytest.mark.parametrize(("device", "expected"), [("cpu", "cpu"), ("cuda", "cuda"), ("auto", "cuda")])
def test_a_network_runs_on_the_device_that_is_asked_for(
    device: str, expected: str, tabletop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[str] = []

    def load(weights: Weights, device: str) -> None:
        used.append(device)
        raise InputError("far enough")

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("jcr.pointmaps.dust3r.dust3r.load_weights", load)
    command = ["run", str(tabletop), str(tmp_path / "out"), "--backend", "dust3r", "--weights", str(tmp_path)]
    assert dispatch([*command, "--device", device]) == 2
    assert used == [expected]


def test_a_hub_id_comes_from_the_cache(
    tmp_path: Path, linear: "Dust3r", monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub.constants

    from jcr.pointmaps.dust3r.weights import load_weights

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
    with pytest.raises(
        InputError, match="only revision 000000000000 is on this machine; jcr models get dust3r"
    ):
        network_weights(ReconstructOptions(backend="dust3r"))
    write_folder(repository / "snapshots" / row.revision, linear, LINEAR_CONFIG)
    assert row.has_weights()
    weights = network_weights(ReconstructOptions(backend="dust3r"))
    assert weights.name == row.hub_id and weights.licence.startswith("CC BY-NC-SA 4.0")
    assert weights.path.name == row.revision
    assert_same_output(linear, load_weights(weights))
