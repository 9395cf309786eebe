"""Loading of published weights of DUSt3R and MASt3R: config.json and model.safetensors in a folder."""

import functools
import json
import re
import sys
from pathlib import Path

import torch
from torch import Tensor

from jcr.errors import InputError
from jcr.hub import HUB_FILES, Weights
from jcr.pointmaps.dust3r.network import Dust3r


def load_weights(weights: Weights, device: str = "cpu") -> Dust3r:
    """Load a network from a folder, or from a .safetensors file next to its config.json.

    The licence is printed on stderr. Raises InputError for files that are missing, damaged or of another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = weights.path
    tensors = path / HUB_FILES[1] if path.is_dir() else path
    config_path = tensors.with_name(HUB_FILES[0])
    if tensors.suffix != ".safetensors" or not (tensors.is_file() and config_path.is_file()):
        raise InputError(
            f"{path}: no such weights; give a folder of {' and '.join(HUB_FILES)}, or a hub id (jcr models)"
        )
    try:
        config, state = dict(json.loads(config_path.read_text("utf-8"))), load_file(tensors)
    except (SafetensorError, OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged ({_line(error)}); fetch it again") from None
    # MASt3R is this network with a further head for matching, which is not used; its points are metric.
    mast3r = [key for key in state if ".head_local_features." in key]
    network = _build(config, {key: state[key] for key in state if key not in mast3r}, path)
    network.is_metric = bool(mast3r)
    try:
        # Channels last: the heads' convolutions take 0.94 s instead of 1.32 s on two cores at 512x384.
        network = network.to(torch.device(device)).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device {device}: {_line(error)}; use --device cpu") from None
    _announce(weights.note)
    return network


def _build(config: dict[str, object], state: dict[str, Tensor], path: Path) -> Dust3r:
    """Return the network of a configuration with the weights `state`, which share the memory of the mapped file."""
    mast3r_only = ("two_confs", "desc_conf_mode", "desc_mode", "local_feat_dim")
    config = {key: value for key, value in config.items() if key not in mast3r_only}
    config["head_type"] = str(config.get("head_type", "linear")).removeprefix("catmlp+")
    config["output_mode"] = str(config.get("output_mode", "pts3d")).partition("+")[0]
    try:
        with torch.device("meta"):
            network = Dust3r(**config)
    except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        raise InputError(f"{path}: its configuration is not of this network ({_line(error)})") from None
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
    """Write the source and licence of weights to stderr, once per process and note."""
    sys.stderr.write(f"{note}\n")


def _line(error: BaseException) -> str:
    """Return the first sentence of an error's message, on one line."""
    return " ".join(str(error).split()).split(". ")[0][:160] or type(error).__name__
