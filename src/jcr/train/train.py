"""The training loop: scenes drawn, pairs predicted, weights moved; the step's number decides all that is random."""

import json
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from jcr.errors import InputError
from jcr.files import write_text, written_whole
from jcr.reconstruct.dust3r.network import Dust3r, Features, Pointmap
from jcr.train.loss import attention_miss, confident_regression, true_attention
from jcr.train.options import TrainOptions
from jcr.train.scenes import Views, disguised, draw_views, narrowed, pairs_of, points_in_camera, seen_by
from jcr.train.textures import make_textures
from jcr.train.validate import capture_views, pair_errors, summary

FREE = {"steps", "minutes", "save_every", "validate_every", "captures", "device", "out", "from_weights"}
"""Options that may change when a training goes on."""
HELD_OUT_SEED = 1 << 31
"""Of scenes that no training draws; torch's CPU generator tells only the lowest 32 bits apart."""
SAMPLES = 4
"""Rows and columns of a token's pixels for which it is found out where the other view sees them."""


class Training:
    """Network, averaged weights and optimizers at one step; the same steps give the same bits, stopped or not."""

    def __init__(self, options: TrainOptions) -> None:
        self.options, self.step, self.seconds = options, 0, 0.0
        cuda = torch.cuda.is_available()
        self.device = torch.device(options.device if options.device != "auto" else "cuda" if cuda else "cpu")
        torch.manual_seed(options.seed)
        self.network = new_network(options).to(self.device)
        self.network.mixed_precision = options.precision == "bf16"
        if options.from_weights is not None:
            from jcr.reconstruct.dust3r.weights import load_weights

            self.network.load_state_dict(load_weights(options.from_weights).network.state_dict())
        self.averaged = {key: value.clone() for key, value in self.network.state_dict().items()}
        blocks = ("enc_blocks", "dec_blocks", "dec_blocks2")
        inner = {
            id(p): p for n, p in self.network.named_parameters() if n.split(".")[0] in blocks and p.ndim == 2
        }
        outer = [p for p in self.network.parameters() if id(p) not in inner]
        self.optimizers: list[torch.optim.Optimizer] = [
            torch.optim.Muon(
                list(inner.values()),
                options.muon_rate,
                options.weight_decay,
                adjust_lr_fn="match_rms_adamw",
            ),
            torch.optim.AdamW(outer, options.adam_rate, (0.9, 0.98), weight_decay=options.weight_decay),
        ]
        self.pool: tuple[int, Views] | None = None

    def advance(self) -> dict[str, float]:
        """One step: its losses."""
        options = self.options
        views = self.views(self.step)
        first, second = pairs_of(views, options.scene)
        if options.shared_decoder:
            first, second = (x[first < second] for x in (first, second))
        self._set_rates()
        decoders = (self.network.dec_blocks, self.network.dec_blocks2)
        attended = [
            decoder.get_submodule(f"{block}.cross_attn")
            for block in options.attention_blocks
            for decoder in decoders
        ]
        inputs: list[tuple[Tensor, ...]] = []
        # A shared decoder is one module, which has one hook and is called once for each view.
        hooks = [
            a.register_forward_pre_hook(lambda _, args: inputs.append(args)) for a in dict.fromkeys(attended)
        ]
        # Of these few tokens plain attention is the quickest on a CPU.
        backend = SDPBackend.MATH if self.device.type == "cpu" else SDPBackend.EFFICIENT_ATTENTION
        with sdpa_kernel([backend, SDPBackend.MATH]):
            predicted = predict(self.network, views.images, first, second, options.shared_decoder)
            for hook in hooks:
                hook.remove()
            orders = ((first, second), (second, first))[: 1 + options.shared_decoder]
            true = true_points(views, *(torch.cat(x) for x in zip(*orders, strict=True)))
            loss, distance = confident_regression(predicted, true, options.alpha)
            log = {"loss": loss, "distance": distance}
            if options.attention:
                with torch.autocast(self.device.type, torch.bfloat16, enabled=options.precision == "bf16"):
                    miss = self._attention_miss(views, first, second, attended, inputs)
                log["attention"] = miss
                loss = loss + options.attention * miss
            loss.backward()
        log["gradient"] = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.step += 1
        decay = min(options.ema, self.step / (10 + self.step))
        for key, value in self.network.state_dict().items():
            self.averaged[key].lerp_(value, 1 - decay)
        return {key: value.item() for key, value in log.items()} | {"pairs": len(true[0])}

    def views(self, step: int) -> Views:
        """The views that a step trains on."""
        options = self.options
        number, step_of_pool = divmod(step, options.pool_steps * options.replays)
        if self.pool is None or self.pool[0] != number:
            self.pool = number, self._draw_pool(number)
        replay, turn = divmod(step_of_pool, options.pool_steps)
        generator = self._generator(2, step - turn)
        scenes = options.scenes_per_step
        order = torch.randperm(options.pool_steps * scenes, generator=generator, device=self.device)
        here = order[turn * scenes : (turn + 1) * scenes]
        rows = here[:, None] * options.scene.views + torch.arange(options.scene.views, device=self.device)
        return disguised(
            Views(*(x[rows.flatten()] for x in self.pool[1])), options.scene.views, self._generator(3, step)
        )

    def _draw_pool(self, number: int) -> Views:
        options = self.options
        bank = make_textures(options.textures, self._generator(1, number // options.bank_pools))
        step = number * options.pool_steps * options.replays
        width = min(1.0, (1 + 2 * step / max(1.0, options.widen * options.steps)) / 3)
        scenes = options.pool_steps * options.scenes_per_step
        return draw_views(scenes, narrowed(options.scene, width), bank, self._generator(0, number))

    def averaged_network(self) -> Dust3r:
        """The network with the averaged weights."""
        network = new_network(self.options).to(self.device)
        network.load_state_dict(self.averaged)
        network.mixed_precision = self.network.mixed_precision
        return network.eval()

    def validate(self) -> dict[str, dict[str, float]]:
        """Errors of the averaged weights on scenes of seeds that are not trained on, and on captures."""
        network, scene = self.averaged_network(), self.options.scene
        generator = torch.Generator(self.device).manual_seed(HELD_OUT_SEED)
        bank = make_textures(self.options.textures, generator)
        views = draw_views(16, scene, bank, generator)
        found = {"held-out scenes": summary(pair_errors(network, views, *pairs_of(views, scene)))}
        for folder in sorted(self.options.captures.iterdir()) if self.options.captures else ():
            views = capture_views(folder, (scene.width, scene.height))
            views = Views(*(x.to(self.device) for x in views))
            first, second = (~torch.eye(len(views.depth), dtype=torch.bool, device=self.device)).nonzero().T
            found[folder.name] = summary(pair_errors(network, views, first, second))
        return found

    def save(self) -> None:
        """Write state.pt and the averaged weights."""
        state = {
            "step": self.step,
            "seconds": self.seconds,
            "options": _fixed(self.options),
            "network": self.network.state_dict(),
            "averaged": self.averaged,
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
        }
        with written_whole(self.options.out / "state.pt") as temporary:
            torch.save(state, temporary)
        write_weights(self.options.out / "weights", self.averaged, self.options)

    def load(self) -> None:
        """Go on from state.pt; InputError where it is of other options."""
        path = self.options.out / "state.pt"
        state = torch.load(path, map_location=self.device, weights_only=True)
        was, now = state["options"], _fixed(self.options)
        if changed := [key for key in now if now[key] != was.get(key)]:
            raise InputError(f"{path}: made with another {', '.join(changed)}; use a new folder")
        self.step, self.seconds = state["step"], state["seconds"]
        self.network.load_state_dict(state["network"])
        self.averaged = state["averaged"]
        for optimizer, value in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(value)

    def _generator(self, purpose: int, number: int) -> torch.Generator:
        """For one of four purposes at one step, or of one pool or bank, of one seed."""
        return torch.Generator(self.device).manual_seed(
            (self.options.seed * 100_003_001 + 4 * number + purpose) % HELD_OUT_SEED
        )

    def _set_rates(self) -> None:
        """Up over the first steps, then down along a cosine to 0."""
        options, step = self.options, self.step
        rise = min(1.0, (step + 1) / max(1, options.warmup))
        fall = 0.5 * (1 + torch.tensor(min(1.0, step / options.steps) * torch.pi).cos().item())
        for optimizer, rate in zip(self.optimizers, (options.muon_rate, options.adam_rate), strict=True):
            for group in optimizer.param_groups:
                group["lr"] = rate * rise * fall

    def _attention_miss(self, views: Views, first: Tensor, second: Tensor, attended, inputs) -> Tensor:
        options = self.options
        size, sample = (options.scene.width, options.scene.height), max(1, options.patch // SAMPLES)
        there, back = (
            true_attention(*seen_by(views, a, b, sample), size, options.patch)
            for a, b in ((first, second), (second, first))
        )
        trues = (there, back) * len(options.attention_blocks)
        misses = [attention_miss(a, x, true) for a, x, true in zip(attended, inputs, trues, strict=True)]
        return torch.stack(misses).mean()


def train(options: TrainOptions) -> None:
    """Train until the last step, or until the time is over.

    Raises InputError for a folder whose state is of other options.
    """
    training = Training(options)
    if (options.out / "state.pt").exists():
        training.load()
    options.out.mkdir(parents=True, exist_ok=True)
    begin = last = time.perf_counter()
    while training.step < options.steps:
        log: dict[str, object] = dict(training.advance())
        now = time.perf_counter()
        training.seconds, last = training.seconds + now - last, now
        over = options.minutes is not None and now - begin > 60 * options.minutes
        final = over or training.step == options.steps
        if final or training.step % options.validate_every == 0:
            log["validation"] = training.validate()
        if final or training.step % options.save_every == 0:
            training.save()
        if "validation" in log or training.step % 10 == 0:
            line = json.dumps({"step": training.step, "seconds": round(training.seconds, 1), **log})
            with open(options.out / "log.jsonl", "a") as stream:
                stream.write(line + "\n")
            sys.stderr.write(line + "\n")
        if over:
            return


def new_network(options: TrainOptions) -> Dust3r:
    """An untrained network whose points all lie a unit ahead of the camera."""
    network = Dust3r(**configuration(options))
    if options.shared_decoder:
        network.dec_blocks2 = network.dec_blocks
    for module in network.modules():
        if isinstance(module, nn.Linear):
            nn.init.trunc_normal_(module.weight, std=0.02)
            nn.init.zeros_(module.bias)
    for head in (network.downstream_head1, network.downstream_head2):
        # Channels x, y, z and confidence of a token's pixels, one after another; exp(log 2) - 1 = 1.
        head.get_parameter("proj.bias").data.view(4, -1)[2] = math.log(2)
    return network


def configuration(options: TrainOptions) -> dict[str, Any]:
    """The network's fields."""
    return {
        "enc_embed_dim": options.embed,
        "enc_depth": options.encoder_depth,
        "enc_num_heads": options.heads,
        "dec_embed_dim": options.embed,
        "dec_depth": options.decoder_depth,
        "dec_num_heads": options.heads,
        "head_type": "linear",
        "pos_embed": "RoPE100+cosine",
        "patch_size": options.patch,
        "patch_embed_cls": "ConvolutionalStem" if options.stem == "convolutions" else "PatchEmbedDust3R",
    }


def write_weights(folder: Path, state: dict[str, Tensor], options: TrainOptions) -> None:
    """model.safetensors in half precision and config.json, whole or not at all."""
    from safetensors.torch import save_file

    half = {
        key: value.detach().to("cpu", torch.float16).contiguous()
        for key, value in state.items()
        # Where there is no second decoder, the first one is read for it.
        if not (options.shared_decoder and key.startswith("dec_blocks2."))
    }
    with written_whole(folder / "model.safetensors") as temporary:
        save_file(half, temporary)
    size = [options.scene.width, options.scene.height]
    content = configuration(options) | {"only_size": size, "licence": options.licence}
    if options.attention:
        content["matching_block"] = options.attention_blocks[-1]
    write_text(folder / "config.json", json.dumps(content, indent=1) + "\n")


def predict(
    network: Dust3r, images: Tensor, first: Tensor, second: Tensor, both_orders: bool = False
) -> tuple[Pointmap, Pointmap]:
    """Pointmaps of pairs of images (n,3,h,w), each image being encoded once.

    `both_orders`, of a shared decoder: the pairs, and then the same ones the other way round.
    """
    features = network.encode(images)
    pairs = (Features(features.tokens[rows], features.grid) for rows in (first, second))
    return (network.decode_both_orders if both_orders else network.decode)(*pairs)


def true_points(views: Views, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Pointmaps of both views of pairs in the first one's camera frame, (e,h,w,3) each."""
    points = points_in_camera(views)
    first_from_second = torch.linalg.inv(views.world_from_camera[first]) @ views.world_from_camera[second]
    moved = torch.einsum("eij,ehwj->ehwi", first_from_second[:, :3, :3], points[second])
    return points[first], moved + first_from_second[:, None, None, :3, 3]


def _fixed(options: TrainOptions) -> dict[str, object]:
    return {key: value for key, value in asdict(options).items() if key not in FREE}
