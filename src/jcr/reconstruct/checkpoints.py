"""Weights in this package or published on the hub: licence, scale, and whether they are on this machine."""

import json
from dataclasses import dataclass
from pathlib import Path

from jcr.extras import is_installed

CC_BY_NC_SA = "CC BY-NC-SA 4.0, non-commercial use only (https://creativecommons.org/licenses/by-nc-sa/4.0/)"
HUB_FILES = ("config.json", "model.safetensors")
COMPACT = Path(__file__).parents[1] / "weights" / "compact"
"""The weights that come with this package (docs/compact-model.md)."""


@dataclass(frozen=True)
class Checkpoint:
    """What a back end is run with unless the user names something else."""

    hub_id: str
    """Or a folder in this package."""
    licence: str
    is_metric: bool

    def is_cached(self) -> bool:
        """Whether its files are on this machine, without asking the network."""
        if Path(self.hub_id).is_absolute():
            return all((Path(self.hub_id) / name).is_file() for name in HUB_FILES)
        if not is_installed("huggingface_hub"):
            return False
        from huggingface_hub import try_to_load_from_cache

        return all(isinstance(try_to_load_from_cache(self.hub_id, name), str) for name in HUB_FILES)

    def accuracy(self) -> str:
        """What config.json of weights in this package says was measured with them; empty for others."""
        config = Path(self.hub_id) / HUB_FILES[0]
        return str(json.loads(config.read_text()).get("accuracy", "")) if config.is_file() else ""


CHECKPOINTS = {
    "dust3r": Checkpoint("naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt", CC_BY_NC_SA, is_metric=False),
    "mast3r": Checkpoint(
        "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric",
        f"{CC_BY_NC_SA}, and the licences of its training data (its CHECKPOINTS_NOTICE)",
        is_metric=True,
    ),
    "mapanything": Checkpoint("facebook/map-anything-apache", "Apache-2.0", is_metric=True),
    "compact": Checkpoint(str(COMPACT), "Apache-2.0", is_metric=False),
}
"""By back end."""


def licence_of(source: str) -> str:
    """The licence of weights by hub id; for any other source, where to ask."""
    for checkpoint in CHECKPOINTS.values():
        if checkpoint.hub_id == source:
            return checkpoint.licence
    return f"unknown, ask who made the file; the weights published by naver are {CC_BY_NC_SA}"
