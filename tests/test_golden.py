"""Run folders that an earlier version wrote, in which reconstruct made the depth too: read, and resumed from."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import jcr
from jcr import run_folder
from jcr.depth.depth_npz import FILE as DEPTH
from jcr.depth.options import DepthOptions
from jcr.geometry import step_between
from jcr.pipeline import calibrate
from jcr.run_folder import RunFolder
from places import ROOT

GOLDEN = ROOT / "tests" / "golden"
"""Five images and a fixed camera, 320x240; `run` by `jcr run --backend colmap`, `calibrated` by `jcr calibrate` of the
same, both with pointmaps 40 pixels wide, without map and report, and with compressed arrays."""


@pytest.fixture
def golden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """A copy of one of the folders beside its capture, as if this version had the number of the one that wrote it."""
    shutil.copytree(GOLDEN / "capture", tmp_path / "capture")

    def copied(name: str) -> Path:
        folder = Path(shutil.copytree(GOLDEN / name, tmp_path / name))
        state = json.loads((folder / "run.json").read_text())
        state["capture"] = str(tmp_path / "capture")
        (folder / "run.json").write_text(json.dumps(state))
        monkeypatch.setattr(run_folder, "__version__", RunFolder(folder).calibration().version)
        return folder

    return copied


@pytest.fixture
def nothing_is_reconstructed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("it is there already")

    monkeypatch.setattr("jcr.attempts.reconstruct", refuse)


@pytest.mark.parametrize("name", ["run", "calibrated"])
def test_what_an_earlier_version_wrote_is_read(golden: Callable[[str], Path], name: str) -> None:
    folder = RunFolder(golden(name))
    calibration, reconstruction = folder.calibrated()
    assert (
        calibration.converged and len(calibration.images) == 5 and calibration.attempts[0].backend == "colmap"
    )
    cameras = folder.cameras()
    assert cameras is not None and cameras.cameras[0].doubt is None
    assert folder.options().depth == DepthOptions() and folder.options().reconstruct.backend == "colmap"
    assert len(folder.capture()) == 5
    assert len(reconstruction.image_index) == 5 and not reconstruction.tracks.from_board
    if name == "calibrated":
        assert reconstruction.pointmaps is None
    else:
        dense = reconstruction.dense
        assert dense.confidence.shape == (5, 30, 40) and dense.confidence.any() and not dense.is_predicted


def test_the_same_calibration_comes_of_it(
    golden: Callable[[str], Path], nothing_is_reconstructed: None
) -> None:
    folder = RunFolder(golden("run"))
    before, depth = folder.calibration(), folder.reconstruction().dense
    result = calibrate(folder.capture(), folder.path, backend="colmap")
    # By another adjuster: the same within a tenth of its standard deviations.
    assert before.uncertainty is not None
    apart = step_between(
        np.array(before.gripper_from_camera), np.array(result.calibration.gripper_from_camera)
    )
    std = np.sqrt(np.diag(before.uncertainty.covariance))[:6]
    assert np.abs(apart / std).max() < 0.1
    # What was one file is two from now on, with the same in them.
    assert (folder.path / DEPTH).is_file()
    np.testing.assert_array_equal(folder.reconstruction().dense.points_in_recon, depth.points_in_recon)
    other = jcr.RunOptions(depth=DepthOptions(priors=False))
    assert calibrate(folder.capture(), folder.path, other, backend="colmap").reconstruction.pointmaps is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run", "calibrated"])
def test_a_map_is_built_on_it(
    golden: Callable[[str], Path], nothing_is_reconstructed: None, name: str
) -> None:
    from jcr.represent.options import MapOptions

    out = golden(name)
    result = jcr.build_map(out, map=MapOptions(max_seconds=5.0))
    assert result.cloud is not None and len(result.cloud.points_in_base) > 500
    assert (result.reconstruction.dense.confidence.shape[2] == 40) == (name == "run")
    assert RunFolder(out).has_map() and RunFolder(out).calibration().converged
