"""Exports read back by the tools that own the formats, against known transforms and the true scene."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
import yaml
import yourdfpy
from PIL import Image
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import analytic_scene
import jcr
from in_process import run_jcr
from jcr.camera import project, unproject
from jcr.capture.images import read_image
from jcr.cell.cameras_json import (
    ArmPlacement,
    CameraPlacement,
    CamerasFile,
    TransformUncertainty,
    write_cameras,
)
from jcr.cli import dispatch
from jcr.errors import RejectedError
from jcr.export import ros, simulators
from jcr.export.formats import FORMATS, export_run
from jcr.export.options import ExportOptions, provenance
from jcr.findings import Finding, FindingKind
from jcr.geometry import ROOT_FROM_OPTICAL, Similarity, apply, inverse, rotation_exp, transform
from jcr.records import CellCamera, Intrinsics, Tracks
from jcr.scene.cloud import read_cloud
from places import ROOT
from refusal import refused
from simulation.capture import FRAME_NAMES
from simulation.problems import shown_points
from simulation.scenes import make_scene, solid_labels
from simulation.truth import read_truth

if TYPE_CHECKING:
    from jcr.export.nerfstudio_colmap import PosedImages
    from jcr.scene.scene_map import SceneMap

DOUBT = "scale: every view rotates about <one> point -- vary the distance"
"""With what ends an XML comment in it."""
PARENT_FROM_CHILD = transform(rotation_exp(np.array([0.4, -2.1, 1.3])), np.array([-0.0524, 0.0407, 1 / 3]))


@pytest.fixture(scope="module")
def scene(done: Path) -> "SceneMap":
    return jcr.load_map(done)


def mount(doubt: str | None = None) -> ros.CameraMount:
    return ros.CameraMount(parent="tool0", child="optical", parent_from_child=PARENT_FROM_CHILD, doubt=doubt)


def of_quat(x, y, z, qx, qy, qz, qw) -> np.ndarray:
    return transform(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), np.array([x, y, z]))


def of_publisher(words: list[str]) -> np.ndarray:
    options = dict(zip(words[::2], words[1::2], strict=True))
    assert (options["--frame-id"], options["--child-frame-id"]) == ("tool0", "optical")
    return of_quat(*(float(options[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")))


def of_launch_xml(path: Path) -> np.ndarray:
    node = ElementTree.parse(path).getroot().find("node")
    assert node is not None
    assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
    return of_publisher(node.get("args", "").split())


def of_launch_py(path: Path) -> np.ndarray:
    """The file run as ROS runs it, with stand-ins that keep what they are given."""
    content: dict = {}
    launch, actions = SimpleNamespace(LaunchDescription=list), SimpleNamespace(Node=dict)
    stand_ins: dict = {"launch": launch, "launch_ros": SimpleNamespace(), "launch_ros.actions": actions}
    with patch.dict(sys.modules, stand_ins):
        exec(path.read_text(), content)
        (node,) = content["generate_launch_description"]()
    assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
    return of_publisher(node["arguments"])


def of_urdf(path: Path) -> np.ndarray:
    return yourdfpy.URDF.load(path).get_transform("optical", "tool0")


def of_snippet(path: Path) -> np.ndarray:
    """Return the transform of the commented elements, copied into the URDF of an arm."""
    _, _, snippet = path.read_text().rpartition("robot:")
    robot = ElementTree.fromstring(f"<robot name='arm'>{snippet.partition('-->')[0]}</robot>")
    ElementTree.SubElement(robot, "link", name="tool0")
    ElementTree.ElementTree(robot).write(path.with_name("arm.urdf"))
    return of_urdf(path.with_name("arm.urdf"))


def of_calib(path: Path) -> np.ndarray:
    content = yaml.safe_load(path.read_text())
    names = ("calibration_type", "name", "robot_base_frame", "robot_effector_frame", "tracking_base_frame")
    expected = ["eye_in_hand", path.stem, "base", "tool0", "optical"]
    assert [content["parameters"][name] for name in names] == expected
    at, rotation = content["transform"]["translation"], content["transform"]["rotation"]
    return of_quat(*(at[axis] for axis in "xyz"), *(rotation[axis] for axis in "xyzw"))


READERS = {
    "hand_eye.launch.xml": (ros.ros2_launch, of_launch_xml),
    "hand_eye.launch.py": (ros.moveit_launch, of_launch_py),
    "hand_eye.urdf": (ros.urdf, of_urdf),
    "snippet.urdf": (ros.urdf, of_snippet),
    "hand_eye.calib": (lambda mount: ros.easy_handeye2(mount, "hand_eye"), of_calib),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("doubt", [None, DOUBT])
def test_ros_files_hold_the_transform_and_name_frames_and_units(name: str, doubt: str | None, tmp_path: Path):
    write, read = READERS[name]
    path = tmp_path / name
    path.write_text(write(mount(doubt)))
    np.testing.assert_allclose(read(path), PARENT_FROM_CHILD, atol=1e-9)
    line = ros.static_transform_publisher(mount())
    np.testing.assert_allclose(of_publisher(line.split()[4:]), PARENT_FROM_CHILD, atol=1e-9)
    first = path.read_text()[:300]
    assert "optical in tool0" in first and "metres, radians" in first
    assert ("REJECTED: scale: every view" in first) == (doubt is not None)


def test_the_calib_of_a_fixed_camera_names_the_base_as_parent_and_the_gripper_as_effector():
    fixed = ros.CameraMount(
        parent="base_link",
        child="overhead",
        parent_from_child=PARENT_FROM_CHILD,
        base="base_link",
        effector="tool0",
    )
    stated = yaml.safe_load(ros.easy_handeye2(fixed, "cell"))["parameters"]
    names = ("calibration_type", "robot_base_frame", "robot_effector_frame", "tracking_base_frame")
    assert [stated[name] for name in names] == ["eye_on_base", "base_link", "tool0", "overhead"]


def test_files_name_the_intrinsics_that_their_transform_belongs_to(done: Path, tmp_path, capsys):
    content = json.loads((done / "calibration.json").read_text())
    kept = content["with_given_intrinsics"]
    pairs = {
        "estimated": (content["gripper_from_camera"], content["intrinsics"]),
        "given": (kept["gripper_from_camera"], kept["intrinsics"]),
    }
    stated = jcr.read_capture(ROOT / "examples" / "tabletop").intrinsics
    assert stated is not None and kept["intrinsics"]["fx"] == stated.fx
    for which, (transform_of_pair, intrinsics) in pairs.items():
        file = export_run(done, "camera_info", tmp_path / f"{which}.yaml", {"intrinsics": which})
        written = yaml.safe_load(file.read_text())["camera_matrix"]["data"]
        assert written[0] == pytest.approx(intrinsics["fx"]) and written[2] == pytest.approx(intrinsics["cx"])
        file = export_run(done, "easy_handeye2", tmp_path / f"{which}.calib", {"intrinsics": which})
        text = file.read_text()
        position = yaml.safe_load(text)["transform"]["translation"]
        assert [position[axis] for axis in "xyz"] == pytest.approx([row[3] for row in transform_of_pair[:3]])
        assert f"belongs to these intrinsics (640 x 480 px): fx {intrinsics['fx']:.6g}" in text
        capsys.readouterr()
        export(done, "ros2", tmp_path / f"{which}.xml", "--intrinsics", which)
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith(f"belongs to fx {intrinsics['fx']:.1f}") and "--intrinsics given" in last
    export(done, "colmap", tmp_path / "colmap")
    assert "mm (median), by the robot's errors" in capsys.readouterr().err
    wide = kept | {"seen": kept["seen"] | {"within_95_mm": 6.9}}
    (done / "calibration.json").write_text(json.dumps(content | {"with_given_intrinsics": wide}))
    export(done, "ros2", tmp_path / "wide.xml", "--intrinsics", "given")
    assert "with the given intrinsics a point is within 6.9 mm" in capsys.readouterr().err
    del content["with_given_intrinsics"]
    (done / "calibration.json").write_text(json.dumps(content | {"with_given_intrinsics": None}))
    with refused("--intrinsics given"):
        export_run(done, "camera_info", tmp_path / "none.yaml", {"intrinsics": "given"})
    (done / "calibration.json").write_text(json.dumps(content | {"with_given_intrinsics": kept}))


def test_files_of_several_cameras_stand_side_by_side_and_the_hint_names_the_camera(tmp_path: Path):
    """The file of a second camera was refused, or took the place of the first; the hint wrote the first's intrinsics."""
    out = shutil.copytree(ROOT / "tests" / "calibrations", tmp_path / "out")
    (out / "accepted.json").rename(out / "calibration.json")
    camera = CellCamera(name="fixed0", mount="base", images=("0.png",), image_size=(640, 480))
    spread = TransformUncertainty.of(1e-6 * np.eye(6))
    place = CameraPlacement.of(
        camera, (), base_from_camera=PARENT_FROM_CHILD, uncertainty=spread, intrinsics=CAMERA.with_std(None)
    )
    write_cameras(out, CamerasFile(cameras=[place], arms=[], version=jcr.__version__))
    for format in ("camera_info", "urdf"):
        own = run_jcr("export", out, format, "--parent-frame", "tool0")
        other = run_jcr("export", out, format, "--camera", "fixed0")
        assert own.returncode == other.returncode == 0, (own.stderr, other.stderr)
    assert f"jcr export {out} camera_info --camera fixed0 writes them" in other.stdout + other.stderr
    exported = {file.name for file in (out / "export").iterdir()}
    assert exported == {
        "camera_info.yaml",
        "hand_eye.urdf",
        "fixed0_camera_info.yaml",
        "fixed0_hand_eye.urdf",
    }
    assert "610" in (out / "export" / "fixed0_camera_info.yaml").read_text()
    # A rejected camera is left out of a file of all cameras, and named.
    lost = Finding.of(FindingKind.NOT_REGISTERED, "rejects", "images", "0.png", value=3.0)
    posed = {
        "base_from_camera": PARENT_FROM_CHILD,
        "uncertainty": spread,
        "intrinsics": CAMERA.with_std(None),
    }
    bad = CameraPlacement.of(replace(camera, name="fixed1"), [lost], **posed)
    write_cameras(out, CamerasFile(cameras=[place, bad], arms=[], version=jcr.__version__))
    left_out = run_jcr("export", out, "ros2", "--parent-frame", "tool0")
    assert "camera fixed1 is rejected" in left_out.stderr and "--force includes it" in left_out.stderr
    assert "fixed1" not in (file := out / "export" / "hand_eye.launch.xml").read_text()
    forced = run_jcr("export", out, "ros2", "--parent-frame", "tool0", "--force", "--overwrite")
    assert "fixed1 is rejected" in forced.stderr and "the file contains it" in forced.stderr
    assert "fixed1" in file.read_text() and "fixed0 is rejected" not in forced.stderr
    unnamed = run_jcr("export", out, "easy_handeye2", "--camera", "fixed0")  # states the gripper frame, too
    assert unnamed.returncode == 2 and "add --parent-frame FRAME" in unnamed.stderr


