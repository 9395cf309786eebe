"""Joint calibration and representation: a wrist camera's images to a calibrated camera and a map.

    capture = jcr.read_capture("captures/table")
    result = jcr.run(capture, "out/table")                  # or jcr.load_run("out/table")
    result.verdict, result.gripper_from_camera, result.covariance, result.intrinsics
    x_in_base, covariance = result.point_in_base([320, 240], 0.45, base_from_gripper)
    scene = jcr.load_map("out/table")
    scene.query(x_in_base)

Captures      read_capture, check_capture, LiveCalibration
Calibration   run, calibrate, solve_hand_eye, load_run, compare, verify_run, touch, add_camera
Map           build_map, load_map, measure
Files         export_run
Networks      global_align
Options       RunOptions (reconstruct, calibrate, cloud, map, segment, depth), ReadOptions, ExportOptions
Errors        InputError (the input cannot be used), RejectedError (no calibration exists)

Transforms are 4×4 and named a_from_b, points x_in_a; metres and radians, pixels from the centre of the first one.
Lists are taken for arrays, and dicts for options. help(jcr.run) describes one name; `jcr docs` lists the manual.
"""

import ctypes
import sys
import warnings
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

import lazy_loader

# The library of pycolmap 4.1 and later exports its own deflate functions. On Linux, a libz that is loaded after pycolmap
# calls some of them, and writing a PNG file or zip archive (by Pillow, OpenCV or Python's zlib) aborts the process.
# Therefore the system's zlib is loaded first.
if "pycolmap" in sys.modules:
    warnings.warn(
        "pycolmap was imported before jcr: import jcr first, or writing PNG files may abort Python",
        stacklevel=2,
    )
with suppress(OSError):  # other systems have neither a library of this name nor the conflict
    ctypes.CDLL("libz.so.1")

# SciPy and COLMAP take seconds to import. The modules that the stub __init__.pyi names are imported on first use.
_attribute, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
if not find_spec("torch"):
    __all__ = [name for name in __all__ if name not in ("DistanceGrid", "Sample", "SceneMap")]


def __getattr__(name: str) -> Any:
    """Import and return the public name `name`, or return the version of the distribution for "__version__"."""
    if name == "__version__":
        from importlib.metadata import version

        from jcr.extras import DISTRIBUTION

        return version(DISTRIBUTION)
    try:
        return _attribute(name)
    except AttributeError as error:
        if name in __all__ or name.startswith("_"):
            raise
        from jcr.errors import did_you_mean

        raise AttributeError(
            f"{error}{did_you_mean(name, __all__)}", name=name, obj=sys.modules[__name__]
        ) from None


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
