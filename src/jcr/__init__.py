"""Joint calibration and representation: a wrist camera's pictures to a calibrated camera and a map.

capture = jcr.read_capture("captures/table")
result = jcr.run(capture, "out/table")
scene = jcr.load_map("out/table")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jcr import deflate  # noqa: F401
from jcr.errors import InputError, NotTrustedError

if TYPE_CHECKING:
    from jcr.capture.read import read_capture
    from jcr.handeye.solve import solve_hand_eye
    from jcr.pipeline import build_map, calibrate, measure, run
    from jcr.represent.map_file import load_map

    __version__: str

_MODULE_OF = {
    "read_capture": "jcr.capture.read",
    "solve_hand_eye": "jcr.handeye.solve",
    "run": "jcr.pipeline",
    "calibrate": "jcr.pipeline",
    "build_map": "jcr.pipeline",
    "measure": "jcr.pipeline",
    "load_map": "jcr.represent.map_file",
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
    # SciPy and COLMAP take seconds to import; each name imports only the module behind it.
    if name in _MODULE_OF:
        return getattr(import_module(_MODULE_OF[name]), name)
    if name == "__version__":
        from importlib.metadata import version

        from jcr.extras import DISTRIBUTION

        return version(DISTRIBUTION)
    raise AttributeError(f"module 'jcr' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
