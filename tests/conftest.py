import fcntl
import gc
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np
import numpy.testing  # noqa: F401 - numpy 1.26 starts lscpu when it is first imported
import pytest
from PIL import Image

import shape_checks
from chromium import Chromium
from in_process import run_jcr
from jcr.backends import Backend
from jcr.geometry import apply, transform
from places import ROOT, SHARED
from sift_once import find_sift_once
from simulation.scenes import make_scene
from simulation.truth import read_truth

if TYPE_CHECKING:
    import trimesh


def shrunk_capture(source: Path, folder: Path, images: int, width: int) -> Path:
    """Write the first images of a capture, reduced to a width in pixels, and their poses into `folder`."""
    (folder / "images").mkdir(parents=True)
    content = json.loads((source / "capture.json").read_text())
    frames, intrinsics = content["frames"][:images], content["intrinsics"]
    for frame in frames:
        image = Image.open(source / frame["image"])
        scale = width / image.width
        size = width, round(image.height * scale)
        image.resize(size, Image.Resampling.BOX).save(folder / frame["image"], quality=95)
    intrinsics = {
        "fx": intrinsics["fx"] * scale, "fy": intrinsics["fy"] * scale, "cx": (size[0] - 1) / 2,
        "cy": (size[1] - 1) / 2,
    }  # fmt: skip
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": intrinsics}))
    return folder


find_sift_once()

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A job in the background of a shell ignores Ctrl-C, and so would the commands that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)


SLOW_FIXTURES = {"done", "small_done", "simulated", "real_captures", "tiny_sam"}
"""Fixtures that run the command line, draw, reconstruct from images, or load a network."""


FIRST = (
    "live/test_calibration.py", "calibration/test_faults.py", "test_verify.py", "estimation/test_solve.py",
    "cell/test_cell.py", "calibration/test_conventions.py", "boards/test_marker.py", "scene/test_map_update.py",
    "scene/test_map.py", "cli/test_cli.py", "capture/test_discovery.py", "export/test_export.py",
    "calibration/test_lengths.py", "faults/test_wrong_poses.py", "estimation/test_prediction.py",
    "estimation/test_wrist.py", "sfm/test_colmap.py", "simulation/test_simulate.py", "paper/test_paper.py",
    "estimation/test_components.py", "test_batch.py", "test_check.py", "photometric/test_direct.py",
    "test_real_captures.py", "faults/test_faults.py", "faults/test_strangers.py",
)  # fmt: skip
"""Files by their processor seconds, longest first, after the one that makes the run `small_done`."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests by their fixtures, and put files with slow tests first: short ones are left for the end."""
    for item in items:
        marks = {mark.name for mark in item.iter_markers()} & {"gl", "long"}
        if marks or SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    rank = {ROOT / "tests" / name: k for k, name in enumerate(FIRST)}
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: rank.get(item.path, len(rank) + (item.path not in slow)))


def pytest_collection_finish() -> None:
    """Take modules and tests, which stay to the end, from the garbage collector: it took 4 % of the suite's time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Let no test of the fast tier start a process, nor its fixtures of a wide scope."""

    def refuse(*arguments: object, **options: object) -> NoReturn:
        pytest.fail(f"{item.nodeid} starts a process: mark it slow")

    with pytest.MonkeyPatch.context() as patch:
        if not item.get_closest_marker("slow"):
            patch.setattr(subprocess.Popen, "__init__", refuse)
            patch.setattr(BaseProcess, "start", refuse)
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    shape_checks.begin()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    shape_checks.begin()
    return (yield)


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the back ends whose weights are to count as present; none at first."""
    names: set[str] = set()
    monkeypatch.setattr(Backend, "has_weights", lambda self: not self.hub_id or self.name in names)
    monkeypatch.setattr(Backend, "is_installed", lambda self: True)
    monkeypatch.setattr("jcr.backends.xfeat_is_installed", lambda: "xfeat" in names)
    return names


@pytest.fixture(scope="session")
def tabletop() -> Path:
    """Return the bundled capture."""
    return ROOT / "examples" / "tabletop"


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that `make` fills once for all workers of pytest-xdist; no test changes it."""
    base = tmp_path_factory.getbasetemp()
    together = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made"
    together.mkdir(exist_ok=True)
    with (together / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (together / name).exists():
            make(together / name)
    return together / name


def run_by_command(capture: Path, out: Path) -> None:
    finished = run_jcr("run", capture, out, "--quiet")
    assert finished.stdout.startswith("ACCEPTED") and "\nReport  " in finished.stdout, finished.stderr


@pytest.fixture(scope="session")
def small_capture(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> Path:
    """Return five images of the bundled capture, 200 pixels wide, of which a whole run takes seconds."""
    return made_once(tmp_path_factory, "capture", lambda folder: shrunk_capture(tabletop, folder, 5, 200))


@pytest.fixture(scope="session")
def half_capture(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> Path:
    """Return the twelve images of the bundled capture, 320 pixels wide; no test changes them."""
    return made_once(tmp_path_factory, "half", lambda folder: shrunk_capture(tabletop, folder, 12, 320))


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """A browser, started once."""
    opened = Chromium(tmp_path_factory.mktemp("chromium"), "--disable-gpu")
    yield opened
    opened.close()


@pytest.fixture
def chromium(browser: Chromium) -> Chromium:
    """The browser with an empty page, without the events of earlier tests; a live page goes on asking its server."""
    browser.events.clear()
    browser.open("about:blank", 800)
    browser.events.clear()
    return browser


@pytest.fixture(scope="session")
def done(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> Path:
    """Return the run folder of the bundled capture, a copy of this worker's own."""
    made = made_once(tmp_path_factory, "tabletop", lambda out: run_by_command(tabletop, out))
    return shutil.copytree(made, tmp_path_factory.mktemp("run") / "tabletop")


@pytest.fixture(scope="session")
def small_done(tmp_path_factory: pytest.TempPathFactory, small_capture: Path) -> Path:
    """Return the run folder of `small_capture`; no test changes it."""
    return made_once(tmp_path_factory, "small", lambda out: run_by_command(small_capture, out))


@pytest.fixture(scope="session")
def true_mesh(tabletop: Path) -> "trimesh.Trimesh":
    """Return the simulated table of the bundled capture and all objects on it, in the base frame."""
    import trimesh

    scene = make_scene("tabletop", read_truth(tabletop).seed)
    base_from_table = transform(np.eye(3), scene.table_center_in_base)
    placed = [(base_from_table, part.mesh) for part in scene.table]
    placed += [(thing.base_from_object, part.mesh) for thing in scene.objects for part in thing.parts]
    return trimesh.util.concatenate(
        [trimesh.Trimesh(apply(where, mesh.vertices), mesh.faces, process=False) for where, mesh in placed]
    )


@pytest.fixture(scope="session")
def real_captures() -> Path:
    """Return real captures with references, which are beside the project and not in it."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(f"the real captures are not at {folder}")
    return folder
