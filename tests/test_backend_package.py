"""Back ends of other packages: the example beside the installed packages, and one that is broken."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jcr.capture.formats import capture_json
from jcr.geometry import inverse, transform
from jcr.records import Intrinsics
from places import ROOT
from scenes import capture_of

pytestmark = pytest.mark.slow
COUNT, WIDTH, HEIGHT = 6, 320, 240
MODULE = "jcr_mapanything"

MODELS = '''
import numpy as np
import torch

class MapAnything:
    """Stand-in for the network: the true geometry of the plane z = 0, from the folder of its weights."""
    @classmethod
    def from_pretrained(cls, folder):
        model = cls()
        model.poses = np.load(folder + "/poses.npy")
        return model
    def to(self, device):
        return self
    def infer(self, views, **options):
        answers = []
        for view in views:
            # The images come in an order of jcr's own; their red says which one each is.
            red = 255 * (0.229 * float(view["img"][0, 0].mean()) + 0.485)
            pose = self.poses[round(red) - 90]
            height, width = view["img"].shape[2:]
            v, u = np.mgrid[:height, :width]
            matrix = view["intrinsics"][0].double().numpy()
            rays = np.stack([u, v, np.ones((height, width))], -1) @ np.linalg.inv(matrix).T
            depth = -pose[2, 3] / (rays @ pose[2, :3])
            points = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
            answers.append({"pts3d": torch.tensor(points)[None], "camera_poses": torch.tensor(pose)[None],
                            "conf": torch.ones(1, height, width)})
        return answers
'''


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of installed packages: the example with the entry points that it declares, and one that is broken."""
    folder, example = tmp_path_factory.mktemp("packages"), ROOT / "examples" / "backend_mapanything"
    project = tomllib.loads((example / "pyproject.toml").read_text())["project"]
    declared = {
        project["name"]: project["entry-points"]["jcr.backends"],
        "broken": {"broken": f"{MODULE}:NO_ROW"},
    }
    for name, points in declared.items():
        about = folder / f"{name.replace('-', '_')}-0.1.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        rows = [f"{row} = {place}" for row, place in points.items()]
        (about / "entry_points.txt").write_text("\n".join(["[jcr.backends]", *rows, ""]))
    shutil.copy(example / f"{MODULE}.py", folder)
    return folder


def run(*arguments: object, packages: list[Path]) -> subprocess.CompletedProcess[str]:
    """Run jcr with packages beside the installed ones."""
    path = os.pathsep.join([*map(str, packages), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "jcr", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": path}
    return subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Capture of a plane without texture, and the true camera poses beside it."""
    folder = tmp_path_factory.mktemp("capture")
    rng = np.random.default_rng(0)
    down = Rotation.from_euler("x", 180, degrees=True)
    tilt = Rotation.from_rotvec(rng.normal(scale=0.25, size=(COUNT, 3)))
    centers = np.column_stack([rng.uniform(-0.15, 0.15, (COUNT, 2)), rng.uniform(0.4, 0.6, COUNT)])
    cameras = transform((tilt * down).as_matrix(), centers)
    np.save(folder / "poses.npy", cameras)
    gripper_from_camera = transform(
        Rotation.from_rotvec([0.1, 0.2, 0.5]).as_matrix(), np.array([0.03, 0.05, 0.1])
    )
    poses = cameras @ inverse(gripper_from_camera)
    for k in range(COUNT):
        Image.new("RGB", (WIDTH, HEIGHT), (90 + k, 90, 90)).save(folder / f"{k}.png")
    camera = Intrinsics(300.0, 300.0, 159.5, 119.5, WIDTH, HEIGHT)
    capture_json.write(
        folder, capture_of(poses, folder=folder, image_size=(WIDTH, HEIGHT), intrinsics=camera)
    )
    np.save(folder / "gripper_from_camera.npy", gripper_from_camera)
    return folder


def test_the_example_is_listed_and_names_what_it_lacks(packages: Path, capture: Path, tmp_path: Path) -> None:
    listed = run("models", "--json", packages=[packages])
    rows = {row["backend"]: row for row in json.loads(listed.stdout)["models"]}
    assert rows["mapanything"]["licence"] == "Apache-2.0"
    names = list(rows)
    assert names.index("da3-small") < names.index("mapanything") < names.index("direct")
    assert "broken" not in names
    assert "back end broken (jcr_mapanything:NO_ROW) cannot be loaded" in listed.stderr
    done = run("calibrate", capture, tmp_path / "out", "--backend", "mapanything", packages=[packages])
    assert done.returncode == 2
    assert "needs mapanything, which is not installed: pip install git" in done.stderr


def test_the_example_calibrates(packages: Path, capture: Path, tmp_path: Path) -> None:
    package = tmp_path / "mapanything"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "models.py").write_text(MODELS)
    words = [
        "calibrate", capture, tmp_path / "out", "--backend", "mapanything", "--weights", capture, "--json",
    ]  # fmt: skip
    done = run(*words, packages=[packages, tmp_path])
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert found["backend"] == "mapanything", done.stderr
    true = np.load(capture / "gripper_from_camera.npy")
    np.testing.assert_allclose(found["gripper_from_camera"], true, atol=1e-4)
    assert found["scale"] == pytest.approx(1, abs=1e-3)