def test_the_base_of_another_arm_is_named_after_that_of_the_run(tmp_path: Path):
    shutil.copy(ROOT / "tests" / "calibrations" / "accepted.json", tmp_path / "calibration.json")
    spread = TransformUncertainty.of(1e-6 * np.eye(6))
    arm = ArmPlacement(name="right", base_from_other_base=PARENT_FROM_CHILD.tolist(), uncertainty=spread)
    write_cameras(tmp_path, CamerasFile(cameras=[], arms=[arm], version=jcr.__version__))
    names = {"base_frame": "base_link", "parent_frame": "tool0"}
    _, node = ElementTree.parse(export_run(tmp_path, "ros2", options=names)).getroot().findall("node")
    words = node.get("args", "").split()
    stated = dict(zip(words[::2], words[1::2], strict=True))
    assert (stated["--frame-id"], stated["--child-frame-id"]) == ("base_link", "right_base_link")
    assert [float(stated[f"--{axis}"]) for axis in "xyz"] == pytest.approx(PARENT_FROM_CHILD[:3, 3])


def test_urdf_of_wrist_and_fixed_cameras_of_two_arms_is_one_tree(tmp_path: Path):
    def camera(parent: str, child: str, arm: str = "") -> ros.CameraMount:
        return ros.CameraMount(
            parent=arm + parent, child=child, parent_from_child=PARENT_FROM_CHILD, base=f"{arm}base_link"
        )

    wrist, second = camera("tool0", "wrist"), camera("tool0", "second")
    path = tmp_path / "cell.urdf"
    path.write_text(ros.urdf(wrist, [second]))
    assert yourdfpy.URDF.load(path).base_link == "tool0"  # no frame that the run does not need
    right = replace(camera("base_link", "right_base_link"), base="base_link")
    path.write_text(
        ros.urdf(wrist, [second, camera("base_link", "overhead"), camera("tool0", "eye", "right_"), right])
    )
    robot = yourdfpy.URDF.load(path)
    children = [joint.child for joint in robot.robot.joints]
    roots = [link.name for link in robot.robot.links if link.name not in children]
    assert roots == ["base_link"] and len(set(children)) == len(children)
    for child, parent in (("overhead", "base_link"), ("second", "tool0"), ("eye", "right_tool0")):
        np.testing.assert_allclose(robot.get_transform(child, parent), PARENT_FROM_CHILD, atol=1e-9)


