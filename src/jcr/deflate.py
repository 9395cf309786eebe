"""The system's zlib, loaded before pycolmap can.

The library of pycolmap 4.1 and later exports a deflate of its own. On Linux a libz that is loaded after it calls parts
of that one, and the next PNG or zip archive that anybody in the process writes (Pillow, OpenCV, Python's own zlib)
aborts it; reading is not concerned.
"""

import ctypes
import sys
from contextlib import suppress

WORKS = "pycolmap" not in sys.modules
"""Whether compressing is safe: pycolmap was not imported before jcr."""

with suppress(OSError):  # other systems have no library of this name, nor the trouble
    ctypes.CDLL("libz.so.1")
