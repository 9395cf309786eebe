"""The examples run, and what they claim holds."""

import contextlib
import io
import json
import re
import runpy
import shutil
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pytest

import jcr
from jcr.camera import unproject
from jcr.geometry import apply, rotation_between_deg
from places import ROOT

if TYPE_CHECKING:
    import trimesh

from scenes import reference_of

pytestmark = pytest.mark.slow

EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    """An example as a module, without running its main."""
    spec = spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def truly_touches(joint_values: np.ndarray, true_mesh: "trimesh.Trimesh") -> np.ndarray:
    """Whether the arm's own collision shapes meet the simulated scene (n,), by FCL: no map, no spheres."""
    import trimesh
    import yourdfpy

    arm = yourdfpy.URDF.load(
        EXAMPLES / "arm.urdf", build_scene_graph=True, build_collision_scene_graph=True,
        load_collision_meshes=True, force_collision_mesh=False, load_meshes=False,
    )  # fmt: skip
    shapes = arm.collision_scene
    scene = trimesh.collision.CollisionManager()
    scene.add_object("scene", true_mesh)
    robot = trimesh.collision.CollisionManager()
    nodes = [node for node in shapes.graph.nodes_geometry if shapes.graph.transforms.parents[node] != "foot"]
    assert len(nodes) == 7
    for node in nodes:
        robot.add_object(node, shapes.geometry[shapes.graph[node][1]].to_mesh())
    touches = []
    for values in joint_values:
        arm.update_cfg(values)
        for node in nodes:
            robot.set_transform(node, shapes.graph[node][0])
        touches.append(robot.in_collision_other(scene))
    return np.array(touches)


def test_ompl_plans_an_arm_past_mapped_things_without_touching_them(done: Path, true_mesh: "trimesh.Trimesh"):
    pytest.importorskip("ompl", reason="needs ompl: pip install 'jcr-handeye[planning]'")
    planner = example("05_plan_with_ompl")
    planner.util.RNG.setSeed(1)
    planner.util.setLogLevel(planner.util.LogLevel.LOG_ERROR)
    clearance = planner.Clearance(jcr.load_map(done))
    straight = np.linspace(planner.START, planner.GOAL, 100)
    assert truly_touches(straight, true_mesh).sum() > 5
    assert clearance.touches(straight).sum() > 5
    path = planner.plan(clearance, planner.START, planner.GOAL)
    np.testing.assert_allclose(path[[0, -1]], [planner.START, planner.GOAL], atol=1e-6)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 2 * planner.STEP_RAD
    assert not truly_touches(path, true_mesh).any()


def printed(name: str, where: Path, *arguments: object) -> str:
    """What an example prints, run in a folder that has the project's examples and nothing else."""
    if not (where / "examples").exists():
        (where / "examples").symlink_to(EXAMPLES)
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.chdir(where),
    ):
        patch.setattr(sys, "argv", [f"examples/{name}.py", *map(str, arguments)])
        runpy.run_path(sys.argv[0], run_name="__main__")
    return out.getvalue()


def numbers(pattern: str, text: str) -> list[float]:
    """The groups of the one place that a pattern has in a text."""
    (found,) = re.findall(pattern, text)
    return [float(number) for number in ([found] if isinstance(found, str) else found)]


def test_quick_start_prints_the_true_camera_and_the_things_on_the_table(done: Path, tmp_path: Path):
    shutil.copytree(done, tmp_path / "out" / "quick_start")  # its finished stages are taken from there
    text = printed("01_quick_start", tmp_path)
    rows = re.search(r"\(m\):\n(.*?)\none sigma", text, re.DOTALL)
    assert rows is not None and "verdict: accepted" in text
    found = np.array(re.findall(r"-?\d+\.\d*", rows[1]), float).reshape(4, 4)
    truth = reference_of(EXAMPLES / "tabletop")
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 5e-4
    assert rotation_between_deg(found[:3, :3], truth[:3, :3]) < 0.05
    assert len(re.findall(r"± \d+ mm high", text)) >= 3
    assert "touches above it: False, at its middle: True" in text


def test_own_camera_poses_are_solved_and_what_sliding_hides_is_named(tmp_path: Path):
    text = printed("02_own_camera_poses", tmp_path)
    sigma_mm, sigma_deg = numbers(r"one sigma: (.+) mm, (.+)°", text)
    off_mm, off_deg = numbers(r"off the truth: (.+) mm, (.+)°", text)
    assert off_mm < 3 * np.sqrt(3) * sigma_mm < 10 and off_deg < 3 * np.sqrt(3) * sigma_deg < 1
    assert "used: 10 of 10" in text
    assert "without rotating: observable False, rejected" in text
    assert re.search(r"^- translation of the camera.*; tilt the wrist", text, re.MULTILINE)


