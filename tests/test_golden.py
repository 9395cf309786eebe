"""Run folders of version 0.1, in which reconstruct made the depth too, are read."""

import json
import shutil
from pathlib import Path

import pytest

from jcr.depth.options import DepthOptions
from jcr.run_folder import RunFolder
from places import ROOT

GOLDEN = ROOT / "tests" / "golden"
"""Five images and a fixed camera, 320x240; `run` by `jcr run --backend colmap`, `calibrated` by `jcr calibrate` of the
same, both with pointmaps 40 pixels wide, without map and report, and with compressed arrays."""


@pytest.mark.parametrize("name", ["run", "calibrated"])
def test_what_version_0_1_wrote_is_read(tmp_path: Path, name: str) -> None:
    folder = RunFolder(Path(shutil.copytree(GOLDEN / name, tmp_path / name)))
    state = json.loads((folder.path / "run.json").read_text()) | {"capture": str(GOLDEN / "capture")}
    (folder.path / "run.json").write_text(json.dumps(state))
    calibration, reconstruction = folder.calibrated()
    assert calibration.version == "0.1.0"
    assert calibration.converged and len(calibration.images) == 5
    assert calibration.attempts[0].backend == "colmap"
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
