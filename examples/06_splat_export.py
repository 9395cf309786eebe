"""A Gaussian splat in the robot's own metres: a finished run as a data set of nerfstudio.

    python examples/06_splat_export.py [OUT]

OUT is the folder of a run, by default that of 01_quick_start.py. It writes OUT/splat with images, cameras and the
points that a splat starts from. To train it, where there is a GPU and `pip install nerfstudio`:

    ns-train splatfacto --data OUT/splat nerfstudio-data --orientation-method none --center-method none \\
        --auto-scale-poses False

The three options keep nerfstudio from rotating, shifting and scaling: a place in the splat is then a place in the
robot's base frame. The command line does the same: `jcr export OUT nerfstudio OUT/splat`.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np

import jcr

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/quick_start")
if not (out / "cloud.ply").exists():
    sys.exit(f"{out}: holds no run; first run examples/01_quick_start.py")
shutil.rmtree(out / "splat", ignore_errors=True)
jcr.export_run(out, "nerfstudio", out / "splat")

# What was written, read as nerfstudio does: camera-to-world matrices, the camera looking along its -z.
dataset = json.loads((out / "splat" / "transforms.json").read_text())
cameras = np.array([frame["transform_matrix"] for frame in dataset["frames"]])
print(f"{len(cameras)} cameras of {dataset['w']} x {dataset['h']} px, {dataset['fl_x']:.1f} px focal length")
print(f"they hang {cameras[:, 2, 3].min():.3f} to {cameras[:, 2, 3].max():.3f} m above the robot's base")
print(f"first points: {out / 'splat' / dataset['ply_file_path']}")
