"""Loading of published weights from .pth, or config.json and safetensors, without executing a pickle."""

import argparse
import ast
import functools
import json
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from jcr.errors import InputError
from jcr.hub import HUB_FILES, Weights
from jcr.pointmaps.dust3r.network import Dust3r


@dataclass(frozen=True)
class LoadedNetwork:
    """A network ready to predict, and what its weights bring with them."""

    network: Dust3r
    is_metric: bool
    """Whether its points are meant to be in metres."""


def load_weights(weights: Weights, device: str = "cpu") -> LoadedNetwork:
    """Load a network from a .pth, a .safetensors beside its config.json, or a folder with one of these.

    Their licence is printed on stderr. Raises InputError for what is missing, damaged or not of this network.
    """
    path = weights.path
    if not path.exists():
        raise InputError(f"{path}: no such weights; give a file, a folder or a hub id (jcr models)")
    if path.is_dir():
        published = path / HUB_FILES[1]
        files = (
            [published]
            if published.is_file()
            else [f for f in sorted(path.iterdir()) if f.suffix in _READERS]
        )
        if len(files) != 1:
            raise InputError(f"{path}: {len(files)} weights files in this folder; name the one to load")
        (path,) = files
    if path.suffix not in _READERS:
        raise InputError(f"{path}: weights are .pth, .pt or .safetensors, not {path.suffix or 'this'}")
    config, state = _READERS[path.suffix](path)
    # MASt3R is this network with one more head, for matching, which we do without; its points are metric.
    mast3r = [key for key in state if ".head_local_features." in key]
    network = _build(config, {key: state[key] for key in state if key not in mast3r}, path)
    try:
        # Channels last: the heads' convolutions take 0.94 s instead of 1.32 s on two cores at 512x384.
        network = network.to(torch.device(device)).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device {device}: {_line(error)}; use --device cpu") from None
    _announce(weights.note)
    return LoadedNetwork(network, is_metric=bool(mast3r))


def _read_safetensors(path: Path) -> tuple[dict[str, object], dict[str, Tensor]]:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    config_path = path.parent / HUB_FILES[0]
    if not config_path.is_file():
        raise InputError(f"{config_path}: no such file; the weights' config.json belongs beside them")
    try:
        return dict(json.loads(config_path.read_text("utf-8"))), load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: damaged or no safetensors ({_line(error)}); fetch it again") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{config_path}: no readable JSON ({_line(error)}); fetch it again") from None


def _read_pth(path: Path) -> tuple[dict[str, object], dict[str, Tensor]]:
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # a damaged or foreign file can make torch raise anything
        raise InputError(
            f"{path}: damaged, or holds code, which is never run ({_line(error)}); fetch it again"
        ) from None
    try:
        return _parse_model(content["args"].model), dict(content["model"])
    except Exception as error:  # the text of the model can make the parser raise anything
        raise InputError(
            f"{path}: no checkpoint of DUSt3R or MASt3R ({_line(error)}); it needs 'args' and 'model'"
        ) from None


_READERS = {".pth": _read_pth, ".pt": _read_pth, ".safetensors": _read_safetensors}


def _parse_model(text: str) -> dict[str, object]:
    """Return the keyword arguments of "Name(key=literal, ...)", with inf as a literal; raise ValueError for all else."""

    class InfinityIsNumber(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.AST:
            return ast.Constant(math.inf) if node.id == "inf" else node

    call = ast.parse(text, mode="eval").body
    names = ("AsymmetricCroCo3DStereo", "AsymmetricMASt3R")
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id not in names:
        raise ValueError(f"model = {text[:60]!r} is neither {' nor '.join(names)}")
    if call.args or any(keyword.arg is None for keyword in call.keywords):
        raise ValueError(f"model = {text[:60]!r} has arguments without a name")
    transformer = InfinityIsNumber()
    return {str(k.arg): ast.literal_eval(transformer.visit(k.value)) for k in call.keywords}


def _build(config: dict[str, object], state: dict[str, Tensor], path: Path) -> Dust3r:
    """Return the network of a configuration with its tensors, shared with the file that they are mapped from."""
    mast3r_only = ("two_confs", "desc_conf_mode", "desc_mode", "local_feat_dim")
    config = {key: value for key, value in config.items() if key not in mast3r_only}
    config["head_type"] = str(config.get("head_type", "linear")).removeprefix("catmlp+")
    config["output_mode"] = str(config.get("output_mode", "pts3d")).partition("+")[0]
    try:
        with torch.device("meta"):
            network = Dust3r(**config)
    except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        raise InputError(f"{path}: its configuration is not of this network ({_line(error)})") from None
    if not any(key.startswith("dec_blocks2.") for key in state):
        first = {key: value for key, value in state.items() if key.startswith("dec_blocks.")}
        state |= {re.sub("^dec_blocks", "dec_blocks2", key): value for key, value in first.items()}
    # Checkpoints may hold a tensor with two names under one of them.
    for key in network.state_dict():
        twin = re.sub(r"\.layer_rn\.(\d)\.", lambda level: f".layer{int(level[1]) + 1}_rn.", key)
        present = state.get(twin, state.get(key))
        if present is not None and twin != key:
            state |= {key: present, twin: present}
    try:
        network.load_state_dict({key: tensor.float() for key, tensor in state.items()}, assign=True)
    except (RuntimeError, AttributeError) as error:
        raise InputError(f"{path}: its tensors are not those of its configuration ({_line(error)})") from None
    return network.eval().requires_grad_(False)


@functools.cache
def _announce(note: str) -> None:
    """Write the source and licence of weights to stderr, once per process and source."""
    sys.stderr.write(f"{note}\n")


def _line(error: BaseException) -> str:
    """Return the first sentence of a message, on one line."""
    return " ".join(str(error).split()).split(". ")[0][:160] or type(error).__name__
