"""What cameras see of a scene, drawn off screen by MuJoCo, with exact depth and labels."""

import ctypes.util
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.extras import extra
from jcr.records import Intrinsics
from simulation.mjcf import CAMERA, LABEL_PREFIX, to_mjcf
from simulation.scenes import Scene

_SUPERSAMPLING = 2


@dataclass(frozen=True)
class View:
    """One rendering."""

    image: UInt8[ndarray, "h w 3"]
    """RGB, averaged over each pixel's area."""
    depth: Float[ndarray, "h w"] | None
    """Along the optical axis at the pixel's centre, in metres; 0: nothing there. None when not asked for."""
    label: UInt8[ndarray, "h w"] | None
    """Row of the scene's `labels` at each pixel's centre."""


def render(
    scene: Scene,
    intrinsics: Intrinsics,
    base_from_camera: Iterable[Float[ndarray, "4 4"]],
    textured: bool = True,
    with_truth: bool = True,
) -> Iterator[View]:
    """The views of pinhole cameras with fx = fy and a central principal point, which is what MuJoCo has.

    Poses are taken one at a time, each when the view before it was taken.
    Raises InputError where MuJoCo or an OpenGL library is missing.
    """
    size = intrinsics.width, intrinsics.height
    fine = _SUPERSAMPLING * size[0], _SUPERSAMPLING * size[1]
    fovy = 2 * np.arctan(0.5 * intrinsics.height / intrinsics.fy)
    with _renderers(*to_mjcf(scene, textured, fovy, fine), fine, size) as (model, data, color, truth):
        label_of_geom = np.zeros(model.ngeom, np.uint8)
        for k in range(model.ngeom):
            if model.geom(k).name.startswith(LABEL_PREFIX):
                label_of_geom[k] = int(model.geom(k).name.split("-")[1])
        for matrix in base_from_camera:
            # MuJoCo's cameras look along -z with y up; ours along z with y down.
            data.cam_xpos[0], data.cam_xmat[0] = matrix[:3, 3], (matrix[:3, :3] * [1, -1, -1]).ravel()
            color.update_scene(data, CAMERA)
            # Blocks of pixels are averaged, so the centre of a pixel stays where it was.
            image = cv2.resize(color.render(), size, interpolation=cv2.INTER_AREA)
            if not with_truth:
                yield View(image, None, None)
                continue
            truth.update_scene(data, CAMERA)
            truth.enable_segmentation_rendering()
            geom = truth.render()[..., 0]
            truth.enable_depth_rendering()
            depth = truth.render().astype(np.float64)
            # Geom -1 is the sky.
            yield View(image, np.where(geom < 0, 0.0, depth), np.where(geom < 0, 0, label_of_geom[geom]))


@contextmanager
def _renderers(mjcf: str, files: dict[str, bytes], *sizes: tuple[int, int]) -> Iterator[Any]:
    """MuJoCo's model, data and a renderer for each size (width, height), closed at the end."""
    # MuJoCo reads the variable when it is imported; its own default on Linux needs a display.
    if platform.system() == "Linux":
        egl = ctypes.util.find_library("EGL") or not ctypes.util.find_library("OSMesa")
        os.environ.setdefault("MUJOCO_GL", "egl" if egl else "osmesa")
    mujoco: Any = extra("mujoco", "dev", "the simulation")
    model = mujoco.MjModel.from_xml_string(mjcf, files)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with ExitStack() as stack:
        try:
            renderers = [
                stack.enter_context(mujoco.Renderer(model, height, width)) for width, height in sizes
            ]
        # PyOpenGL raises whatever went wrong first where a library is missing: AttributeError, ImportError, …
        except Exception as error:
            raise InputError(
                f"no off-screen OpenGL with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({error}):"
                " apt-get install libegl1, or apt-get install libosmesa6 and set MUJOCO_GL=osmesa"
            ) from error
        yield model, data, *renderers
