"""The system's zlib, loaded before pycolmap can.

The library of pycolmap 4.1 and later exports a deflate of its own. On Linux a libz that is loaded after pycolmap calls
parts of that one, and the next PNG or zip archive that anybody in the process writes (Pillow, OpenCV, Python's own
zlib) aborts the process; reading is not concerned.
"""

import ctypes
import sys
import warnings
from contextlib import suppress

if "pycolmap" in sys.modules:
    warnings.warn(
        "pycolmap was imported before jcr: import jcr first, or writing PNG files may abort Python",
        stacklevel=3,
    )

with suppress(OSError):  # other systems have no library of this name, nor the conflict
    ctypes.CDLL("libz.so.1")
