"""Views of a scene rendered off screen by MuJoCo, with exact depth and labels; its model in MJCF."""

import ctypes.util
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree as xml

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.images import encode_png
from jcr.errors import InputError
from jcr.extras import extra
from jcr.geometry import transform
from jcr.records import Intrinsics
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
    """Render the views of pinhole cameras with fx = fy and a central principal point, which is what MuJoCo has.

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
    """Open MuJoCo's model, data and a renderer for each size (width, height), and close them at the end."""
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


# MJCF, the model format of MuJoCo (https://mujoco.readthedocs.io/en/stable/XMLreference.html).

LABEL_PREFIX = "label-"
"""Geoms are named `label-<label>-<part>`; others belong to no label."""

CAMERA = "wrist"

_FLOOR_BELOW_TABLE = 0.72
_LAMPS = 4


def to_mjcf(
    scene: Scene, textured: bool, fovy: float, buffer: tuple[int, int]
) -> tuple[str, dict[str, bytes]]:
    """Return MJCF text and its PNG files by name.

    Untextured: every part in its one colour. The camera, of vertical field of view `fovy` rad, is rendered
    into a `buffer` of width by height pixels.
    """
    center = scene.table_center_in_base
    # All light is the lamps': a head light would move with the camera and wash the shading out.
    root = xml.fromstring(f"""
        <mujoco model="{scene.name}">
        <compiler balanceinertia="true"/>
        <statistic center="{_text(center)}" extent="0.8"/>
        <visual>
        <global offwidth="{buffer[0]}" offheight="{buffer[1]}"/>
        <quality shadowsize="2048" offsamples="0"/>
        <headlight ambient="0.5 0.5 0.5" diffuse="0 0 0" specular="0 0 0"/>
        <map znear="0.02" zfar="12" shadowscale="0.5"/>
        </visual>
        <asset><texture type="skybox" builtin="gradient" rgb1=".62 .64 .66" rgb2=".40 .41 .42" width="32" height="192"/>
        </asset>
        <worldbody/>
        </mujoco>""")
    assets, world = root[3], root[4]
    # One lamp is a ring of weak ones: MuJoCo's shadows are hard, their sum is soft.
    for angle in 2 * np.pi * np.arange(_LAMPS) / _LAMPS:
        at = scene.light_in_base + 0.12 * np.array([np.cos(angle), np.sin(angle), 0.0])
        shine = {"diffuse": _text(np.full(3, 0.6 / _LAMPS)), "specular": _text(np.full(3, 0.3 / _LAMPS))}
        fixed = {"ambient": "0 0 0", "cutoff": "40", "exponent": "1", "castshadow": "true"}
        xml.SubElement(world, "light", shine | fixed, pos=_text(at), dir=_text(center - at))
    xml.SubElement(world, "camera", name=CAMERA, fovy=repr(float(np.degrees(fovy))))
    floor = _text(center - [0, 0, _FLOOR_BELOW_TABLE])
    xml.SubElement(world, "geom", type="box", size="3 3 .01", pos=floor, rgba=".36 .36 .37 1")
    files: dict[str, bytes] = {}
    bodies = [(transform(np.eye(3), center), scene.table)]
    bodies += [(thing.base_from_object, thing.parts) for thing in scene.objects]
    for label, (base_from_body, parts) in enumerate(bodies, start=1):
        axes = _text(base_from_body[:3, :2].T)
        body = xml.SubElement(world, "body", pos=_text(base_from_body[:3, 3]), xyaxes=axes)
        for k, part in enumerate(parts):
            name = f"{LABEL_PREFIX}{label}-{k}"
            # MuJoCo counts v from the first row of the image, that is from its top. Parts are open sheets, which have
            # no volume.
            vertex, face = _text(part.mesh.vertices), _text(part.mesh.faces)
            texcoord = _text(part.mesh.uv * [1, -1] + [0, 1])
            xml.SubElement(
                assets, "mesh", name=name, vertex=vertex, texcoord=texcoord, face=face, inertia="shell"
            )
            shine = {"specular": f"{part.shine}", "shininess": "0.4"}
            material = xml.SubElement(assets, "material", shine, name=name)
            if textured and part.texture is not None:
                files[f"{name}.png"] = encode_png(part.texture)
                xml.SubElement(assets, "texture", name=name, type="2d", file=f"{name}.png")
                material.set("texture", name)
            else:
                material.set("rgba", _text((*part.color, 1.0)))
            of_mesh = {"mesh": name, "material": name, "contype": "0", "conaffinity": "0"}
            xml.SubElement(body, "geom", of_mesh, name=name, type="mesh")
    return xml.tostring(root, encoding="unicode"), files


def _text(numbers) -> str:
    return " ".join(repr(float(x)) if x != int(x) else str(int(x)) for x in np.ravel(numbers))