CAMERA = Intrinsics(610.0, 600.0, 340.0, 215.0, 640, 480)
LOOKING = transform(rotation_exp(np.array([np.pi - 0.2, 0.1, 0.15])), np.array([0.1, -0.05, 0.8]))
POINTS = np.array([[0.0, 0.0, 0.0], [0.1, -0.1, 0.03], [0.22, 0.03, -0.02], [-0.05, -0.04, 0.05]])
"""In the frame of the gripper, and in view."""


def looking(**more: Any) -> ros.CameraMount:
    return ros.CameraMount(
        parent="tool0", child="wrist", parent_from_child=LOOKING, intrinsics=CAMERA, **more
    )


@pytest.mark.gl
def test_mujoco_renders_points_at_our_pixels(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))
    mujoco: Any = pytest.importorskip("mujoco")
    balls = "".join(f'<geom type="sphere" size="0.004" pos="{" ".join(map(str, one))}"/>' for one in POINTS)
    model = simulators.mjcf(looking()).replace("<worldbody>", f"<worldbody>{balls}")
    model = mujoco.MjModel.from_xml_string(model)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, CAMERA.height, CAMERA.width) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, "wrist")
        geom = renderer.render()[..., 0]
    seen = [np.argwhere(geom == k).mean(0)[::-1] for k in range(len(POINTS))]
    np.testing.assert_allclose(seen, project(CAMERA, apply(inverse(LOOKING), POINTS)), atol=0.3)


def test_usd_camera_projects_points_to_our_pixels(tmp_path: Path):
    pytest.importorskip("pxr", reason="usd-core is for tests: pip install usd-core")
    from pxr import Usd, UsdGeom  # pyright: ignore[reportMissingImports]

    (tmp_path / "camera.usda").write_text(simulators.usd(looking(doubt='a "quoted" \\ reason')))
    stage = Usd.Stage.Open(str(tmp_path / "camera.usda"))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/tool0/wrist")).GetCamera(Usd.TimeCode.Default())
    both = np.array(camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix())
    ndc = np.column_stack([POINTS, np.ones(len(POINTS))]) @ both
    x, y = (ndc[:, :2] / ndc[:, 3:]).T
    found = np.column_stack([(x + 1) / 2 * CAMERA.width, (1 - y) / 2 * CAMERA.height]) - 0.5
    np.testing.assert_allclose(found, project(CAMERA, apply(inverse(LOOKING), POINTS)), atol=1e-4)


