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
from jcr.records import Intrinsics
from simulation.objects import Part
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
    width, height = buffer
    root = xml.Element("mujoco", model=scene.name)
    xml.SubElement(root, "statistic", center=_text(scene.table_center_in_base), extent="0.8")
    visual = xml.SubElement(root, "visual")
    xml.SubElement(visual, "global", offwidth=str(width), offheight=str(height))
    xml.SubElement(visual, "quality", shadowsize="2048", offsamples="0")
    # All light is the lamps': a head light would move with the camera and wash the shading out.
    xml.SubElement(visual, "headlight", ambient="0.5 0.5 0.5", diffuse="0 0 0", specular="0 0 0")
    xml.SubElement(visual, "map", znear="0.02", zfar="12", shadowscale="0.5")
    assets = xml.SubElement(root, "asset")
    xml.SubElement(
        assets,
        "texture",
        type="skybox",
        builtin="gradient",
        rgb1=".62 .64 .66",
        rgb2=".40 .41 .42",
        width="32",
        height="192",
    )
    world = xml.SubElement(root, "worldbody")
    _add_lamps(world, scene)
    xml.SubElement(world, "camera", name=CAMERA, fovy=repr(float(np.degrees(fovy))))
    floor = scene.table_center_in_base - [0, 0, _FLOOR_BELOW_TABLE]
    xml.SubElement(world, "geom", type="box", size="3 3 .01", pos=_text(floor), rgba=".36 .36 .37 1")
    files: dict[str, bytes] = {}
    table_frame = np.eye(4)
    table_frame[:3, 3] = scene.table_center_in_base
    _add_body(assets, world, files, 1, table_frame, scene.table, textured)
    for label, thing in enumerate(scene.objects, start=2):
        _add_body(assets, world, files, label, thing.base_from_object, thing.parts, textured)
    return xml.tostring(root, encoding="unicode"), files


def _add_lamps(world: xml.Element, scene: Scene) -> None:
    """Add one lamp as a ring of weak ones: MuJoCo's shadows are hard, their sum is soft."""
    for angle in 2 * np.pi * np.arange(_LAMPS) / _LAMPS:
        at = scene.light_in_base + 0.12 * np.array([np.cos(angle), np.sin(angle), 0.0])
        xml.SubElement(
            world,
            "light",
            pos=_text(at),
            dir=_text(scene.table_center_in_base - at),
            diffuse=_text(np.full(3, 0.6 / _LAMPS)),
            specular=_text(np.full(3, 0.3 / _LAMPS)),
            ambient="0 0 0",
            cutoff="40",
            exponent="1",
            castshadow="true",
        )


def _add_body(
    assets: xml.Element,
    world: xml.Element,
    files: dict[str, bytes],
    label: int,
    base_from_body: ndarray,
    parts: Iterable[Part],
    textured: bool,
) -> None:
    body = xml.SubElement(
        world, "body", pos=_text(base_from_body[:3, 3]), xyaxes=_text(base_from_body[:3, :2].T)
    )
    for k, part in enumerate(parts):
        name = f"{LABEL_PREFIX}{label}-{k}"
        xml.SubElement(
            assets,
            "mesh",
            name=name,
            vertex=_text(part.mesh.vertices),
            # MuJoCo counts v from the first row of the image, that is from its top.
            texcoord=_text(part.mesh.uv * [1, -1] + [0, 1]),
            face=_text(part.mesh.faces),
            # Parts are open sheets, which have no volume.
            inertia="shell",
        )
        material = xml.SubElement(assets, "material", name=name, specular=f"{part.shine}", shininess="0.4")
        if textured and part.texture is not None:
            files[f"{name}.png"] = encode_png(part.texture)
            xml.SubElement(assets, "texture", name=name, type="2d", file=f"{name}.png")
            material.set("texture", name)
        else:
            material.set("rgba", _text((*part.color, 1.0)))
        xml.SubElement(
            body, "geom", name=name, type="mesh", mesh=name, material=name, contype="0", conaffinity="0"
        )


def _text(numbers) -> str:
    return " ".join(repr(float(x)) if x != int(x) else str(int(x)) for x in np.ravel(numbers))
