"""`benchmarks memory`: peak resident set of the whole job against the budget, and what was said of it before."""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from safetensors.torch import save_file

from benchmarks.align import CHILD
from benchmarks.pairs import random_network
from jcr.files import write_text
from jcr.memory import GB
from jcr.reconstruct.dust3r.pair_graph import PairOptions
from jcr.simulate.capture import SimulateOptions, simulate

IMAGES = (8, 20, 40)
"""All but the first with --long."""
WIDTH = 240
LOOSE_GB = 8.0
AT_ONCE = 2
"""Processes; what one takes does not depend on the other."""
TOO_LITTLE_GB = 0.1
SMALL = {
    "enc_embed_dim": 192,
    "enc_depth": 4,
    "enc_num_heads": 3,
    "dec_embed_dim": 96,
    "dec_depth": 4,
    "dec_num_heads": 3,
    "head_type": "linear",
}
"""Three million parameters; its weights are random, for what it says of the images changes no size."""
DPT = SMALL | {"dec_depth": 10, "head_type": "dpt"}
"""With the heads of the published network, 43 million."""
PREDICT, NEAR = ["--pair-graph", "complete", "--cache-gb", "0"], ["--pair-graph", "window"]
SQUARE = ["--image-size", "224"]
"""20 images then make 0.61 GB of pointmaps."""


@dataclass(frozen=True)
class Job:
    """A command, on captures of this many images."""

    name: str
    command: list[str]
    images: Sequence[int]
    loose: bool = False
    """Whether the largest capture is run with LOOSE_GB, too."""


@dataclass(frozen=True)
class Peak:
    """One process."""

    images: int
    budget_gb: float
    said_gb: float
    in_file_gb: float
    """Of pointmaps."""
    peak_gb: float


