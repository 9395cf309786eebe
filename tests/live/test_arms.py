"""Cameras and arms through their makers' packages, against a simulator of the maker or a stand-in."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from jcr.geometry import rotation_exp, rotation_log, transform
from jcr.live.cameras import set_up
from jcr.live.robot import MOVED_ON, next_rest, states_of
from places import ROOT
from refusal import refused

POSE = transform(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.42, -0.11, 0.36]))
JOINTS = np.array([0.3, -1.2, 1.5, -1.8, -1.5, 0.4])


def test_an_xarm_gives_pose_and_joints_from_its_makers_units(monkeypatch: pytest.MonkeyPatch):
    """Its package gives millimetres, a rotation vector and one angle more than the arm has joints."""

    class Arm:
        axis = len(JOINTS)

        def __init__(self, host: str, is_radian: bool, **_: bool) -> None:
            if host != "arm" or not is_radian:
                raise OSError("no answer")

        def get_position_aa(self, is_radian: bool) -> tuple[int, list[float]]:
            return 0, [*(1e3 * POSE[:3, 3]), *rotation_log(POSE[:3, :3])]

        def get_servo_angle(self, is_radian: bool) -> tuple[int, list[float]]:
            return 0, [*JOINTS, 0.0]

        def disconnect(self) -> None: ...

    for name in ("xarm", "xarm.wrapper"):
        monkeypatch.setitem(sys.modules, name, module := ModuleType(name))
        vars(module).update(XArmAPI=Arm)
    read, nobody = states_of("xarm:arm"), states_of("xarm:nobody")
    assert read is not None and nobody is not None
    found = next_rest(read, None, MOVED_ON)
    assert found.joints is not None
    assert np.allclose(found.base_from_gripper, POSE) and np.allclose(found.joints, JOINTS)
    with refused("xarm:nobody: no answer; check the address"):
        next(nobody())


FILMED = """
import gc, json, sys
from pathlib import Path
import numpy as np
from record_realsense import record
from jcr.live.cameras import open_camera
record(Path(sys.argv[1]))
with open_camera("realsense:" + sys.argv[1]) as camera:
    frames = list(camera.frames)
depth = np.unique(frames[0].depth_mm).tolist()
print(json.dumps([len(frames), frames[0].image.shape, depth, camera.intrinsics.model_dump()]))
del frames
gc.collect()
"""
"""Records with librealsense and reads the recording, in a process of its own: in that of the tests it broke others."""


@pytest.mark.slow
def test_a_realsense_gives_images_depth_in_millimetres_and_the_intrinsics_of_its_maker(tmp_path: Path):
    if find_spec("pyrealsense2") is None:
        pytest.skip("not installed: pyrealsense2")
    path = os.pathsep.join([str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", FILMED, str(tmp_path / "recording.db3")]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})
    if "libusb" in done.stderr:
        pytest.skip("pyrealsense2 needs libusb-1.0")
    assert done.returncode == 0, done.stderr
    count, shape, depth_mm, intrinsics = json.loads(done.stdout.splitlines()[-1])
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
    with refused("--camera-size 1280 720: camera 0 gives 640x480"):
        set_up(small, (1280, 720), "0")
