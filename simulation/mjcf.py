"""A scene as MJCF, the model format of MuJoCo (https://mujoco.readthedocs.io/en/stable/XMLreference.html)."""

from collections.abc import Iterable
from xml.etree import ElementTree as xml

import numpy as np
from numpy import ndarray

from jcr.capture.images import encode_png
from simulation.objects import Part
from simulation.scenes import Scene

LABEL_PREFIX = "label-"
"""Geoms are named `label-<label>-<part>`; others belong to no label."""

CAMERA = "wrist"

_FLOOR_BELOW_TABLE = 0.72
_LAMPS = 4


def to_mjcf(
    scene: Scene, textured: bool, fovy: float, buffer: tuple[int, int]
) -> tuple[str, dict[str, bytes]]:
    """MJCF text and its PNG files by name.

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
    """One lamp as a ring of weak ones: MuJoCo's shadows are hard, their sum is soft."""
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
