"""Folders of the project and of what may be beside it."""

from pathlib import Path

ROOT = Path(__file__).parent.parent
SHARED = ROOT.parent / "shared"
"""Fixtures and real captures of others, which the project does not hold; tests say where it is absent."""
