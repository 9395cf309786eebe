from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="session")
def tabletop() -> Path:
    """The bundled capture."""
    return ROOT / "examples" / "tabletop"


@pytest.fixture(scope="session")
def real_captures() -> Path:
    """Real captures with references, which live beside the project and not in it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real captures are not at {folder}")
    return folder
