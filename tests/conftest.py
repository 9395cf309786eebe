import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def tabletop() -> Path:
    """The bundled capture."""
    return ROOT / "examples" / "tabletop"


@pytest.fixture(scope="session")
def done(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> Path:
    """The run folder of the bundled capture, made once by the command line."""
    out = tmp_path_factory.mktemp("run") / "tabletop"
    command = [sys.executable, "-m", "jcr", "run", str(tabletop), str(out), "--quiet"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert finished.returncode == 0, finished.stderr
    assert "report:" in finished.stdout
    return out


@pytest.fixture(scope="session")
def real_captures() -> Path:
    """Real captures with references, which live beside the project and not in it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real captures are not at {folder}")
    return folder
