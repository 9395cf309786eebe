"""The main job in five lines: from a capture to a calibrated camera and a map that can be asked.

    python examples/01_quick_start.py [CAPTURE [OUT]]

A capture is a folder with images and a capture.json (README.md). Without one the bundled table is taken: about
half a minute. Everything found is in OUT; open OUT/report.html, it explains each number.
"""

import sys

import numpy as np

import jcr

capture = jcr.read_capture(sys.argv[1] if len(sys.argv) > 1 else "examples/tabletop")
result = jcr.run(capture, sys.argv[2] if len(sys.argv) > 2 else "out/quick_start")

# The hand-eye transform. Ask `verdict` before you use it.
sigma_mm = 1e3 * np.sqrt(np.diag(result.covariance)[:3])
print(f"verdict: {result.verdict}")
print(f"gripper_from_camera (m):\n{result.gripper_from_camera.round(5)}")
print("one sigma of x, y, z: " + ", ".join(f"{sigma:.2f}" for sigma in sigma_mm) + " mm")

# What stands on the table.
measured = jcr.measure(result.out)
for thing in measured.objects:
    print(f"{thing.name}: {1e3 * thing.height:.0f} ± {1e3 * thing.height_std:.0f} mm high")

# The map, in the robot's base frame: is a ball of 2 cm free to be 30 cm above the first thing, and at its middle?
scene = jcr.load_map(result.out)
middle = measured.objects[0].base_from_box[:3, 3]
hits = scene.check_spheres(np.array([middle + [0, 0, 0.3], middle]), np.array([0.02, 0.02]), unknown="free")
print(f"touches above it: {hits[0]}, at its middle: {hits[1]}")
print(f"report: {result.out / 'report.html'}")
