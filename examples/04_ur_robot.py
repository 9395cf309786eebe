"""Take a capture from a program of your own with `jcr.LiveCalibration`: after each image, how exact it is.

    python examples/04_ur_robot.py [ROBOT_ADDRESS [CAMERA]]

Move a Universal Robots arm and press Enter at each pose; nothing is sent to it, its pose is read from port 30003. CAMERA
is a number or a stream of OpenCV (default 0). Without an address the images and poses of the bundled table are used.
`jcr capture captures/table --camera 0 --poses ur:ADDRESS` does the same with a live page.
"""

import shutil
import socket
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import jcr


def ur_pose(host):
    """Return base_from_gripper (4,4) from one packet of the real-time interface (software 3.0 and later)."""
    with (
        socket.create_connection((host, 30003), timeout=5) as connection,
        connection.makefile("rb") as stream,
    ):
        (length,) = struct.unpack("!i", stream.read(4))
        x, y, z, *rotation_vector = struct.unpack_from("!6d", stream.read(length - 4), 440)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    pose[:3, 3] = x, y, z
    return pose


def robot_samples(host, source):
    """Yield an image (RGB) and the gripper pose whenever Enter is pressed."""
    camera = cv2.VideoCapture(int(source) if source.isdigit() else source)
    while input("let the arm rest and press Enter, or q and Enter to end: ") != "q":
        for _ in range(5):  # older images wait in the driver's buffer
            _, image = camera.read()
        yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB), ur_pose(host)


def bundled_samples(count):
    """Yield the first images and poses of the bundled capture."""
    table = jcr.read_capture("examples/tabletop")
    for name, pose in list(zip(table.images, table.base_from_gripper, strict=True))[:count]:
        yield cv2.cvtColor(cv2.imread(str(table.folder / name)), cv2.COLOR_BGR2RGB), pose


if len(sys.argv) > 1:
    out = Path("captures/ur")  # a capture that was begun there is resumed
    samples = robot_samples(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "0")
else:
    out = Path("out/ur_robot")
    shutil.rmtree(out, ignore_errors=True)
    samples = bundled_samples(5)

live = jcr.LiveCalibration(out)
for image, base_from_gripper in samples:
    progress = live.add(image, base_from_gripper)
    print(progress)
    if progress.requirement_met:
        break
live.close()
print(f"{len(progress.images)} images in {out}; next: jcr run {out} out/ur_run")