def test_simulators_state_what_a_pinhole_leaves_out():
    assert simulators.residual_px(CAMERA) == (pytest.approx(0, abs=1e-9), pytest.approx(0, abs=1e-9))
    bent = replace(CAMERA, distortion=(-0.2, 0.06, 0.0, 0.0, 0.0))
    rms, largest = simulators.residual_px(bent)
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    straight = cv2.undistortPoints(
        corners[:, None], CAMERA.matrix, np.array(bent.distortion), P=CAMERA.matrix
    )[:, 0]
    assert largest == pytest.approx(np.linalg.norm(straight - corners, axis=1).max(), rel=1e-2)
    assert 0 < rms < largest
    assert f"{rms:.2f} px (rms)" in simulators.mjcf(replace(looking(), intrinsics=bent))


ROBOT = """<?xml version="1.0"?>
<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro">
  <!-- <joint name="old" type="fixed"><child link="optical"/><origin xyz="9 9 9"/></joint> -->
  <xacro:property name="pi" value="3.14"/>\r
  <joint name="first" type="revolute"><parent link="base"/><child link="tool0"/><origin xyz="1 2 3"/></joint>
  <joint type="fixed"   name="camera">
      <parent link="${prefix}tool0"/> <!-- keep -->
      <child  link='optical' />
      <origin   xyz="${a} 0 0"
                rpy="0 0 0"/>   <!-- measured by hand -->
  </joint>
</robot>
"""


def test_the_joint_of_a_robots_own_urdf_is_replaced_and_all_else_kept(done: Path, tmp_path: Path, capsys):
    file = tmp_path / "arm.urdf.xacro"
    file.write_bytes(ROBOT.encode())
    options = ["--into", file, "--parent-frame", "tool0", "--child-frame", "optical"]
    path = export(done, "urdf", tmp_path / "new.xacro", *options)
    new, x = (
        path.read_bytes().decode(),
        np.array(json.loads((done / "calibration.json").read_text())["gripper_from_camera"]),
    )
    written = ros.urdf_origin(x)
    assert new == ROBOT.replace('<origin   xyz="${a} 0 0"\n                rpy="0 0 0"/>', written)
    plain = tmp_path / "plain.urdf"
    links = "".join(f'<link name="{name}"/>' for name in ("base", "tool0", "optical"))
    plain.write_text(new.replace("${prefix}", "").replace("<xacro:property", f"{links}<xacro:property").replace(
        '<xacro:property name="pi" value="3.14"/>', "").replace('type="revolute"', 'type="fixed"'))  # fmt: skip
    np.testing.assert_allclose(yourdfpy.URDF.load(plain).get_transform("optical", "tool0"), x, atol=1e-9)
    # A joint without an origin gets one; the user's own file is replaced with --overwrite alone.
    file.write_bytes(ROBOT.replace('<origin   xyz="${a} 0 0"\n                rpy="0 0 0"/>', "").encode())
    assert written in export(done, "urdf", tmp_path / "other.xacro", *options).read_text()
    command = ["export", str(done), "urdf", str(file), *map(str, options)]
    assert dispatch(command) == 2 and "--overwrite" in capsys.readouterr().err
    assert dispatch([*command, "--overwrite"]) == 0 and written in file.read_text()
    faults = {
        "no joints have the child optical": ROBOT.replace("'optical'", "'lens'"),
        "2 joints have the child": ROBOT.replace('"tool0"/><origin', '"optical"/><origin'),
        "has the parent flange": ROBOT.replace("${prefix}tool0", "flange"),
        "is not fixed": ROBOT.replace('type="fixed"   ', 'type="floating" '),
    }
    for words, text in faults.items():
        file.write_text(text)
        assert dispatch([*command, "--overwrite"]) == 2 and words in capsys.readouterr().err


def test_depth_images_lie_on_the_scene(done: Path, tabletop: Path, true_mesh: "trimesh.Trimesh", tmp_path):
    folder = export(done, "depth", tmp_path / "depth")
    metres = export(done, "depth", tmp_path / "metres", "--float-depth")
    content = json.loads((folder / "cameras.json").read_text())
    matrix, frame = np.array(content["K"]), content["frames"][3]
    depth = cv2.imread(str(folder / frame["depth"]), cv2.IMREAD_UNCHANGED)
    exact = np.load(metres / json.loads((metres / "cameras.json").read_text())["frames"][3]["depth"])
    assert depth is not None and depth.dtype == np.uint16
    assert depth.shape == (content["height"], content["width"])
    np.testing.assert_allclose(depth / content["depth_scale"], exact, atol=5.1e-4)
    rows = np.argwhere(depth > 0)[::211]
    z = depth[tuple(rows.T)] / content["depth_scale"]
    rays = np.column_stack([rows[:, ::-1], np.ones(len(rows))]) @ np.linalg.inv(matrix).T
    in_base = apply(np.array(frame["base_from_camera"]), z[:, None] * rays)
    _, distance, _ = trimesh.proximity.closest_point(true_mesh, in_base)
    assert np.median(distance) < 1.5e-3 and len(rows) > 200
    color = read_image(folder / frame["color"])
    assert color.shape == (*depth.shape, 3)


