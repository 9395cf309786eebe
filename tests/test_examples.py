"""The examples run, and what they claim holds."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
import yourdfpy

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name: str) -> ModuleType:
    """An example as a module, without running its main."""
    spec = spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def truly_touches(joint_values: np.ndarray, true_mesh: trimesh.Trimesh) -> np.ndarray:
    """Whether the arm's own collision shapes meet the simulated scene (n,), by FCL: no map, no spheres."""
    arm = yourdfpy.URDF.load(
        EXAMPLES / "arm.urdf",
        build_scene_graph=True,
        build_collision_scene_graph=True,
        load_collision_meshes=True,
        force_collision_mesh=False,
        load_meshes=False,
    )
    shapes = arm.collision_scene
    assert shapes is not None
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


def test_ompl_plans_an_arm_past_the_mapped_things_without_touching_them(
    done: Path, true_mesh: trimesh.Trimesh
):
    pytest.importorskip("ompl", reason="needs ompl: pip install 'jcr[planning]'")
    import jcr

    planner = example("05_plan_with_ompl")
    planner.util.RNG.setSeed(1)
    planner.util.setLogLevel(planner.util.LogLevel.LOG_ERROR)
    clearance = planner.Clearance(jcr.load_map(done), planner.load_robot(planner.ARM))
    straight = np.linspace(planner.START, planner.GOAL, 100)
    assert truly_touches(straight, true_mesh).sum() > 5
    assert clearance.touches(straight).sum() > 5
    path = planner.plan(clearance, planner.START, planner.GOAL)
    np.testing.assert_allclose(path[[0, -1]], [planner.START, planner.GOAL], atol=1e-6)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 2 * planner.STEP_RAD
    assert not truly_touches(path, true_mesh).any()
