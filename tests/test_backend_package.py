"""Test back ends of other packages: the example, installed into an environment of its own, and one that is broken."""

import json
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jcr.geometry import inverse, transform
from places import ROOT

pytestmark = pytest.mark.slow
COUNT, WIDTH, HEIGHT = 6, 320, 240

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
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Interpreter of a new environment with jcr and the example installed, and its dependencies from this one."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    made = folder / "bin" / "python"
    packages = Path(
        subprocess.run(
            [made, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    )
    here = [ROOT / "src", sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    (packages / "dependencies.pth").write_text("".join(f"{path}\n" for path in here))
    install = [sys.executable, "-m", "pip", "--python", made, "install", "--quiet", "--no-deps"]
    install += ["--no-build-isolation", "--disable-pip-version-check"]
    source = folder / "source"  # the build writes beside its files
    source.mkdir()
    for path in (ROOT / "examples" / "backend_mapanything").glob("*.*"):
        (source / path.name).write_text(path.read_text())
    done = subprocess.run([*install, source], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    broken = packages / "broken-0.1.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 0.1\n")
    (broken / "entry_points.txt").write_text("[jcr.backends]\nbroken = jcr_mapanything:NO_ROW\n")
    return made


def run(python: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    code = "from jcr.cli import main; main()"
    command = [python, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240)


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
    frames = []
    for k, pose in enumerate(cameras @ inverse(gripper_from_camera)):
        Image.new("RGB", (WIDTH, HEIGHT), (90 + k, 90, 90)).save(folder / f"{k}.png")
        frames.append({"image": f"{k}.png", "base_from_gripper": pose.tolist()})
    intrinsics = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5, "distortion": [0.0] * 5}
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": intrinsics}))
    np.save(folder / "gripper_from_camera.npy", gripper_from_camera)
    return folder


def test_the_example_is_listed_and_names_what_it_lacks(python: Path, capture: Path, tmp_path: Path) -> None:
    listed = run(python, "models", "--json")
    rows = {row["backend"]: row for row in json.loads(listed.stdout)["models"]}
    assert rows["mapanything"]["licence"] == "Apache-2.0"
    names = list(rows)
    assert names.index("da3-small") < names.index("mapanything") < names.index("direct")
    assert "broken" not in names
    assert "back end broken (jcr_mapanything:NO_ROW) cannot be loaded" in listed.stderr
    done = run(python, "calibrate", capture, tmp_path / "out", "--backend", "mapanything")
    assert done.returncode == 2
    assert "needs mapanything, which is not installed: pip install git" in done.stderr


def test_the_example_calibrates(python: Path, capture: Path, tmp_path: Path) -> None:
    package = tmp_path / "mapanything"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "models.py").write_text(MODELS)
    code = f"import sys; sys.path.append({str(tmp_path)!r}); from jcr.cli import main; main()"
    words = [
        "calibrate",
        capture,
        tmp_path / "out",
        "--backend",
        "mapanything",
        "--weights",
        capture,
        "--json",
    ]
    done = subprocess.run([python, "-c", code, *map(str, words)], capture_output=True, text=True, timeout=240)
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert found["backend"] == "mapanything", done.stderr
    true = np.load(capture / "gripper_from_camera.npy")
    np.testing.assert_allclose(found["gripper_from_camera"], true, atol=1e-4)
    assert found["scale"] == pytest.approx(1, abs=1e-3)