def test_the_cameras_of_a_data_set_are_a_table_by_episode(done: Path, tmp_path: Path):
    parquet: Any = pytest.importorskip("pyarrow.parquet")
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/meta/info.json").write_text("{}")
    for episode in (7, 3):
        run = tmp_path / f"all/set-episode-{episode}"
        (run / "capture").mkdir(parents=True)
        for name in ("calibration.json", "uncertainty.npz"):
            (run / name).symlink_to(done / name)
        made_from = [
            str(tmp_path / "set"), "", {"episode": [episode], "camera_topic": "observation.images.wrist"},
        ]  # fmt: skip
        (run / "capture/capture.json").write_text(json.dumps({"made_from": made_from}))
    table = parquet.read_table(export_run(tmp_path / "all", "lerobot"))
    rows = table.to_pylist()
    assert [row["episode_index"] for row in rows] == [3, 7]
    content = json.loads((done / "calibration.json").read_text())
    found = np.reshape(rows[0]["gripper_from_camera"], (4, 4))
    np.testing.assert_allclose(found, content["gripper_from_camera"])
    assert rows[0]["camera"] == "observation.images.wrist" and rows[0]["fx"] == content["intrinsics"]["fx"]
    assert json.loads(table.schema.metadata[b"jcr"])["unit"] == "m"


def test_names_that_are_no_frames_are_refused():
    for name in ("", "/tool0", "tool 0", 'a"b', "<x>", "ü", "a--b"):
        with refused("frame"):
            ros.CameraMount(parent="tool0", child=name, parent_from_child=PARENT_FROM_CHILD)
    with refused("different"):
        ros.CameraMount(parent="tool0", child="tool0", parent_from_child=PARENT_FROM_CHILD)
    with refused("root"):
        ros.on_root(mount(), "optical")


INTRINSICS = Intrinsics(300.0, 305.0, 161.0, 118.0, 320, 240, (-0.2, 0.06, 1e-3, -2e-3, 0.02))


@pytest.fixture
def views(tmp_path: Path) -> "PosedImages":
    """Three noisy images through intrinsics with all five coefficients, and the exact pixels of 60 points."""
    from jcr.export.nerfstudio_colmap import PosedImages

    rng = np.random.default_rng(5)
    folder = tmp_path / "capture"
    images = ("left/0.png", "left/1.png", "right/0.png")
    for image in images:
        (folder / image).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (240, 320, 3), np.uint8)).save(folder / image)
    points = rng.uniform([0.4, -0.2, 0.0], [0.7, 0.2, 0.1], (60, 3))
    down = rotation_exp(np.array([np.pi, 0.0, 0.0]))
    poses = np.stack(
        [
            transform(rotation_exp(0.15 * rng.normal(size=3)) @ down, np.array([0.55, y, 0.6 + 0.05 * y]))
            for y in (-0.1, 0.0, 0.1)
        ]
    )
    image, point, x_px = shown_points(points, poses, [INTRINSICS] * 3, 0.0, rng)
    assert len(image) > 100
    tracks = Tracks(image=image, x_px=x_px, point=point, points_in_recon=points)
    return PosedImages(
        folder=folder, images=images, base_from_camera=poses, base_from_gripper=poses, intrinsics=INTRINSICS,
        tracks=tracks, points_in_base=points, base_from_recon=Similarity(np.eye(4), 1.0),
    )  # fmt: skip


@pytest.mark.parametrize(("undistorted", "read"), [(False, "read_binary"), (True, "read_text")])
def test_colmap_model_reprojects_points(views: "PosedImages", undistorted: bool, read: str, tmp_path: Path):
    from jcr.export.nerfstudio_colmap import write_colmap

    out = tmp_path / "model"
    write_colmap(out, views, provenance("base_link", DOUBT), ExportOptions(undistort=undistorted))
    model = pycolmap.Reconstruction()
    getattr(model, read)(str(out / "sparse" / "0"))
    assert model.num_images() == 3
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6
    found = np.array([point.xyz for point in model.points3D.values()])
    nearest, _ = KDTree(views.points_in_base).query(found)
    assert len(found) > 30 and nearest.max() < 1e-9
    for image in model.images.values():
        assert (out / "images" / image.name).is_file()
        camera_from_base = image.cam_from_world().matrix()
        expected = inverse(views.base_from_camera[image.image_id - 1])[:3]
        np.testing.assert_allclose(camera_from_base, expected, atol=1e-9)
    camera = next(iter(model.cameras.values()))
    assert camera.model_name == ("PINHOLE" if undistorted else "FULL_OPENCV")
    about = (out / "README.txt").read_text()
    assert "frame: base_link\nunit: m\n" in about and "REJECTED" in about


