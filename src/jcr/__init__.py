"""Joint calibration and representation: a wrist camera's images to a calibrated camera and a map.

capture = jcr.read_capture("captures/table")
result = jcr.run(capture, "out/table")
scene = jcr.load_map("out/table")
"""

from importlib.util import find_spec
from typing import Any

import lazy_loader

from jcr import deflate  # noqa: F401

# SciPy and COLMAP take seconds to import: the stub __init__.pyi names the modules, each imported when it is first used.
_attribute, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
if not find_spec("torch"):
    __all__ = [name for name in __all__ if name not in ("DistanceGrid", "Sample", "SceneMap")]


def __getattr__(name: str) -> Any:
    """Import a public name, or read the version of the installed distribution."""
    if name == "__version__":
        from importlib.metadata import version

        from jcr.extras import DISTRIBUTION

        return version(DISTRIBUTION)
    return _attribute(name)


def __dir__() -> list[str]:
    """List the public names."""
    return [*__all__, "__version__"]
