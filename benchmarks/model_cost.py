"""`benchmarks model_cost`: seconds and memory of a pass of an any-view network with random weights, beside the estimate.

Time and memory do not depend on the weights' values. Each network runs in a process of its own, two threads.
"""

import json
import subprocess
import sys

from jcr.extras import is_installed
from jcr.reconstruct.backends import BACKENDS
from jcr.reconstruct.views_at_once.views_at_once import Cost

HEAD = (
    "network",
    "parameters",
    "views",
    "grid",
    "time",
    "processor time",
    "estimate",
    "peak memory",
    "over the program",
    "estimate",
)
VIEWS = (2, 10)
SIZE = (640, 480)
MEASURE = """
import json, resource, sys, time
import numpy as np, torch
from jcr.memory import resident
from jcr.reconstruct.views_at_once import da3
from jcr.reconstruct.views_at_once.interface import Views
torch.set_num_threads(2)
name, views, width, height = sys.argv[1], *map(int, sys.argv[2:])
before = resident()
torch.manual_seed(0)
network = da3.build(name)
images = np.random.default_rng(0).integers(0, 256, (views, height, width, 3), np.uint8)
start, used = time.perf_counter(), time.process_time()
found = da3.predict(network, Views(images, None))
peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps([time.perf_counter() - start, time.process_time() - used, peak, peak - before,
                  sum(p.numel() for p in network.parameters()), found.grid.size]))
"""


def run() -> str:
    """Markdown: a row a network and number of views."""
    lines = [
        f"Images of {SIZE[0]}x{SIZE[1]}, random weights of a fixed seed, float32 on the processor, two threads. "
        "Processor time is that of all threads. Estimate: what is said before a run (of time: on one core).",
        "",
        f"| {' | '.join(HEAD)} |",
        "|---" * len(HEAD) + "|",
    ]
    claim = ""
    for name, published in (("da3-small", "da3-small"), ("da3", "da3-base")):
        if not is_installed(BACKENDS[name].package):
            return f"> Not measured: {BACKENDS[name].package} is not installed ({BACKENDS[name].install}).\n"
        cost = Cost(*BACKENDS[name].cost)
        for views in VIEWS:
            seconds, used, peak, over, parameters, grid = _measured(published, views)
            cells = [
                published,
                f"{parameters / 1e6:.0f} M",
                str(views),
                f"{grid[0]}x{grid[1]}",
                *(f"{value:.0f} s" for value in (seconds, used, cost.seconds(views))),
                *(f"{value / 1e9:.2f} GB" for value in (peak, over, cost.bytes(views))),
            ]
            lines.append(f"| {' | '.join(cells)} |")
            if name == "da3-small":
                claim = (
                    f"> Depth Anything 3 SMALL sees {views} images in {seconds:.0f} s ({used:.0f} s of processor "
                    f"time) and {peak / 1e9:.1f} GB on two cores.\n"
                )
    return "\n".join([claim, *lines]) + "\n"


def _measured(name: str, views: int) -> list:
    """What MEASURE prints of a network and a number of views."""
    command = [sys.executable, "-W", "ignore", "-c", MEASURE, name, str(views), *map(str, SIZE)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])
