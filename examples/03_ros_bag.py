"""A capture out of a ROS bag: the moments at which the arm stood still, with the gripper's pose at each.

    python examples/03_ros_bag.py [BAG BASE_FRAME GRIPPER_FRAME]

ROS 1, sqlite3 and MCAP bags are read without ROS; needs `pip install 'jcr-handeye[ros]'`. Without a bag a short MCAP
of an arm over the bundled table is made and read. The capture is left in out/ros_bag/capture: go on with `jcr run`.
"""

import shutil
import sys
from pathlib import Path

import numpy as np

import jcr

sys.path.append(str(Path(__file__).resolve().parents[1]))  # of the checkout, for what is simulated
from simulation.ros_bag import write_bag

out = Path("out/ros_bag")
shutil.rmtree(out, ignore_errors=True)
out.mkdir(parents=True)
if len(sys.argv) > 3:
    bag, base, gripper = sys.argv[1:4]
else:
    # /camera/image_raw/compressed and camera_info; /tf from base_link to tool0; the arm halts at 12 views.
    table = jcr.read_capture("examples/tabletop")
    bag = write_bag(out / "scan", table, "mcap", seconds=12.0, fps=10.0, tf_hz=50.0)
    base, gripper = "base_link", "tool0"

# Poses are interpolated at the images' stamps; frames are picked that are still, sharp and show most.
options = jcr.ReadOptions(base_frame=base, gripper_frame=gripper, frames=12)
capture = jcr.read_capture(bag, options, into=out / "capture")
print(f"took {len(capture)} frames, intrinsics {'given' if capture.intrinsics else 'to be estimated'}")
for name, pose in zip(capture.images, capture.base_from_gripper, strict=True):
    print(f"{name}: gripper at {np.array2string(pose[:3, 3], precision=3)} m")

# Before the half minute of a calibration: do these motions show everything, and how exact will it be?
found = jcr.check_capture(capture, look=False)
print(f"motions show everything: {found.observability.observable}")
if found.expected is not None and (seen := found.expected.seen) is not None:
    print(f"to be expected: a point within {seen.within_95_mm:.1f} mm (95 % of errors)")
print(f"next: jcr run {out / 'capture'} {out / 'run'}")
