"""A robot of boxes, cylinders, balls and meshes, asked against a map of known distances."""

import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import analytic_scene
from analytic_scene import BALL_CENTER
from jcr.errors import InputError
from jcr.geometry import apply, transform
from jcr.scene.cloud import write_cloud
from places import ROOT

if TYPE_CHECKING:
    import trimesh

    from jcr.scene.scene_map import SceneMap

pytestmark = pytest.mark.slow

EXCESS = 0.01

URDF = """<robot name="arm">
  <link name="foot"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
  <link name="upper"><collision><origin xyz="0 0 0.075"/>
    <geometry><cylinder radius="0.02" length="0.15"/></geometry></collision></link>
  <link name="fore"><collision><origin xyz="0.1 0 0" rpy="0 1.5707963 0"/>
    <geometry><cylinder radius="0.015" length="0.2"/></geometry></collision></link>
  <link name="slide"><collision><geometry><mesh filename="wedge.stl" scale="0.001 0.001 0.001"/></geometry>
    </collision></link>
  <link name="tip"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
  <link name="finger"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="foot"/><child link="upper"/><origin xyz="0 0 0.01"/>
    <axis xyz="0 0 2"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="bend" type="continuous"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.15"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="push" type="prismatic"><parent link="fore"/><child link="slide"/><origin xyz="0.2 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="fix" type="fixed"><parent link="slide"/><child link="tip"/><origin xyz="0.05 0 0"/></joint>
  <joint name="follow" type="prismatic"><parent link="tip"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/><mimic joint="push" multiplier="0.5" offset="0.01"/>
    </joint>
</robot>"""


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import trimesh

    folder = tmp_path_factory.mktemp("robot")
    wedge = trimesh.convex.convex_hull(np.array([[0, -20, -20], [0, 20, -20], [0, 0, 20], [40, 0, 0]], float))
    wedge.export(folder / "wedge.stl")
    (folder / "arm.urdf").write_text(URDF)
    return folder / "arm.urdf"


def shape_named(name: str) -> "trimesh.Trimesh":
    from trimesh.creation import box, cylinder, icosphere
    from trimesh.util import concatenate

    match name:
        case "disc":
            return cylinder(0.15, 0.02)
        case "ball":
            return icosphere(radius=0.07)
    across = transform(np.eye(3), np.array([0.15, 0, 0.15]))
    return concatenate([box((0.3, 0.03, 0.03)), box((0.03, 0.03, 0.3), across)])


@pytest.mark.parametrize("name", ["disc", "ball", "elbow"])
def test_spheres_hold_the_shape_and_little_else(name: str):
    import trimesh

    from jcr.scene.robot import spheres_of_shape

    shape = shape_named(name)
    link_from_shape = transform(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([0.1, 0.2, 0.3]))
    centers, radii = spheres_of_shape(shape, link_from_shape, EXCESS)
    surface = shape.sample(3000, seed=0)
    low, high = shape.bounds + [[-0.05], [0.05]]
    around = np.random.default_rng(0).uniform(low, high, (5000, 3))
    depth = trimesh.proximity.signed_distance(shape, around)
    fixed = apply(link_from_shape, np.concatenate([surface, around[depth > 0]]))
    gap = np.linalg.norm(fixed[:, None] - centers, axis=-1) - radii
    assert gap.min(1).max() <= 1e-6
    beyond = apply(link_from_shape, around[depth < -1.5 * EXCESS])
    gap = np.linalg.norm(beyond[:, None] - centers, axis=-1) - radii
    assert gap.min() > 0
    assert len(radii) < 450


