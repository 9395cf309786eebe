"""Records that the stages of a run exchange: capture, reconstruction, parts of the calibration, requirement.

Frames: `base`, `gripper`, `camera` (OpenCV optical: x right, y down, z forward), `recon` (arbitrary origin
and unit). Pixel (0, 0) is the *centre* of the top-left pixel, as in OpenCV. Metres and radians.
"""

from jcr.findings.finding import Requirement as Requirement
from jcr.records.calibration_parts import *
from jcr.records.capture import *
from jcr.records.reconstruction import *
