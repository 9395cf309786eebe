"""Weights on the Hugging Face hub: which files they are, and whether they are on this machine."""

from collections.abc import Sequence
from pathlib import Path

from jcr.extras import is_installed

HUB_FILES = ("config.json", "model.safetensors")


def cached_files(hub_id: str, names: Sequence[str] = HUB_FILES) -> list[Path]:
    """Files of a hub id in the cache of this machine, without asking the network; empty unless all are there."""
    if not is_installed("huggingface_hub"):
        return []
    from huggingface_hub import constants

    # Its client for the network takes a tenth of a second to import, which most machines can spare.
    if not (Path(constants.HF_HUB_CACHE) / f"models--{hub_id.replace('/', '--')}").is_dir():
        return []
    from huggingface_hub import try_to_load_from_cache

    # Not a path where a file is missing, or known to be missing on the hub.
    found = [try_to_load_from_cache(hub_id, name) for name in names]
    paths = [Path(path) for path in found if isinstance(path, str)]
    return paths if len(paths) == len(names) else []
