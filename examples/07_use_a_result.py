"""What follows a run: the transform with its ±, a point in the base frame, a comparison, an export, the map.

python examples/07_use_a_result.py out/quick_start
"""

import json
import sys
from pathlib import Path

import numpy as np

import jcr

result = jcr.load_run(sys.argv[1])
std = np.sqrt(np.diag(result.covariance))
print(f"gripper_from_camera (m):\n{result.gripper_from_camera.round(5)}")
print(f"1σ: {(1e3 * std[:3]).round(2)} mm, {np.degrees(std[3:6]).round(3)}°")

# A point that the camera shows: its pixel, its depth (m), and the gripper pose that the robot reported at the image.
base_from_gripper = jcr.read_capture("examples/tabletop").base_from_gripper[0]
x_in_base, covariance = result.point_in_base(np.array([320.0, 240.0]), 0.45, base_from_gripper)
print(f"point: {x_in_base.round(4)} m ± {(1e3 * np.sqrt(np.diag(covariance))).round(2)} mm in the base")

# A 4×4 of another tool, such as cv2.calibrateHandEye: how far is it off?
other = json.loads(Path("examples/tabletop/reference.json").read_text("utf-8"))["gripper_from_camera"]
difference = jcr.compare(result, np.array(other))
print(f"other transform: {(1e3 * difference.translation_m).round(3)} mm apart")

print(f"exported: {jcr.export_run(result.out, 'camera_info')}")
scene = jcr.load_map(result.out)
sample = scene.query(x_in_base[None])
print(
    f"map at the point: occupancy {sample.occupancy[0]:.2f}, surface {1e3 * sample.distance[0]:.0f} mm away"
)
