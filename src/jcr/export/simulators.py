"""Camera of a run as text for simulators: MuJoCo's MJCF and USD, pinhole cameras without distortion."""

import re

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.camera import unproject
from jcr.errors import InputError
from jcr.export.ros import CameraMount, notes, xml_comment
from jcr.records import Intrinsics

OPTICAL_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform from camera axes of OpenGL (x right, y up, z backward), those of MuJoCo and USD, to the optical frame."""
PITCH_MM = 0.005
"""Size of a pixel (mm) of the simulated sensor; images depend on ratios of its lengths only."""
RESIDUAL_POINTS = 25
"""Number of pixels along each axis at which the residual of the pinhole is computed."""


def mjcf(mount: CameraMount) -> str:
    """Return an MJCF model with the camera on a body that stands for its parent, the gripper or the base.

    The element `camera` belongs into the body of the robot's own model.
    """
    camera, pose = _pinhole(mount), mount.parent_from_child @ OPTICAL_FROM_GL
    fovy = np.degrees(2 * np.arctan(0.5 * camera.height / camera.fy))
    pitch = 1e-3 * PITCH_MM
    offset = np.array([camera.cx - (camera.width - 1) / 2, camera.cy - (camera.height - 1) / 2])
    attributes = {
        "name": mount.child,
        "pos": _numbers(pose[:3, 3]),
        "quat": _numbers(np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True), 1)),
        "resolution": f"{camera.width} {camera.height}",
        "sensorsize": _numbers(pitch * np.array([camera.width, camera.height])),
        "focal": _numbers(pitch * np.array([camera.fx, camera.fy])),
        "principal": _numbers(-pitch * offset),
    }
    words = "\n              ".join(f'{name}="{value}"' for name, value in attributes.items())
    return f"""<mujoco model="hand_eye">
{xml_comment(*_about(mount, camera))}
  <!-- copy the camera into the body {mount.parent} of the robot; pos and quat (w x y z) are of MuJoCo's camera axes.
       For a tool without focal, principal and sensorsize: fovy="{fovy:.6f}" -->
  <worldbody>
    <body name="{mount.parent}">
      <camera {words}/>
    </body>
  </worldbody>
</mujoco>
"""


def usd(mount: CameraMount) -> str:
    """Return a USD layer (usda, metres, z up) with a camera prim in an Xform that stands for its parent."""
    camera, pose = _pinhole(mount), mount.parent_from_child @ OPTICAL_FROM_GL
    # A layer in metres states apertures and focal length in tenths of its unit, and only their ratios count.
    focal = PITCH_MM * camera.fx
    width, height = focal * camera.width / camera.fx, focal * camera.height / camera.fy
    right, up = 0.5 - (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height - 0.5
    rows = ", ".join(f"({', '.join(f'{value:.15g}' for value in row)})" for row in pose.T)
    lines = (line.replace("\\", "/").replace('"', "'") for line in _about(mount, camera))
    about = "\n    ".join(" ".join(line.split()) for line in lines)
    return f'''#usda 1.0
(
    defaultPrim = "{_prim(mount.parent)}"
    doc = """{about}"""
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "{_prim(mount.parent)}"
{{
    def Camera "{_prim(mount.child)}"
    {{
        float2 clippingRange = (0.01, 100)
        float focalLength = {focal:.9g}
        float horizontalAperture = {width:.9g}
        float horizontalApertureOffset = {width * right:.9g}
        float verticalAperture = {height:.9g}
        float verticalApertureOffset = {height * up:.9g}
        token projection = "perspective"
        matrix4d xformOp:transform = ( {rows} )
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}
}}
'''


def residual_px(camera: Intrinsics) -> tuple[float, float]:
    """Return root mean square and largest distance (px) of the camera's pixels from those without distortion."""
    x, y = (np.linspace(0, size - 1, RESIDUAL_POINTS) for size in (camera.width, camera.height))
    x_px = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    straight = unproject(camera, x_px) @ camera.matrix.T
    off = np.linalg.norm(straight[:, :2] / straight[:, 2:] - x_px, axis=1)
    return float(np.sqrt((off**2).mean())), float(off.max())


def _pinhole(mount: CameraMount) -> Intrinsics:
    """Return the intrinsics of a mount; raise InputError if they are unknown."""
    if mount.intrinsics is None:
        raise InputError("no intrinsics: camera poses were given without images; export urdf")
    return mount.intrinsics


def _about(mount: CameraMount, camera: Intrinsics) -> list[str]:
    """Return the notes of a mount, and the residual of its pinhole."""
    rms, largest = residual_px(camera)
    residual = f"the pinhole leaves {rms:.2f} px (rms) and {largest:.2f} px (largest) of the distortion out"
    return [*notes(mount), residual]


def _prim(name: str) -> str:
    """Return a frame name as the name of a USD prim, which has letters, digits and _ and no digit in front."""
    return re.sub(r"^(?=\d)", "_", re.sub(r"\W", "_", name))


def _numbers(values: np.ndarray) -> str:
    """Return numbers with 12 significant digits, separated by spaces."""
    return " ".join(f"{value:.12g}" for value in values)
