"""Touched points against the map: right ones agree within what is expected, a moved camera does not."""

import json
from pathlib import Path

import numpy as np
import pytest

from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.pipeline.touch import touch
from jcr.result import RunResult
from scenes import reference_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def touched(done: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where images of the bundled run show six points, and where these are by its simulated truth."""
    from jcr.calibration.cues import surface_at
    from jcr.geometry import apply

    calibration, capture, reconstruction = RunResult(done).of_wrist_camera()
    rng = np.random.default_rng(0)
    true = reference_of(capture.folder)
    lines = ["image, x_px, y_px, x_m, y_m, z_m"]
    for k in (0, 2, 4):
        name = capture.images[reconstruction.image_index[k]]
        found = 0
        while found < 2:
            x_px = rng.uniform((80, 60), (560, 420)).round()
            try:
                seen = surface_at(capture, reconstruction, name, x_px, "test")
            except InputError:
                continue
            # By the true transform and this image's own gripper pose, at the depth that was found.
            recon_from_camera = reconstruction.recon_from_camera[k]
            assert calibration.scale is not None
            in_camera = calibration.scale * apply(np.linalg.inv(recon_from_camera), seen)
            pose = capture.base_from_gripper[reconstruction.image_index[k]]
            tip = apply(pose @ true, in_camera)
            lines.append(f"{name}, {x_px[0]}, {x_px[1]}, " + ", ".join(f"{v:.6f}" for v in tip))
            found += 1
    path = tmp_path_factory.mktemp("touch") / "touched.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_points_that_are_where_the_truth_has_them_agree(done: Path, touched: Path):
    found = touch(done, touched)
    assert found.p_value > 0.01 and len(found.error) == 6
    assert found.rms < 3 * found.expected


def test_a_tip_that_is_off_is_named_by_status_3_and_its_mean(
    done: Path, touched: Path, tmp_path: Path, capsys
):
    lines = [line.split(",") for line in touched.read_text().splitlines()]
    off = [lines[0], *([*line[:5], f" {float(line[5]) + 0.02:.6f}"] for line in lines[1:])]
    path = tmp_path / "off.csv"
    path.write_text("\n".join(",".join(line) for line in off))
    assert dispatch(["touch", str(done), str(path), "--json"]) == 3
    printed = json.loads(capsys.readouterr().out)
    assert printed["mean_mm"][2] == pytest.approx(20, abs=3) and printed["p"] < 1e-3


HEADER = "image, x_px, y_px, x_m, y_m, z_m\n"
FAULTS = {
    "has no column y_px, x_m": "image, x_px\n",
    "line 2": f"{HEADER}images/0.png, 1, 2, a, 0, 0\n",
    "in metres": f"{HEADER}images/0.png, 1, 2, 300, 0, 0\n",
    "0 points; touch 3 or more": HEADER,
    "not among the registered": HEADER + 3 * "nothing.png, 1, 2, 0, 0, 0\n",
}


@pytest.mark.parametrize("words", FAULTS)
def test_what_is_no_list_of_touched_points_is_refused(done: Path, tmp_path: Path, words: str):
    (tmp_path / "points.csv").write_text(FAULTS[words])
    with pytest.raises(InputError, match=words):
        touch(done, tmp_path / "points.csv")
