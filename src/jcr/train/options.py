"""Everything that a training can be told."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jcr.train.scenes import SceneOptions


@dataclass(frozen=True)
class TrainOptions:
    """Train a small DUSt3R on simulated tabletops; run again in the same folder, it goes on where it stopped.

    The options of a folder must stay what they were, but for steps, minutes, and how often to save and look.
    """

    out: Path
    """Folder of the training: state.pt to go on from, log.jsonl, and weights/ to use with jcr --weights."""
    steps: int = 20_000
    """Of the whole training; the learning rate falls to 0 over them."""
    minutes: float | None = None
    """Stop, saved, after this long; the same command goes on later."""
    scenes_per_step: int = 2
    scene: SceneOptions = field(default_factory=SceneOptions)
    embed: int = 192
    """Channels of a token."""
    heads: int = 6
    encoder_depth: int = 4
    decoder_depth: int = 4
    patch: Literal[4, 8, 16] = 8
    """Pixels along the side of what one token sees."""
    stem: Literal["convolutions", "linear"] = "convolutions"
    """What makes a token of its pixels."""
    shared_decoder: bool = True
    """One decoder for both views, so that a pair gives its two orders at once; the heads stay two."""
    pool_steps: int = 32
    """Steps whose scenes are drawn at once, to be seen again in another order."""
    replays: int = 4
    """How often a scene is seen, mirrored or with its colours exchanged; 1: once."""
    textures: int = 96
    """In the bank that surfaces draw from."""
    bank_pools: int = 2
    """Pools after which a new bank is made."""
    muon_rate: float = 2e-3
    """Peak learning rate of the weight matrices inside the blocks (Muon)."""
    adam_rate: float = 1e-3
    """Peak learning rate of everything else (AdamW)."""
    weight_decay: float = 0.05
    warmup: int = 100
    """Steps over which the learning rates rise."""
    alpha: float = 0.2
    """How much the loss rewards confidence."""
    attention: float = 0.5
    """Weight of the supervision of cross-attention; 0: none."""
    attention_blocks: tuple[int, ...] = (0, 1)
    """Decoder blocks whose cross-attention is supervised; the last of them is asked for matches."""
    widen: float = 0.4
    """Share of the steps over which the views of a scene grow apart, from a third of their range to all of it."""
    ema: float = 0.999
    """Decay of the averaged weights, which are what is validated and saved for use; less in the first steps."""
    seed: int = 0
    precision: Literal["bf16", "float32"] = "bf16"
    """Inside encoder and decoder."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    from_weights: Path | None = None
    """Weights to begin with, such as those in this package, in a new folder."""
    save_every: int = 100
    """Steps between saved states."""
    validate_every: int = 500
    """Steps between looks at scenes, and at captures, that are not trained on."""
    captures: Path | None = None
    """Folder of captures by jcr simulate to validate on too."""
    licence: str = "Apache-2.0"
    """Written beside the weights."""
