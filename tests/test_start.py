"""What `jcr calibrate` loads before it works: processor seconds of every start."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

NOT_NEEDED = (
    "torch",
    "numba",
    "huggingface_hub",
    "httpx",
    "trimesh",
    "skimage",
    "scipy.stats",
    "jcr.scene.build",
)


def test_a_calibration_loads_nothing_of_maps_networks_and_statistics() -> None:
    """scipy.stats alone took as long as all that is left; torch takes seconds."""
    program = "import sys, jcr.cli.run, jcr.pipeline.run, jcr.sfm.colmap; print(*sorted(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "jcr.pipeline.run" in ran.stdout.split()
    assert not set(NOT_NEEDED) & set(ran.stdout.split())
