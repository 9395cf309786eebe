"""Joint calibration and representation: a wrist camera's images to a calibrated camera and a map.

capture = jcr.read_capture("captures/table")
result = jcr.run(capture, "out/table")
scene = jcr.load_map("out/table")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jcr import deflate  # noqa: F401
from jcr.errors import InputError, NotTrustedError, RejectedError

if TYPE_CHECKING:
    from jcr.calibration.difference import compare
    from jcr.calibration.options import CalibrateOptions
    from jcr.capture.options import ReadOptions
    from jcr.capture.read import read_capture
    from jcr.check import check as check_capture
    from jcr.export.formats import export_run
    from jcr.handeye.solve import solve_hand_eye
    from jcr.live.calibration import LiveCalibration
    from jcr.live.calibration_progress import Progress
    from jcr.pipeline import add_camera, build_map, calibrate, measure, run
    from jcr.reconstruct.backends import ReconstructOptions
    from jcr.represent.map_file import load_map
    from jcr.results import RunOptions, load_run
    from jcr.touch_test import touch
    from jcr.verify import verify as verify_run

    __version__: str

_MODULE_OF = {
    "ReadOptions": "jcr.capture.options",
    "RunOptions": "jcr.results",
    "CalibrateOptions": "jcr.calibration.options",
    "ReconstructOptions": "jcr.reconstruct.backends",
    "compare": "jcr.calibration.difference",
    "load_run": "jcr.results",
    "touch": "jcr.touch_test",
    "check_capture": "jcr.check:check",
    "verify_run": "jcr.verify:verify",
    "export_run": "jcr.export.formats",
    "read_capture": "jcr.capture.read",
    "solve_hand_eye": "jcr.handeye.solve",
    "LiveCalibration": "jcr.live.calibration",
    "Progress": "jcr.live.calibration_progress",
    "run": "jcr.pipeline",
    "add_camera": "jcr.pipeline",
    "calibrate": "jcr.pipeline",
    "build_map": "jcr.pipeline",
    "measure": "jcr.pipeline",
    "load_map": "jcr.represent.map_file",
}

__all__ = [
    "CalibrateOptions",
    "InputError",
    "LiveCalibration",
    "NotTrustedError",
    "Progress",
    "ReadOptions",
    "ReconstructOptions",
    "RejectedError",
    "RunOptions",
    "add_camera",
    "build_map",
    "calibrate",
    "check_capture",
    "compare",
    "export_run",
    "load_map",
    "load_run",
    "measure",
    "read_capture",
    "run",
    "solve_hand_eye",
    "touch",
    "verify_run",
]


def __getattr__(name: str) -> Any:
    # SciPy and COLMAP take seconds to import; each name imports only the module behind it.
    if name in _MODULE_OF:
        module, _, inside = _MODULE_OF[name].partition(":")
        return getattr(import_module(module), inside or name)
    if name == "__version__":
        from importlib.metadata import version

        from jcr.extras import DISTRIBUTION

        return version(DISTRIBUTION)
    raise AttributeError(f"module 'jcr' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
