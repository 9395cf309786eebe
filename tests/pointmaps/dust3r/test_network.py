"""The network against outputs of the published one, on weights derived from each tensor's name."""

import importlib.util
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jcr.memory import give_back
from places import SHARED

if TYPE_CHECKING:
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r, Pointmap

pytestmark = pytest.mark.slow

OF_DUST3R = SHARED / "dust3r"
FIXTURES = OF_DUST3R / "fixtures"
TOLERANCE = {"rtol": 1e-4, "atol": 2e-5}

if not FIXTURES.is_dir():
    pytest.skip(f"the fixtures of the published network are not in {FIXTURES}", allow_module_level=True)


@cache
def seeded_weights() -> ModuleType:
    spec = importlib.util.spec_from_file_location("seeded_weights", OF_DUST3R / "seeded_weights.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def seeded_network(config: str, seed: int) -> "Dust3r":
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    with torch.device("meta"):
        network = Dust3r(**json.loads(config))
    weights = seeded_weights().fill(network.state_dict(), seed)
    network.load_state_dict({key: torch.from_numpy(value) for key, value in weights.items()}, assign=True)
    return network.eval()


@pytest.fixture(scope="module", autouse=True)
def networks_given_back() -> Iterator[None]:
    """The published network holds 2.3 GB, which the tests that follow in the process need not carry along."""
    yield
    seeded_network.cache_clear()
    give_back()


@pytest.fixture
def inference_mode() -> Iterator[None]:
    import torch

    with torch.inference_mode():
        yield


def fixture(name: str) -> "tuple[dict[str, torch.Tensor], Dust3r]":
    import torch

    arrays = dict(np.load(FIXTURES / f"{name}.npz"))
    network = seeded_network(str(arrays.pop("cfg")), int(arrays.pop("weight_seed")))
    return {key: torch.from_numpy(value) for key, value in arrays.items()}, network


def pointmaps(network: "Dust3r", truth: "dict[str, torch.Tensor]") -> "tuple[Pointmap, Pointmap]":
    """Pointmaps of a batch in which the published network lays portrait images down: each row is shown as it stands."""
    import torch

    from jcr.pointmaps.dust3r.network import Pointmap

    rows = []
    for row in range(len(truth["img1"])):
        images, lies = [], []
        for view in ("1", "2"):
            image, shape = truth[f"img{view}"][row : row + 1], truth[f"true_shape{view}"][row].tolist()
            lies.append(list(image.shape[2:]) != shape)
            images.append(image.mT if lies[-1] else image)
        for_row = network(*images)
        rows.append(
            [
                (view.points.transpose(1, 2), view.confidence.mT) if lying else (view.points, view.confidence)
                for view, lying in zip(for_row, lies, strict=True)
            ]
        )
    return tuple(
        Pointmap(*(torch.cat(parts) for parts in zip(*view, strict=True))) for view in zip(*rows, strict=True)
    )


@pytest.mark.parametrize("name", [
    *sorted(path.stem for path in FIXTURES.glob("tiny_*.npz")),
    pytest.param("vitl512dpt_48x64", marks=pytest.mark.long),
    pytest.param("vitl512dpt_160x224", marks=pytest.mark.long),
])  # fmt: skip
@pytest.mark.usefixtures("inference_mode")
def test_pointmaps_equal_the_published_network(name: str) -> None:
    import torch

    truth, network = fixture(name)
    view1, view2 = pointmaps(network, truth)
    torch.testing.assert_close(view1.points, truth["pts3d"], **TOLERANCE)
    torch.testing.assert_close(view1.confidence, truth["conf"], **TOLERANCE)
    torch.testing.assert_close(view2.points, truth["pts3d_in_other_view"], **TOLERANCE)
    torch.testing.assert_close(view2.confidence, truth["conf2"], **TOLERANCE)


@pytest.mark.parametrize("keys", sorted(FIXTURES.glob("*_keys.tsv")), ids=lambda path: path.stem)
def test_state_dict_has_the_published_keys_and_shapes(keys: Path) -> None:
    import torch

    from jcr.pointmaps.dust3r.network import Dust3r

    if keys.stem.startswith("vitl"):
        config = json.loads((FIXTURES / "vitl512dpt_config.json").read_text())
    else:
        arrays = np.load(FIXTURES / f"{keys.stem.removesuffix('_keys')}_48x64_b1.npz")
        config = json.loads(str(arrays["cfg"]))
    with torch.device("meta"):
        state = Dust3r(**config).state_dict()
    published = dict(line.split("\t")[:2] for line in keys.read_text().splitlines())
    assert {key: str(list(tensor.shape)) for key, tensor in state.items()} == published
