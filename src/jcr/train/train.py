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
from jcr.reconstruct.dust3r.network import Dust3r, Features
from jcr.train.loss import attention_miss, confident_regression, true_attention
from jcr.train.options import TrainOptions
from jcr.train.scenes import Views, draw_views, narrowed, pairs_of, points_in_camera, seen_by
from jcr.train.textures import make_textures
from jcr.train.validate import capture_views, pair_errors, summary

FREE = {"steps", "minutes", "save_every", "validate_every", "captures", "device", "out", "from_weights"}
"""Options that may change when a training goes on."""
HELD_OUT_SEED = 1 << 31
"""Of scenes that no training draws; torch's CPU generator tells only the lowest 32 bits apart."""
SAMPLE = 4
"""Every how many rows and columns of pixels it is found out what the other view sees."""


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
        self.bank: tuple[int, Tensor] | None = None

    def advance(self) -> dict[str, float]:
        """One step: its losses."""
        options = self.options
        views = self.views(self.step)
        first, second = pairs_of(views, options.scene)
        self._set_rates()
        decoders = (self.network.dec_blocks, self.network.dec_blocks2)
        attended = [
            decoder.get_submodule(f"{block}.cross_attn")
            for block in options.attention_blocks
            for decoder in decoders
        ]
        inputs: list[tuple[Tensor, ...]] = []
        hooks = [a.register_forward_pre_hook(lambda _, args: inputs.append(args)) for a in attended]
        # Of these few tokens plain attention is the quickest on a CPU.
        backend = SDPBackend.MATH if self.device.type == "cpu" else SDPBackend.EFFICIENT_ATTENTION
        with sdpa_kernel([backend, SDPBackend.MATH]):
            predicted = predict(self.network, views.images, first, second)
            for hook in hooks:
                hook.remove()
            true = true_points(views, first, second)
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
        return {key: value.item() for key, value in log.items()} | {"pairs": len(first)}

    def views(self, step: int, scenes: int | None = None) -> Views:
        """The views that a step trains on."""
        options = self.options
        number = step // options.bank_steps
        if self.bank is None or self.bank[0] != number:
            self.bank = number, make_textures(options.textures, self._generator(2 * number + 1))
        count = scenes or options.scenes_per_step
        width = min(1.0, (1 + 2 * step / max(1.0, options.widen * options.steps)) / 3)
        return draw_views(count, narrowed(options.scene, width), self.bank[1], self._generator(2 * step))

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

    def _generator(self, number: int) -> torch.Generator:
        """For one purpose at one step of one seed."""
        return torch.Generator(self.device).manual_seed(
            (self.options.seed * 100_003_001 + number) % HELD_OUT_SEED
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
        size = (self.options.scene.width, self.options.scene.height)
        there, back = (
            true_attention(*seen_by(views, a, b, SAMPLE), size) for a, b in ((first, second), (second, first))
        )
        trues = (there, back) * len(self.options.attention_blocks)
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
    }


def write_weights(folder: Path, state: dict[str, Tensor], options: TrainOptions) -> None:
    """model.safetensors in half precision and config.json, whole or not at all."""
    from safetensors.torch import save_file

    half = {key: value.detach().to("cpu", torch.float16).contiguous() for key, value in state.items()}
    with written_whole(folder / "model.safetensors") as temporary:
        save_file(half, temporary)
    size = [options.scene.width, options.scene.height]
    content = configuration(options) | {"only_size": size, "licence": options.licence}
    write_text(folder / "config.json", json.dumps(content, indent=1) + "\n")


def predict(network: Dust3r, images: Tensor, first: Tensor, second: Tensor):
    """Pointmaps of pairs of images (n,3,h,w), each image being encoded once."""
    features = network.encode(images)
    return network.decode(*(Features(features.tokens[rows], features.grid) for rows in (first, second)))


def true_points(views: Views, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Pointmaps of both views of pairs in the first one's camera frame, (e,h,w,3) each."""
    points = points_in_camera(views)
    first_from_second = torch.linalg.inv(views.world_from_camera[first]) @ views.world_from_camera[second]
    moved = torch.einsum("eij,ehwj->ehwi", first_from_second[:, :3, :3], points[second])
    return points[first], moved + first_from_second[:, None, None, :3, 3]


def _fixed(options: TrainOptions) -> dict[str, object]:
    return {key: value for key, value in asdict(options).items() if key not in FREE}