def run(long: bool = False) -> str:
    """Markdown: budget, announced and measured peak for COLMAP and small networks, by number of images."""
    counts = IMAGES if long else IMAGES[:1]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        captures = {count: _capture(folder, count) for count in counts}
        linear, dpt = (_weights(folder / name, config) for name, config in (("linear", SMALL), ("dpt", DPT)))
        run, predict = ["run", "--backend", "dust3r", "--weights"], ["predict", "--weights"]
        jobs = [
            Job("`jcr run`, COLMAP", ["run", "--backend", "colmap"], IMAGES, loose=True),
            Job("`jcr run`, small network", [*run, linear], IMAGES[:1]),
            Job("`jcr run`, small network, near pairs", [*run, linear, *NEAR], IMAGES[2:], loose=True),
            Job(
                "`jcr predict`, small network, 224x224",
                [*predict, linear, *PREDICT, *SQUARE],
                IMAGES[1:2],
                loose=True,
            ),
            Job("`jcr predict`, small network, DPT heads", [*predict, dpt, *PREDICT], IMAGES[:1]),
        ]

        def peaks(each: tuple[Job, int]) -> list[tuple[str, Peak]]:
            job, count = each
            least = _least(job.command, captures[count], folder)
            budgets = (least, LOOSE_GB) if job.loose and count == counts[-1] else (least,)
            return [(job.name, _peak(job.command, captures[count], folder, budget)) for budget in budgets]

        each = [(job, count) for job in jobs for count in job.images if count in counts]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            rows = [row for found in pool.map(peaks, each) for row in found]
    kept = sum(row.peak_gb <= row.budget_gb for _, row in rows)
    over = max(row.peak_gb / row.said_gb for _, row in rows)
    among = f"{counts[0]} to {counts[-1]}" if long else f"{counts[0]}"
    lines = [
        f"> The peak resident set stays within `--memory-gb` in {kept} of {len(rows)} runs of {among} images, with the "
        f"least budget that is not refused and with {LOOSE_GB:g} GB; it is at most {over:.2f} times what was announced.",
        "",
        f"Simulated tabletop, images of {WIDTH}x{WIDTH * 3 // 4}, a process each. The least budget is the one that the "
        f"refusal of {TOO_LITTLE_GB:g} GB names. The small networks have random weights and see every pair, at "
        f"512x384 unless said; *near pairs*, those of images up to {PairOptions.window} apart. Peak: VmHWM, the program "
        "itself included.",
        "",
        "| job | images | budget | announced | pointmaps in a file | peak |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in rows:
        in_file = f"{row.in_file_gb:.2g} GB" if row.in_file_gb else ""
        sizes = f"{row.budget_gb:.1f} GB | {row.said_gb:.2g} GB | {in_file} | {row.peak_gb:.2f} GB"
        lines.append(f"| {name} | {row.images} | {sizes} |")
    return "\n".join(lines) + "\n"


def _capture(folder: Path, count: int) -> Path:
    """The first images of the largest capture, made smaller."""
    large, small = folder / "large", folder / f"capture{count}"
    if not large.exists():
        simulate(large, SimulateOptions(images=max(IMAGES), truth="scene"))
    content = json.loads((large / "capture.json").read_text())
    frames, intrinsics = content["frames"][:count], content["intrinsics"]
    (small / "images").mkdir(parents=True)
    with Image.open(large / frames[0]["image"]) as image:
        factor = WIDTH / image.width
    for frame in frames:
        with Image.open(large / frame["image"]) as image:
            size = (WIDTH, round(image.height * factor))
            image.resize(size, Image.Resampling.BOX).save(small / frame["image"], quality=95)
    intrinsics |= {name: intrinsics[name] * factor for name in ("fx", "fy")}
    intrinsics |= {name: (intrinsics[name] + 0.5) * factor - 0.5 for name in ("cx", "cy")}
    write_text(small / "capture.json", json.dumps({"frames": frames, "intrinsics": intrinsics}))
    return small


def _weights(folder: Path, config: dict) -> str:
    """A folder with the random weights of a network."""
    folder.mkdir()
    network = random_network(config)
    save_file(
        {key: value.contiguous() for key, value in network.state_dict().items()}, folder / "model.safetensors"
    )
    write_text(folder / "config.json", json.dumps(config))
    return str(folder)


def _least(command: Sequence[str], capture: Path, folder: Path) -> float:
    """The budget (GB) that the program names when it refuses a smaller one."""
    status, text = _jcr(command, capture, folder, TOO_LITTLE_GB)
    named = re.search(r"raise --memory-gb to ([\d.]+)", text)
    if status != 2 or named is None:
        raise RuntimeError(f"jcr {' '.join(command)} did not refuse {TOO_LITTLE_GB} GB: {text}")
    return float(named[1])


def _peak(command: Sequence[str], capture: Path, folder: Path, budget_gb: float) -> Peak:
    status, text = _jcr(command, capture, folder, budget_gb)
    said = re.search(r"about ([\d.]+) GB, the program included(?:, and ([\d.]+) GB of pointmaps)?", text)
    high = re.search(r"VmHWM:\s+(\d+) kB", text)
    if status not in (0, 3) or said is None or high is None:
        raise RuntimeError(f"jcr {' '.join(command)} with {budget_gb} GB ended with status {status}: {text}")
    images = len(json.loads((capture / "capture.json").read_text())["frames"])
    return Peak(images, budget_gb, float(said[1]), float(said[2] or 0), 1024 * int(high[1]) / GB)


def _jcr(command: Sequence[str], capture: Path, folder: Path, budget_gb: float) -> tuple[int, str]:
    """Status and stderr of one command in a process and an output of its own."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        name, *options = command
        place = f"{out}/pairs.npz" if name == "predict" else f"{out}/run"
        arguments = [name, str(capture), place, *options, "--memory-gb", str(budget_gb), "--device", "cpu"]
        environment = os.environ | {"XDG_CACHE_HOME": out}  # no pairs from a run before
        child = [sys.executable, "-c", CHILD, *arguments]
        done = subprocess.run(child, env=environment, capture_output=True, text=True)
    return done.returncode, done.stderr