@pytest.mark.parametrize("undistorted", [False, True])
def test_nerfstudio_cameras_see_points_as_images_do(views: "PosedImages", undistorted: bool, tmp_path: Path):
    from jcr.export.nerfstudio_colmap import write_nerfstudio

    out = tmp_path / "splat"
    cloud = analytic_scene.cloud(300)
    options = ExportOptions(undistort=undistorted, link_images=not undistorted)
    write_nerfstudio(out, views, cloud, provenance("base_link"), options)
    content = json.loads((out / "transforms.json").read_text())
    assert content["about"]["frame"] == "base_link" and content["about"]["unit"] == "m"
    assert len(content["frames"]) == 3
    matrix = np.array([[content["fl_x"], 0, content["cx"]], [0, content["fl_y"], content["cy"]], [0, 0, 1]])
    coefficients = np.array([content.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
    for k, frame in enumerate(content["frames"]):
        path = out / frame["file_path"]
        assert path.is_symlink() == (not undistorted)
        assert read_image(path).shape == (content["h"], content["w"], 3)
        base_from_opengl = np.array(frame["transform_matrix"])
        # x right, y up, z backward: the camera looks along -z.
        base_from_camera = base_from_opengl @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(base_from_camera, views.base_from_camera[k], atol=1e-9)
        mine = views.tracks.image == k
        x = apply(inverse(base_from_camera), views.points_in_base[views.tracks.point[mine]])
        seen = cv2.projectPoints(x, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
        x_px = views.tracks.x_px[mine]
        if undistorted:
            rays = unproject(INTRINSICS, x_px)[:, :2]
            x_px = rays @ np.diag([content["fl_x"], content["fl_y"]]) + [content["cx"], content["cy"]] - 0.5
        # There the first pixel's centre is at (0.5, 0.5).
        np.testing.assert_allclose(seen, x_px + 0.5, atol=1e-6)
    first = trimesh.load(out / content["ply_file_path"])
    np.testing.assert_allclose(np.asarray(first.vertices), cloud.points_in_base, atol=1e-6)  # pyright: ignore


def export(done: Path, name: str, path: Path, *options: object) -> Path:
    assert dispatch(["export", str(done), name, str(path), *map(str, options)]) == 0
    return path


def test_ply_holds_points_colours_and_labels(done: Path, tmp_path: Path):
    path = export(done, "ply", tmp_path / "out.ply", "--base-frame", "arm_base")
    cloud, written = read_cloud(done / "cloud.ply"), read_cloud(path)
    np.testing.assert_array_equal(written.label, cloud.label)
    loaded = trimesh.load(path)
    np.testing.assert_allclose(np.asarray(loaded.vertices), cloud.points_in_base, atol=1e-6)  # pyright: ignore
    np.testing.assert_array_equal(np.asarray(loaded.colors)[:, :3], cloud.color)  # pyright: ignore
    header = path.read_bytes()[:600].decode("latin-1")
    assert "comment frame arm_base" in header and "comment unit m" in header


def test_mesh_lies_on_the_surface_faces_outward(done: Path, true_mesh: "trimesh.Trimesh", tmp_path: Path):
    loaded = trimesh.load_scene(export(done, "glb", tmp_path / "map.glb"))
    assert loaded.metadata["frame"] == "base_link" and loaded.metadata["unit"] == "m"
    mesh = loaded.to_geometry()
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.area > 0.3  # a table of 0.7 m by 0.8 m was in view
    rows = np.random.default_rng(0).choice(
        len(mesh.faces), 3000, p=mesh.area_faces / mesh.area, replace=False
    )
    _, distance, at = trimesh.proximity.closest_point(true_mesh, mesh.triangles_center[rows])
    assert np.median(distance) < 0.003 and np.percentile(distance, 95) < 0.01
    assert ((mesh.face_normals[rows] * true_mesh.face_normals[at]).sum(1) > 0).mean() > 0.9
    # The colours are those of the nearest points of the cloud.
    cloud = read_cloud(done / "cloud.ply")
    near, at = KDTree(cloud.points_in_base).query(mesh.vertices)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(float)  # pyright: ignore
    off = np.abs(colors - cloud.color[at]).mean(1)
    assert np.median(off[near < 0.003]) < 12


def test_octomap_has_free_occupied_and_unknown(done: Path, scene: "SceneMap", tabletop: Path, tmp_path: Path):
    import pyoctomap

    from jcr.scene.scene_map import FREE, OCCUPIED

    path = export(done, "octomap", tmp_path / "map.bt", "--voxel-size", 0.02)
    assert b"# frame: base_link\n# unit: m\n" in path.read_bytes()[:200]
    tree = pyoctomap.OcTree(1.0)  # pyright: ignore[reportAttributeAccessIssue]
    assert tree.readBinary(str(path)) and tree.getResolution() == pytest.approx(0.02)
    rng = np.random.default_rng(2)
    x = rng.uniform(scene.box[0] + 0.02, scene.box[1] - 0.02, (100_000, 3))
    said = tree.getLabels(x)  # 1 occupied, 0 free, -1 unknown
    center = 0.02 * (np.floor(x / 0.02) + 0.5)
    state = scene.check_spheres(center, 0.01, unknown="report")
    np.testing.assert_array_equal(said, np.where(state == OCCUPIED, 1, np.where(state == FREE, 0, -1)))
    # Against the truth: what is solid is never free, what is free is hardly ever occupied.
    truth = read_truth(tabletop)
    solid = solid_labels(make_scene("tabletop", truth.seed), x) > 0
    assert (said[solid] == 0).mean() < 0.01
    above = x[:, 2] > truth.table_height + max(thing.height for thing in truth.objects) + 0.03
    seen = ~scene.query(x).unknown
    assert (said[above] == 1).mean() < 0.005
    assert (said[above & seen] == 0).mean() > 0.5 and (said[above & ~seen] == -1).mean() > 0.9


@pytest.mark.parametrize("unknown", ["occupied", "free"])
def test_esdf_voxels_hold_distances_at_centres(done: Path, scene: "SceneMap", unknown: str, tmp_path: Path):
    path = export(done, "esdf", tmp_path / "esdf.npz", "--unknown", unknown, "--voxel-size", 0.015)
    with np.load(path) as file:
        grid = {name: file[name] for name in file.files}
    assert (str(grid["frame"]), str(grid["unit"]), str(grid["unknown"])) == ("base_link", "m", unknown)
    assert "positive outside" in str(grid["sign"]) and grid["voxel_size"] == 0.015
    assert float(str(grid["margin_95_m"])) == pytest.approx(scene.margin_95, abs=1e-5)
    shape = np.array(grid["values"].shape)
    np.testing.assert_allclose(grid["dims"], 0.015 * shape)
    np.testing.assert_allclose(grid["pose"][:3] - grid["dims"] / 2 + 0.0075, grid["origin"], atol=1e-12)
    np.testing.assert_array_equal(grid["pose"][3:], [1, 0, 0, 0])
    at = np.random.default_rng(0).integers(0, shape, (5000, 3))
    x = grid["origin"] + 0.015 * at
    expected = scene.query(x, unknown).distance  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(grid["values"][tuple(at.T)], expected, atol=1e-6)
    assert np.isfinite(grid["values"]).all() and grid["values"].min() < 0 < grid["values"].max()


def test_spheres_cover_what_is_solid_and_little_else(done: Path, scene: "SceneMap", tmp_path: Path):
    with np.load(export(done, "spheres", tmp_path / "spheres.npz")) as file:
        centers, radii, frame = file["centers"], file["radii"], str(file["frame"])
    assert frame == "base_link" and radii.min() > 0 and len(radii) < 3000
    x = np.random.default_rng(3).uniform(*scene.box, (40_000, 3))
    distance = scene.query(x, "free").distance
    covered = np.zeros(len(x), bool)
    places = KDTree(x)
    for center, radius in zip(centers, radii, strict=True):
        covered[places.query_ball_point(center, radius)] = True
    assert covered[distance <= 0].all() and (distance <= 0).sum() > 400
    # The default excess is 2 cm; the interpolated distance changes a little faster than one goes.
    assert distance[covered].max() < 0.025


def test_command_gives_the_asked_root_link(done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    # Looking forward (x of the root), the optical frame has z there, x to the right (-y) and y down (-z).
    np.testing.assert_array_equal(ROOT_FROM_OPTICAL[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    gripper_from_camera = np.array(json.loads((done / "calibration.json").read_text())["gripper_from_camera"])
    options = ["--to-root", "camera_link", "--parent-frame", "flange"]
    path = export(done, "urdf", tmp_path / "a.urdf", *options)
    found = yourdfpy.URDF.load(path).get_transform("camera_link", "flange")
    np.testing.assert_allclose(found @ ROOT_FROM_OPTICAL, gripper_from_camera, atol=1e-9)
    root_pose = [0.0, 0.015, -0.002, -0.4977, 0.5023, -0.4977, 0.5023]
    path = export(done, "urdf", tmp_path / "b.urdf", *options, "--root-from-optical", *root_pose)
    found = yourdfpy.URDF.load(path).get_transform("camera_link", "flange")
    np.testing.assert_allclose(found @ of_quat(*root_pose), gripper_from_camera, atol=1e-9)
    export(done, "ros2", tmp_path / "c.launch.xml", *options)
    assert "--frame-id flange --child-frame-id camera_link" in capsys.readouterr().out


def test_frames_are_those_of_the_capture_and_asked_for_where_unknown(done: Path, tmp_path, capsys):
    content, run = json.loads((done / "calibration.json").read_text()), tmp_path / "run"
    run.mkdir()
    shutil.copy(done / "uncertainty.npz", run)
    names = {"base": "ur_base", "gripper": "flange", "camera": "eye_optical"}
    assert content["frame_names"] == vars(FRAME_NAMES)
    (run / "calibration.json").write_text(json.dumps(content | {"frame_names": names}))
    assert of_publisher_names(export(run, "ros2", tmp_path / "a.xml")) == ("flange", "eye_optical")
    calib = yaml.safe_load(export(run, "easy_handeye2", tmp_path / "a.calib").read_text())["parameters"]
    assert (calib["robot_base_frame"], calib["robot_effector_frame"]) == ("ur_base", "flange")
    path = export(run, "ros2", tmp_path / "b.xml", "--parent-frame", "tcp", "--child-frame", "eye")
    assert of_publisher_names(path) == ("tcp", "eye")
    (run / "calibration.json").write_text(json.dumps(content | {"frame_names": {}}))
    for name in ("ros2", "moveit", "urdf", "easy_handeye2"):
        assert dispatch(["export", str(run), name]) == 2
        assert "add --parent-frame FRAME" in capsys.readouterr().err
    assert "fx" not in export(run, "camera_info", tmp_path / "info.yaml").read_text().split("\n")[0]
    assert of_publisher_names(export(run, "ros2", tmp_path / "c.xml", "--parent-frame", "tcp"))[0] == "tcp"


def of_publisher_names(path: Path) -> tuple[str, str]:
    """Parent and child frame in a launch file."""
    words = path.read_text().replace('"', " ").split()
    return words[words.index("--frame-id") + 1], words[words.index("--child-frame-id") + 1]


def test_a_file_with_other_content_is_replaced_by_overwrite_alone(done: Path, tmp_path, capsys):
    path = export(done, "urdf", tmp_path / "a.urdf")
    before = export(done, "urdf", path).read_text()
    other = ["export", str(done), "urdf", str(path), "--child-frame", "left_optical"]
    assert dispatch(other) == 2 and path.read_text() == before
    assert f"{path}: is there with other content" in capsys.readouterr().err
    with refused("--overwrite"):
        export_run(done, "mjcf", path)
    assert dispatch([*other, "--overwrite"]) == 0 and "left_optical" in path.read_text()
    assert [file.name for file in tmp_path.iterdir()] == ["a.urdf"]


def test_a_rejected_calibration_is_exported_by_force_with_its_reason_in_every_file(done, tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    for name in (
        "cloud.ply", "map.safetensors", "reconstruction.npz", "run.json", "uncertainty.npz", "depth.npz",
    ):  # fmt: skip
        (run / name).symlink_to(done / name)
    content = json.loads((done / "calibration.json").read_text())
    findings = [
        {"kind": "reconstruction", "severity": severity, "details": {"text": words}}
        for severity, words in (("rejects", DOUBT), ("warns", "and another"))
    ]
    content |= {"converged": False, "verdict": "rejected", "findings": findings}
    (run / "calibration.json").write_text(json.dumps(content))
    for row in FORMATS:
        if row.name in ("rerun", "lerobot"):
            continue  # needs an extra, or an episode; tested where they are
        path = run / "export" / row.file
        assert dispatch(["export", str(run), row.name]) == 3 and not path.exists()
        complaint = capsys.readouterr().err
        assert DOUBT in complaint and "rejected" in complaint and "--force" in complaint
        with pytest.raises(RejectedError, match="rejected"):
            export_run(run, row.name)
        assert dispatch(["export", str(run), row.name, "--force"]) == 0
        assert DOUBT in capsys.readouterr().err
        files = (
            [path]
            if path.is_file()
            else [path / name for name in ("README.txt", "transforms.json", "points.ply", "cameras.json")]
        )
        files = [file for file in files if file.exists()]
        assert files
        for file in files:
            if file.suffix == ".npz":
                with np.load(file) as arrays:
                    text = str(arrays["warning"]).encode()
            else:
                text = file.read_bytes()
            assert b"REJECTED: scale: every view rotates" in text, row.name
    assert not [path for path in run.rglob("*") if ".part" in path.name]


@pytest.mark.parametrize(("arguments", "words"), [
    (["fbx"], "'fbx'"),
    (["ply"], "jcr map"),
    (["colmap"], "jcr calibrate"),
    (["urdf", "--child-frame", "tool0"], "different"),
    (["urdf", "--root-from-optical", *"0000001"], "--to-root"),
    (["urdf", "--to-root", "a", "--root-from-optical", *"0000000"], "quaternion"),
    (["mjcf", "--to-root", "a"], "only ros2, moveit, urdf and easy_handeye2"),
    (["mjcf", "--into", "a.urdf"], "--into: the format mjcf does not use it, only urdf"),
    (["urdf", "--voxel-size", "0.01"], "--voxel-size: the format urdf does not use it, only octomap and esdf"),
    (["octomap", "--parent-frame", "tool0"], "--parent-frame: the format octomap does not use it"),
    (["lerobot"], "no run of an episode"),
    (["ros2", "x.launch.py", "--parent-frame", "a"], "ros2 launch reads this format from a file that ends with .xml"),
])  # fmt: skip
def test_what_cannot_be_exported_is_one_line(done: Path, tmp_path, capsys, arguments: list[str], words: str):
    """In a run folder that holds its calibration and nothing else."""
    for name in ("calibration.json", "uncertainty.npz"):
        shutil.copy(done / name, tmp_path)
    assert dispatch(["export", str(tmp_path), *arguments]) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("error: ") and complaint.count("\n") == 1 and words in complaint
    assert not (tmp_path / "export").exists()
    own = [
        "export",
        str(tmp_path),
        "urdf",
        str(tmp_path / "calibration.json"),
        "--parent-frame",
        "a",
        "--overwrite",
    ]
    assert dispatch(own) == 2 and "is a file of the run itself" in capsys.readouterr().err
    if arguments == ["fbx"]:
        assert all(row.name in complaint for row in FORMATS)


@pytest.mark.parametrize(("options", "words"), [
    (["octomap", "x.bt", "--voxel-size", "0.0005"], "million"),
    (["esdf", "x.npz", "--voxel-size", "5"], "voxels of"),
    (["spheres", "x.npz", "--excess", "0"], "voxels of"),
    (["esdf", ".", "--voxel-size", "0.05"], "folder"),
    (["colmap", "."], "is there already"),
])  # fmt: skip
def test_wrong_sizes_and_places_are_refused(done, tmp_path, monkeypatch, capsys, options, words):
    (tmp_path / "mine.txt").write_text("kept")
    monkeypatch.chdir(tmp_path)
    assert dispatch(["export", str(done), *options]) == 2
    assert words in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_rerun_recording_is_read_by_rerun_and_a_missing_package_is_named(done, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "rerun", None)
        without.setattr("jcr.export.formats.load_map", None)  # The package is missed before the map is read.
        assert dispatch(["export", str(done), "rerun", str(tmp_path / "none.rrd")]) == 2
        assert "jcr-handeye[rerun]" in capsys.readouterr().err and not (tmp_path / "none.rrd").exists()
    pytest.importorskip("rerun", reason="rerun-sdk is an extra of its own: pip install 'jcr-handeye[rerun]'")
    path = export(done, "rerun", tmp_path / "run.rrd")
    verified = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True, check=False
    )
    assert verified.returncode == 0, verified.stderr