def test_a_bag_gives_the_views_at_which_the_arm_halted(tmp_path: Path):
    pytest.importorskip("rosbags", reason="rosbags is not installed (extra ros)")
    text = printed("03_ros_bag", tmp_path)
    assert "took 12 frames, intrinsics given" in text and "show everything: True" in text
    halts = jcr.read_capture(EXAMPLES / "tabletop").base_from_gripper[:, :3, 3]
    taken = [np.array(row.split(), float) for row in re.findall(r"gripper at \[(.+)\] m", text)]
    distance = np.linalg.norm(np.array(taken)[:, None] - halts, axis=2)
    assert distance.min(1).max() < 1.5e-3  # of printed millimetres
    assert 0 < numbers(r"expected: a point within (\S+) mm", text)[0] < 10


def test_the_splat_s_cameras_are_where_the_robot_fixed_them(done: Path, tmp_path: Path):
    shutil.copytree(done, tmp_path / "run")
    text = printed("06_splat_export", tmp_path, "run")
    table = jcr.read_capture(EXAMPLES / "tabletop")
    heights = (table.base_from_gripper @ reference_of(EXAMPLES / "tabletop"))[:, 2, 3]
    assert "12 cameras of 640 x 480 px" in text
    lowest_and_highest = numbers(r"hang (.+) to (.+) m above", text)
    np.testing.assert_allclose(lowest_and_highest, [heights.min(), heights.max()], atol=2e-3)
    assert (tmp_path / "run/splat/points.ply").is_file()


def test_a_result_places_a_point_compares_exports_and_answers(done: Path, tmp_path: Path):
    out = shutil.copytree(done, tmp_path / "run")
    text = printed("07_use_a_result", tmp_path, "run")
    capture = jcr.read_capture(EXAMPLES / "tabletop")
    assert capture.intrinsics is not None
    point, off = (re.findall(rf"^{what}: (.*)$", text, re.M)[0] for what in ("point", "other transform"))
    x, y, z, *sigmas_mm = map(float, re.findall(r"-?\d+\.\d*", point))
    ray = unproject(capture.intrinsics, np.array([320.0, 240.0]))
    true = apply(capture.base_from_gripper[0] @ reference_of(EXAMPLES / "tabletop"), 0.45 * ray)
    assert np.linalg.norm(np.array([x, y, z]) - true) < 1e-3 and 0 < max(sigmas_mm) < 1
    assert np.linalg.norm([*map(float, re.findall(r"-?\d+\.\d*", off))]) < 0.5
    assert (out / "export" / "camera_info.yaml").is_file() and "map at the point: occupancy" in text


@pytest.mark.long
def test_the_notebook_runs(done: Path, tmp_path: Path):
    notebook = json.loads((EXAMPLES / "notebook.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    (tmp_path / "examples").symlink_to(EXAMPLES)
    shutil.copytree(done, tmp_path / "out" / "notebook")  # its finished stages are taken from there
    (tmp_path / "out" / "notebook" / "report.html").unlink()
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.chdir(tmp_path):
        exec("\n".join(cells), {})
    assert (tmp_path / "out/notebook/report.html").is_file()
    assert "out/notebook/export/hand_eye.launch" in out.getvalue()


def test_the_python_of_the_readme_prints_what_the_readme_shows(done: Path, tmp_path, monkeypatch, capsys):
    """Its call of `jcr.run` is that of the quick start, which runs: here the same run is read."""
    pytest.importorskip("torch")
    section = (ROOT / "README.md").read_text().split("## Ten lines of Python")[1]
    code, shown = re.findall(r"```(?:python)?\n(.*?)```", section, flags=re.DOTALL)[:2]
    (tmp_path / "examples").symlink_to(EXAMPLES)
    shutil.copytree(done, tmp_path / "out" / "tabletop")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jcr, "run", lambda capture, out: jcr.load_run(out))
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    number = re.compile(r"-?\d+\.?\d*")
    assert number.sub("", printed).split() == number.sub("", shown).split()
    assert np.allclose(
        [*map(float, number.findall(printed))], [*map(float, number.findall(shown))], atol=0.02
    )
