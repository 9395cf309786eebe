"""The main job on the bundled capture: calibrate, map, and hold the calibration against the truth.

`python examples/demo.py BACKEND`, or `make demo BACKEND=da3`, takes another back end than `auto` (jcr models).
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

import jcr
from jcr.calibration.summary import summary
from jcr.geometry import fit_similarity, rotation_between_deg
from jcr.progress import progress_bars

root = Path(__file__).parent.parent
start = time.perf_counter()
backend = sys.argv[1] if len(sys.argv) > 1 else "auto"
capture = jcr.read_capture(root / "examples/tabletop")
try:
    with progress_bars() as progress:
        result = jcr.run(capture, root / "out/demo", backend=backend, progress=progress)
except jcr.InputError as error:
    sys.stderr.write(f"error: {error}\n")
    sys.exit(2)
seconds = time.perf_counter() - start

truth = np.array(json.loads((capture.folder / "reference.json").read_text())["gripper_from_camera"])
centers = (capture.base_from_gripper @ truth)[:, :3, 3][result.reconstruction.image_index]
_, true_scale = fit_similarity(centers, result.reconstruction.recon_from_camera[:, :3, 3])
error_mm = 1e3 * np.linalg.norm(result.gripper_from_camera[:3, 3] - truth[:3, 3])
error_deg = rotation_between_deg(result.gripper_from_camera[:3, :3], truth[:3, :3])

print()
print(summary(result.calibration), end="")
error_scale = 100 * ((result.calibration.scale or 1.0) / true_scale - 1)
print(f"against the truth: {error_mm:.3f} mm, {error_deg:.4f}°, scale {error_scale:+.3f} % ({seconds:.0f} s)")
print(f"report: {result.out / 'report.html'}")