def test_joints_move_the_spheres_as_in_yourdfpy(urdf: Path):
    import yourdfpy

    from jcr.scene.robot import load_robot

    peer, robot = yourdfpy.URDF.load(str(urdf), load_meshes=False), load_robot(urdf)
    assert robot.joint_names == ("turn", "bend", "push") and len(robot.links) == 6
    q = np.array([[0.0, 0.0, 0.0], [np.pi / 2, 0.0, 0.0], [0.7, -1.1, 0.03], [0.0, 0.0, 0.04]])
    for values, centers in zip(q, robot.centers(q), strict=True):
        peer.update_cfg(values)
        for name in robot.links:
            mine = robot.link == robot.links.index(name)
            expected = apply(peer.get_transform(name), robot.centers_in_link[mine])
            np.testing.assert_allclose(centers[mine], expected, atol=1e-9)
    by_name = robot.centers({"push": q[:, 2], "turn": q[:, 0], "bend": q[:, 1]})
    assert np.array_equal(by_name, robot.centers(q))
    assert robot.centers(q.reshape(2, 2, 3)).shape == (2, 2, len(robot.radii), 3)


def test_the_arm_touches_the_ball_where_it_bends_into_it(scene: "SceneMap", urdf: Path):
    from jcr.scene.robot import load_robot
    from jcr.scene.scene_map import FREE, OCCUPIED, UNKNOWN

    # The foot stands on the table, behind the ball as seen along x.
    base_from_robot = transform(np.eye(3), BALL_CENTER * [1, 1, 0] + [-0.13, 0, 0.01])

    def ask(q: np.ndarray, unknown: str = "report", ignore: tuple[str, ...] = ("foot", "upper")) -> list:
        return scene.check_robot(urdf, q, unknown, base_from_robot, ignore).tolist()

    above, into = [0.0, 0.0, 0.0], [0.0, 0.75, 0.05]
    assert ask(np.array([above, into])) == [FREE, OCCUPIED]
    assert ask(np.array([above, into]), "occupied") == [False, True]
    assert ask(np.array([above, into]), "free") == [False, True]
    assert ask(np.array(above), ignore=()) == OCCUPIED  # the foot on the table
    out_of_the_box = np.array([np.pi, 0.0, 0.1])
    assert ask(out_of_the_box) == UNKNOWN
    assert ask(out_of_the_box, "occupied") is True
    assert ask(out_of_the_box, "free") is False
    many = np.tile(above, (4, 5, 1))
    assert scene.check_robot(load_robot(urdf), many, "free", base_from_robot, ("foot",)).shape == (4, 5)


def test_robots_and_joints_that_make_no_sense_are_refused(scene: "SceneMap", urdf: Path, tmp_path: Path):
    from jcr.scene.robot import load_robot

    robot = load_robot(urdf)
    wrong = {
        "no such URDF": (tmp_path / "none.urdf", np.zeros(3)),
        r"expected \(…, 3\), for turn, bend, push": (robot, np.zeros(4)),
        "elbow": (robot, {"turn": 0.0, "bend": 0.0, "push": 0.0, "elbow": 1.0}),
        "push": (robot, {"turn": 0.0, "bend": 0.0}),
        "not finite": (robot, np.array([0.0, np.nan, 0.0])),
        "arm7": (robot, np.zeros(3), "occupied", None, ("arm7",)),
        "base_from_robot": (robot, np.zeros(3), "occupied", np.diag([2.0, 2, 2, 1])),
    }
    for words, arguments in wrong.items():
        with pytest.raises(InputError, match=words):
            scene.check_robot(*arguments)
    broken = tmp_path / "broken.urdf"
    robots = {  # the second one's mesh is not beside it
        "not a readable URDF": "<robot><link",
        "mesh of link slide": URDF,
        "no link has a <collision>": '<robot name="a"><link name="b"/></robot>',
    }
    for words, text in robots.items():
        broken.write_text(text)
        with pytest.raises(InputError, match=words):
            load_robot(broken)


def test_the_page_on_the_map_runs_as_printed(
    scene: "SceneMap", urdf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    page = (ROOT / "docs" / "how-to" / "map.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(blocks) == 4
    scene.save(tmp_path / "out" / "table" / "map.safetensors")
    write_cloud(tmp_path / "out" / "table" / "cloud.ply", analytic_scene.cloud())
    for file in urdf.parent.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks:
        exec(block, names)
    assert names["sample"].unknown.tolist() == [False, True, True]
    assert "warmth" in names["warm"].properties
