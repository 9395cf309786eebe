"""Ctrl-C at any moment: one line, status 130, nothing half-written, and the same command goes on."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> Path:
    """Five small pictures of the table."""
    folder = tmp_path_factory.mktemp("capture")
    (folder / "images").mkdir()
    content = json.loads((tabletop / "capture.json").read_text())
    frames = content["frames"][:5]
    for frame in frames:
        image = Image.open(tabletop / frame["image"]).resize((320, 240), Image.Resampling.BOX)
        image.save(folder / frame["image"], quality=95)
    focal = content["intrinsics"]["fx"] / 2
    lens = {"fx": focal, "fy": focal, "cx": 159.5, "cy": 119.5}
    (folder / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": lens}))
    return folder


def test_an_interrupted_run_says_so_in_one_line_and_resumes(capture: Path, tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "jcr",
        "calibrate",
        str(capture),
        str(tmp_path / "out"),
        "--quiet",
        "--json",
    ]
    for seconds in (0.3, 1.0):  # after the folder is there: while it imports, and while COLMAP works
        running = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 60
        while not (tmp_path / "out" / ".lock").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(seconds)
        running.send_signal(signal.SIGINT)
        _, told = running.communicate(timeout=60)
        assert running.returncode == 130, told
        assert told.startswith("error: interrupted") and told.count("\n") == 1
        assert not list((tmp_path / "out").glob("*.part*"))
        (tmp_path / "out" / ".lock").unlink()
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert finished.returncode in (0, 3), finished.stderr
    assert len(json.loads(finished.stdout)["images"]) == 5
