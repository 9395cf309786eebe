"""The viewer: what its controls answer on the bundled capture, and that a browser shows it."""

import io
import os
import re
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chromium import Chromium
from jcr.cli import dispatch
from jcr.records import Capture
from jcr.result import RunResult
from refusal import refused
from simulation.truth import Truth, read_truth
from waiting import until

if TYPE_CHECKING:
    from jcr.viewer.viewer import Viewer

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


@pytest.fixture(scope="module")
def truth(tabletop: Path) -> Truth:
    return read_truth(tabletop)


@pytest.fixture(scope="module")
def gantry(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A URDF that slides along x, y, z and then rotates about z, y, x: it can bring its tool anywhere."""
    parts, parent = ['<robot name="gantry"><link name="floor"/>'], "floor"
    for kind, axes, reach in (("prismatic", "xyz", 2.0), ("revolute", "zyx", 3.1)):
        for axis in axes:
            link = f"{kind}_{axis}"
            parts.append(
                f'<link name="{link}"><visual><geometry><box size="0.04 0.05 0.06"/></geometry></visual></link>'
                f'<joint name="to_{link}" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
                f'<axis xyz="{AXES[axis]}"/><limit lower="-{reach}" upper="{reach}" effort="1" velocity="1"/></joint>'
            )
            parent = link
    path = tmp_path_factory.mktemp("robot") / "gantry.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    return path


@pytest.fixture(scope="module")
def capture(done: Path) -> Capture:
    """The bundled capture with the joint values that bring the gantry's tool to each gripper pose."""
    read = RunResult(done).capture
    poses = read.base_from_gripper
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
    return replace(read, joints=np.hstack([poses[:, :3, 3], angles]))


@pytest.fixture(scope="module")
def viewer(done: Path, capture: Capture, gantry: Path) -> "Iterator[Viewer]":
    from jcr.viewer import viewer as module

    server = module.open_server(0, "test")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "MOST_DRAWN", 15_000)  # drawn without a graphics card
        yield module.Viewer(server, RunResult(done, capture=capture), gantry)
    server.stop()


def test_points_are_those_of_the_map_or_of_the_cloud(viewer: "Viewer"):
    from jcr.report.scene3d import MEASURED

    first = viewer.shown.value
    assert 5000 < len(viewer.points) <= 15_000
    assert np.percentile(np.abs(viewer.scene.query(viewer.points).distance), 95) < viewer.scene.cell / 2
    viewer.shown.value = MEASURED
    viewer.show_points()
    assert len(viewer.points) == 15_000 and np.isin(viewer.points, viewer.cloud.points_in_base).all()
    viewer.shown.value = first
    viewer.show_points()


def test_sphere_becomes_red_in_an_object_and_where_nobody_looked(viewer: "Viewer", truth: Truth):
    from jcr.viewer.viewer import COLLIDES, FREE

    book = next(thing for thing in truth.objects if thing.name == "book")
    top = book.base_from_box[2, 3] + book.box_size[2] / 2

    def color(x: float, y: float, z: float) -> tuple[int, ...]:
        viewer.gizmo.position = (x, y, z)
        viewer.move_sphere()
        return tuple(viewer.ball.color)

    viewer.radius.value = 30.0
    over = (*book.base_from_box[:2, 3], top + 0.08)
    assert color(*over) == FREE and "free" in viewer.answer.content
    assert color(*book.base_from_box[:2, 3], top - 0.01) == COLLIDES and "collides" in viewer.answer.content
    assert color(*over[:2], viewer.scene.box[0, 2] + 1e-3) == COLLIDES
    far = (*over[:2], 5.0)
    assert color(*far) == COLLIDES and "outside of the workspace" in viewer.answer.content
    viewer.unknown.value = "free"
    assert color(*far) == FREE
    viewer.unknown.value = "occupied"
    color(*over)


