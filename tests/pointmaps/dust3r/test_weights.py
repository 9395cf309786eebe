"""Both checkpoint layouts, their faults, and pickles that must not run."""

import argparse
import json
import pickle
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
    from jcr.pointmaps.dust3r.weights import LoadedNetwork

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
MODEL = (
    "AsymmetricCroCo3DStereo(pos_embed='RoPE100', img_size=(512, 512), head_type='dpt', output_mode='pts3d', "
    "depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), enc_embed_dim=32, enc_depth=1, "
    "enc_num_heads=2, dec_embed_dim=32, dec_depth=10, dec_num_heads=2, landscape_only=False)"
)


# Small files, where the head does not matter.
LINEAR_CONFIG = {**CONFIG, "head_type": "linear", "dec_depth": 2}
LINEAR_MODEL = MODEL.replace("'dpt'", "'linear'").replace("dec_depth=10", "dec_depth=2")


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


def write_pth(path: Path, network: "Dust3r", model: str = MODEL, **tensors: "torch.Tensor") -> Path:
    import torch

    state = {**network.state_dict(), **tensors}
    torch.save({"args": argparse.Namespace(model=model, epochs=100), "model": state}, path)
    return path


def write_folder(folder: Path, network: "Dust3r", config: dict[str, object] = CONFIG) -> Path:
    from safetensors.torch import save_file

    # Published safetensors name a tied tensor once and write Infinity into their JSON.
    state = {key: tensor for key, tensor in network.state_dict().items() if ".layer_rn." not in key}
    folder.mkdir(exist_ok=True)
    save_file(state, folder / "model.safetensors")
    infinite = {"depth_mode": ["exp", -float("inf"), float("inf")], "conf_mode": ["exp", 1, float("inf")]}
    (folder / "config.json").write_text(json.dumps({**config, **infinite, "freeze": "none"}))
    return folder


def load(path: Path, device: str = "cpu") -> "LoadedNetwork":
    """The network in a file or folder of unknown licence."""
    from jcr.pointmaps.dust3r.weights import load_weights

    return load_weights(Weights(path, str(path), "unknown"), device)


