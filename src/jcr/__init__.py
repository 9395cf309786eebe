"""Joint calibration and representation: a wrist camera's pictures to a calibrated camera and a map.

capture = jcr.read_capture("captures/table")
result = jcr.run(capture, "out/table")
scene = jcr.load_map("out/table")
"""

import sys
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from jcr.errors import InputError, NotTrustedError

# Pillow's PNG writer binds to another zlib, and crashes, where pycolmap was loaded before it.
if "pycolmap" in sys.modules and "PIL._imaging" not in sys.modules:
    raise ImportError("import jcr (or PIL.Image) before pycolmap: in the other order writing a PNG crashes")
import PIL._imaging  # noqa: E402, F401

if TYPE_CHECKING:
    from jcr.capture.read import read_capture
    from jcr.handeye.solve import solve_hand_eye
    from jcr.pipeline import build_map, calibrate, measure, run
    from jcr.represent.scene import load_map

__version__ = version("jcr")

_ROOMS = {
    "read_capture": "jcr.capture.read",
    "solve_hand_eye": "jcr.handeye.solve",
    "run": "jcr.pipeline",
    "calibrate": "jcr.pipeline",
    "build_map": "jcr.pipeline",
    "measure": "jcr.pipeline",
    "load_map": "jcr.represent.scene",
}

__all__ = [
    "InputError",
    "NotTrustedError",
    "build_map",
    "calibrate",
    "load_map",
    "measure",
    "read_capture",
    "run",
    "solve_hand_eye",
]


def __getattr__(name: str) -> Any:
    # Torch, SciPy and COLMAP take seconds to import; each door opens only the room behind it.
    if name in _ROOMS:
        return getattr(import_module(_ROOMS[name]), name)
    raise AttributeError(f"module 'jcr' has no attribute {name!r}")