def test_click_finds_the_first_point_and_shows_what_is_there(viewer: "Viewer", truth: Truth):
    from jcr.report.scene3d import MEASURED

    first = viewer.shown.value
    book = next(thing for thing in truth.objects if thing.name == "book")
    x, y, z = book.base_from_box[:3, 3]
    viewer.shown.value = MEASURED
    viewer.show_points()
    said = viewer.click(np.array([x, y, z + 0.4]), np.array([0.0, 0.0, -1.0]))
    found = np.asarray(viewer._mark.position)
    assert abs(found[2] - (z + book.box_size[2] / 2)) < 0.01
    at = viewer.scene.query(found[None].astype(float))
    # The mark is in single precision, and the occupancy changes within a millimetre at the surface.
    shown = float(re.findall(r"<td>([01]\.\d\d)(?:, unknown)?</td>", said)[0])
    assert abs(shown - at.occupancy[0]) < 0.05 and "images/" in said and "margin" in said
    assert "No point" in viewer.click(np.array([x, y, z + 0.4]), np.array([0.0, 0.0, 1.0]))
    viewer.shown.value = first
    viewer.show_points()


def test_robot_and_chosen_camera_follow_the_image(viewer: "Viewer"):
    from jcr.viewer.viewer import CHOSEN

    for row in (7, 2):
        viewer.image.value = row
        viewer.choose_image()
        assert [tuple(f.color) == CHOSEN for f in viewer.frusta] == [k == row for k in range(12)]
        stands = viewer.robot._urdf.get_transform("revolute_x", "floor")
        np.testing.assert_allclose(stands, viewer.capture.base_from_gripper[row], atol=1e-9)
        assert f"images/{row:02d}.jpg" in viewer._about_image.content


def test_a_robot_without_joint_values_or_joints_is_refused(capture: Capture, gantry: Path, tmp_path: Path):
    from jcr.viewer.viewer import read_robot

    robot, configurations = read_robot(gantry, replace(capture, joints=np.ones((12, 4))))
    assert configurations.shape == (12, len(robot.actuated_joint_names)) and configurations[:, 4:].max() == 0
    with refused("no joint values"):
        read_robot(gantry, replace(capture, joints=None))
    with refused("moves 6 joints, the capture has 7 values"):
        read_robot(gantry, replace(capture, joints=np.zeros((12, 7))))
    with refused("cannot be read"):
        read_robot(tmp_path / "none.urdf", capture)


def test_command_serves_this_machine_alone_until_interrupted(done: Path, monkeypatch: pytest.MonkeyPatch):
    """In this process, which another thread interrupts once it has asked from this machine and from outside."""
    printed, answers = io.StringIO(), []

    def ask() -> None:
        try:
            until(lambda: "\n" in printed.getvalue())
            host, port = printed.getvalue().split()[0].removeprefix("http://").split(":")
            with socket.create_connection((host, int(port)), timeout=10) as asked:
                asked.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
                answers.append((host, asked.recv(100)))
            for *_, (ip, *_) in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET):
                if not ip.startswith("127."):
                    with pytest.raises(OSError):
                        socket.create_connection((ip, int(port)), timeout=2).close()
            answers.append("closed to others")
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(sys, "stdout", printed)
    asking = threading.Thread(target=ask)
    asking.start()
    status = dispatch(["view", str(done), "--port", "0", "--quiet"])
    asking.join()
    (host, answer), closed = answers
    assert status == 0 and host == "127.0.0.1" and b"200" in answer and closed
    assert printed.getvalue().count("\n") == 1


@pytest.mark.long
def test_the_panel_is_closed_on_a_phone_and_open_on_a_desktop(viewer: "Viewer", tmp_path: Path):
    gpu = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    chromium = Chromium(tmp_path, *gpu)
    panel = "document.querySelector('.mantine-ScrollArea-root')?.offsetHeight ?? 0"
    try:
        for width, low, high in ((1000, 150, 900), (390, 20, 100)):
            chromium.open(f"http://127.0.0.1:{viewer.server.get_port()}", width, 900)
            until(lambda low=low, high=high: low < chromium.js(panel) < high)
    finally:
        chromium.close()