def assert_same_output(network: "Dust3r", loaded: "Dust3r") -> None:
    import torch

    image = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.inference_mode():
        for ours, theirs in zip(network(image, image.flip(3)), loaded(image, image.flip(3)), strict=True):
            torch.testing.assert_close(ours.points, theirs.points, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_every_layout_loads_to_the_same_network(
    tmp_path: Path, network: "Dust3r", capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "folder", network)
    pth = write_pth(tmp_path / "weights.pth", network)
    for source in (folder, folder / "model.safetensors", pth):
        loaded = load(source)
        assert_same_output(network, loaded.network)
        assert not loaded.is_metric
    load(pth)
    said = capsys.readouterr().err
    assert said.count(f"weights {pth}: licence unknown") == 1


def test_a_second_decoder_that_is_not_stored_is_a_copy_of_the_first(tmp_path: Path, linear: "Dust3r") -> None:
    import torch

    state = {key: value for key, value in linear.state_dict().items() if not key.startswith("dec_blocks2.")}
    torch.save({"args": argparse.Namespace(model=LINEAR_MODEL), "model": state}, tmp_path / "croco.pth")
    loaded = load(tmp_path / "croco.pth").network
    assert torch.equal(loaded.dec_blocks2[1].mlp.fc1.weight, linear.dec_blocks[1].mlp.fc1.weight)


def test_mast3r_is_the_same_network_in_metres(tmp_path: Path, network: "Dust3r") -> None:
    import torch

    model = MODEL.replace("AsymmetricCroCo3DStereo", "AsymmetricMASt3R").replace("'dpt'", "'catmlp+dpt'")
    model = model.replace("'pts3d'", "'pts3d+desc24'").replace(")\n", "")[:-1] + ", two_confs=True)"
    matching = {
        f"downstream_head{head}.head_local_features.fc{layer}.{leaf}": torch.zeros(4)
        for head in (1, 2)
        for layer in (1, 2)
        for leaf in ("weight", "bias")
    }
    loaded = load(write_pth(tmp_path / "mast3r.pth", network, model, **matching))
    assert loaded.is_metric
    assert_same_output(network, loaded.network)


class Trap:
    """Unpickled by pickle.load, it creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("layout", ["pickle", "torch"])
def test_a_pickle_with_code_does_not_run(tmp_path: Path, layout: str) -> None:
    import torch

    sprung = tmp_path / "sprung"
    content = {"args": argparse.Namespace(model=MODEL, trap=Trap(sprung)), "model": {}}
    bad = tmp_path / "bad.pth"
    if layout == "pickle":
        bad.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, bad)
    with pytest.raises(InputError, match=r"bad\.pth: damaged, or holds code"):
        load(bad)
    assert not sprung.exists()


@pytest.mark.parametrize(
    "model",
    [
        "__import__('os').abort()",
        "AsymmetricMASt3R(depth_mode=(lambda: 1)())",
        "AsymmetricMASt3R(*[1])",
        "AsymmetricMASt3R(" + "(" * 5000,
        "os.abort",
    ],
)
def test_the_model_string_is_read_and_never_evaluated(tmp_path: Path, linear: "Dust3r", model: str) -> None:

    with pytest.raises(InputError, match="no checkpoint of DUSt3R"):
        load(write_pth(tmp_path / "weights.pth", linear, model))


def test_files_that_cannot_be_used_are_named_in_one_line(tmp_path: Path, linear: "Dust3r") -> None:
    import torch

    def complaint(source: Path | str) -> str:
        with pytest.raises(InputError) as caught:
            load(source)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no such weights" in complaint(tmp_path / "absent.pth")
    folder = write_folder(tmp_path / "folder", linear, LINEAR_CONFIG)
    tensors = folder / "model.safetensors"
    whole = tensors.read_bytes()
    tensors.write_bytes(whole[: len(whole) // 2])
    assert "damaged or no safetensors" in complaint(folder)
    tensors.write_bytes(whole)
    (folder / "config.json").write_text('{"enc_depth": ')
    assert "no readable JSON" in complaint(folder)
    (folder / "config.json").write_text(json.dumps({**LINEAR_CONFIG, "enc_depth": 2}))
    assert "enc_blocks.1" in complaint(folder)
    (folder / "config.json").write_text(json.dumps({**LINEAR_CONFIG, "num_classes": 1000}))
    assert "num_classes" in complaint(folder)
    (folder / "config.json").unlink()
    assert "config.json belongs beside them" in complaint(folder)

    pth = write_pth(tmp_path / "weights.pth", linear, LINEAR_MODEL)
    pth.write_bytes(pth.read_bytes()[:-5000])
    assert "damaged" in complaint(pth)
    torch.save(linear.state_dict(), pth)
    assert "no checkpoint of DUSt3R" in complaint(pth)
    write_pth(pth, linear, LINEAR_MODEL, foreign=torch.zeros(1))
    assert 'Unexpected key(s) in state_dict: "foreign"' in complaint(pth)
    write_pth(pth, linear, LINEAR_MODEL, enc_norm_weight=torch.zeros(1))
    assert "enc_norm_weight" in complaint(pth)
    write_pth(pth, linear, LINEAR_MODEL, **{"enc_norm.weight": torch.zeros(3)})
    assert "size mismatch for enc_norm.weight" in complaint(pth)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "0 weights files" in complaint(empty)
    (tmp_path / "image.png").touch()
    assert "not .png" in complaint(tmp_path / "image.png")
    write_pth(pth, linear, LINEAR_MODEL)
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="use --device cpu"):
            load(pth, "cuda")


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
    assert_same_output(linear, load_weights(weights).network)
