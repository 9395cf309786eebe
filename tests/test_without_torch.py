"""What a core install does, in processes that cannot import torch, and what it says where torch is needed."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jcr.cli import COMMANDS
from jcr.extras import DISTRIBUTION
from places import ROOT

pytestmark = pytest.mark.slow

MAY_NEED_TORCH = (
    "features/learned", "features/xfeat",
    "pointmaps/dust3r/",
    "pointmaps/", "pointmaps/predictions", "scene/", "segments/sam",
    "paper/alignment", "paper/fields", "paper/run",
    "export/rrd", "export/planner_maps", "viewer/",
)  # fmt: skip
"""Modules in src/jcr that may import torch (or viser) when they are imported themselves."""
NEED_NONE = {"scene/cloud", "scene/map_file", "scene/options"}
"""Among these, what a run without a map imports all the same."""


ABSENT = """
import sys
from importlib.machinery import PathFinder

class WithoutTorch(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] == "torch" else super().find_spec(name, path, target)

sys.meta_path = [WithoutTorch if finder is PathFinder else finder for finder in sys.meta_path]
"""
"""Whoever looks for torch, to import it or to see whether it is there, finds none."""


def without_torch(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """A process on a machine where torch is not installed."""
    command = [sys.executable, "-c", ABSENT + code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def run_jcr(*arguments: object) -> subprocess.CompletedProcess[str]:
    return without_torch("from jcr.cli import main; main()", *arguments)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory, small_capture: Path) -> Path:
    """A run folder made without torch, by a program that imported pycolmap before jcr."""
    out = tmp_path_factory.mktemp("core") / "out"
    done = without_torch("import pycolmap\nfrom jcr.cli import main; main()", "run", small_capture, out)
    assert done.stdout.startswith("ACCEPTED"), done.stderr
    missing = f"the map needs torch, which is not installed: pip install '{DISTRIBUTION}[map]'"
    assert f"\nMap         no map was made: {missing}" in done.stdout
    return out


def test_a_capture_is_calibrated_and_reported_as_with_torch(calibrated: Path, small_done: Path):
    names = {path.name for path in calibrated.iterdir()} - {".lock"}
    assert names == {
        "calibration.json",
        "reconstruction.npz",
        "report.html",
        "log.txt",
        "run.json",
        "uncertainty.npz",
    }
    compared = run_jcr("compare", calibrated, small_done, "--json")
    assert compared.returncode == 0, compared.stderr
    assert json.loads(compared.stdout)["translation_mm"] < 1e-3


def test_what_needs_torch_shows_what_to_install_first(small_capture: Path, calibrated: Path, tmp_path: Path):
    mapped = tmp_path / "mapped"
    shutil.copytree(calibrated, mapped)
    (mapped / "map.safetensors").write_bytes(b"")
    commands = {
        "map": ["map", str(calibrated)],
        "glb": ["export", str(mapped), "glb"],
        "octomap": ["export", str(mapped), "octomap"],
        "dust3r": ["run", str(small_capture), str(tmp_path / "out"), "--backend", "dust3r"],
    }
    code = "import json; from jcr.cli import dispatch\nfor words in json.loads(sys.argv[1]): print(dispatch(words))"
    done = without_torch(code, json.dumps(list(commands.values())))
    assert done.stdout.split() == ["2"] * len(commands), done.stderr
    for name, line in zip(commands, done.stderr.splitlines(), strict=True):
        extra = "networks" if name == "dust3r" else "map"
        assert line.startswith("error: ")
        assert f"needs torch, which is not installed: pip install '{DISTRIBUTION}[{extra}]'" in line
        assert ("`jcr run` and `jcr calibrate`" in line) == (name == "map")


def test_only_the_modules_that_work_with_tensors_need_torch():
    source = ROOT / "src" / "jcr"
    names = [str(file.relative_to(source).with_suffix("")) for file in sorted(source.rglob("*.py"))]
    names = [name for name in names if name not in ("__init__", "__main__")]
    code = """
from importlib import import_module
for name in sys.argv[1:]:
    try:
        import_module("jcr." + name.replace("/", ".").removesuffix(".__init__"))
    except ModuleNotFoundError:
        print(name)
"""
    done = without_torch(code, *names)
    assert done.returncode == 0, done.stderr
    need = set(done.stdout.split())
    assert "scene/scene_map" in need
    assert not {name for name in need if not name.startswith(MAY_NEED_TORCH)} | (need & NEED_NONE)


def test_help_and_a_calibration_import_nothing_heavy():
    """Half of a start were modules of maps, networks and statistics, which a calibration does not need."""
    code = """
import contextlib, io
from jcr.cli import dispatch
heavy = {"torch", "pycolmap", "mujoco", "transformers", "viser", "scipy", "cv2", "PIL"}
for name in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()):
        dispatch([name, "--help"] if name else ["--help"])
    print(name or "jcr", *sorted(heavy & sys.modules.keys()))
import jcr.cli.run_calibrate_batch, jcr.pipeline.run
print("calibrate", *sys.modules)
"""
    first = ["", "run", "calibrate", "check", "map", "view"]
    command = [sys.executable, "-c", "import sys" + code, *first, *COMMANDS]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    *helped, calibrating = ran.stdout.splitlines()
    assert helped[:6] == ["jcr", *first[1:]]
    assert not {"torch", "pycolmap", "mujoco", "transformers", "viser"} & set(" ".join(helped).split())
    loaded = set(calibrating.split())
    assert "jcr.pipeline.run" in loaded
    assert not loaded & {"torch", "numba", "huggingface_hub", "httpx", "trimesh", "skimage", "scipy.stats"}
    assert "jcr.scene.build" not in loaded
