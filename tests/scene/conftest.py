from typing import TYPE_CHECKING

import pytest

import analytic_scene
from jcr.records import PointCloud
from jcr.scene.options import MapOptions

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


@pytest.fixture(scope="session")
def cloud() -> PointCloud:
    return analytic_scene.cloud()


@pytest.fixture(scope="session")
def scene(cloud: PointCloud) -> "SceneMap":
    """The map of the analytic scene with one more property."""
    from jcr.scene.build import build_scene

    options = MapOptions(workspace=analytic_scene.WORKSPACE)
    return build_scene(cloud, options, values={"warmth": analytic_scene.warmth(cloud)})
