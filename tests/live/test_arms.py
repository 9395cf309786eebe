"""Cameras and arms through their makers' packages, against simulators of the makers or fakes of the protocols."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import jcr
from fake_arms import fake_xarm
from jcr.geometry import rotation_exp, transform
from jcr.live.cameras import set_up
from places import ROOT

POSE = transform(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.42, -0.11, 0.36]))
JOINTS = np.array([0.3, -1.2, 1.5, -1.8, -1.5, 0.4])


def needs(*packages: str) -> None:
    """Skip where one is missing, without importing it: one of them broke the process in which tests ran on."""
    if missing := [name for name in packages if find_spec(name) is None]:
        pytest.skip(f"not installed: {', '.join(missing)}")


def named_by(script: str, *words: object) -> Any:
    """What a script of its own process prints as JSON, its last line; garbage is collected before it ends."""
    lines = [*script.strip("\n").splitlines(), "    import gc", "    gc.collect()"]
    command = [sys.executable, "-c", "\n".join(line.removeprefix("    ") for line in lines), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


ASK = """
    import json, sys
    from jcr.errors import InputError
    from jcr.live.robot import states_of
    from jcr.live.robot import MOVED_ON, next_rest
    ask = next_rest(states_of(f"{sys.argv[1]}:{sys.argv[2]}"), None, MOVED_ON)
    try:
        next(states_of(f"{sys.argv[1]}:{sys.argv[3]}")())
    except InputError as error:
        refused = str(error)
    print(json.dumps([ask.base_from_gripper.tolist(), ask.joints.tolist(), refused]))
"""


@pytest.mark.slow
def test_an_arm_gives_pose_and_joints_through_its_makers_package():
    needs("xarm")
    with fake_xarm("127.0.0.7", POSE, JOINTS):
        pose, joints, refused = named_by(ASK, "xarm", "127.0.0.7", "127.0.0.8")
    # An xArm tells float32, and its package keeps six digits.
    assert np.allclose(pose, POSE, atol=1e-6) and np.allclose(joints, JOINTS, atol=1e-6)
    assert "xarm:127.0.0.8" in refused and "check the address" in refused


FILMED = """
    import json, sys
    import numpy as np
    import pyrealsense2 as rs
    from jcr.live.cameras import open_camera
    with open_camera("realsense:" + sys.argv[1]) as camera:
        frames = list(camera.frames)
    depth = np.unique(frames[0].depth_mm).tolist()
    print(json.dumps([len(frames), frames[0].image.shape, depth, camera.intrinsics.model_dump()]))
"""


@pytest.mark.slow
def test_a_realsense_gives_images_depth_in_millimetres_and_the_intrinsics_of_its_maker(tmp_path: Path):
    needs("pyrealsense2")
    file = tmp_path / "recording.db3"
    path = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        made = subprocess.run(
            [sys.executable, ROOT / "tests" / "record_realsense.py", file], capture_output=True
        )
        if b"libusb" in made.stderr:
            pytest.skip("pyrealsense2 needs libusb-1.0")
        assert made.returncode == 0, made.stderr
        count, shape, depth_mm, intrinsics = named_by(FILMED, file)
    assert count >= 3 and shape == [480, 640, 3]
    # 1001 units of half a millimetre.
    assert set(depth_mm) <= {0, 500, 501}
    assert (intrinsics["fx"], intrinsics["cy"]) == (600.0, 242.0)
    assert intrinsics["distortion"] is None


class Device:
    """A cv2.VideoCapture that follows some settings and not others."""

    def __init__(self, fixed: dict[int, float]):
        self.fixed: dict[int, float] = fixed
        self.values: dict[int, float] = {}

    def set(self, prop: int, value: float) -> bool:
        self.values[prop] = self.fixed.get(prop, value)
        return True

    def get(self, prop: int) -> float:
        return self.values.get(prop, self.fixed.get(prop, 0.0))


def test_a_device_keeps_to_its_size_or_shows_what_it_does_instead():
    device = Device({})
    set_up(device, (1280, 720), "0")
    values = [
        device.values[getattr(cv2, f"CAP_PROP_{name}")]
        for name in ("FRAME_WIDTH", "FRAME_HEIGHT", "AUTOFOCUS")
    ]
    assert values == [1280, 720, 0]
    small = Device({cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480})
    with pytest.raises(jcr.InputError, match="--camera-size 1280 720: camera 0 gives 640x480"):
        set_up(small, (1280, 720), "0")
