"""Ground truth of a simulated capture, in files beside it, and the surface that its images show."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image
from pydantic import TypeAdapter

from jcr.camera import rays
from jcr.capture.images import encode_png
from jcr.files import write_bytes, write_text
from jcr.geometry import apply
from jcr.records import Intrinsics

DEPTH_UNIT_M = 1e-4
"""Metres per count of the 16-bit depth images."""


@dataclass(frozen=True, kw_only=True)
class TrueObject:
    """Object of a scene as it is."""

    name: str
    label: int
    height: float
    """Height of its highest point above the table, in metres."""
    footprint_in_base: Float[ndarray, "k 2"]
    """Convex outline seen from straight above: x and y in metres."""
    base_from_box: Float[ndarray, "4 4"]
    """Centre and axes of the smallest upright box around it, z up."""
    box_size: Float[ndarray, "3"]
    """Sides of that box along its axes, in metres."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """True values of a simulated capture."""

    folder: Path
    """Folder of the capture."""
    scene: str
    seed: int
    """Seed of the scene: `make_scene` makes its meshes again."""
    images: tuple[str, ...]
    """Names of the images in capture.json."""
    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]
    """True gripper poses; the robot may report others."""
    base_from_camera: Float[ndarray, "n 4 4"]
    intrinsics: Intrinsics
    labels: tuple[str, ...]
    """Name per label; 0 is what is no part of the scene, 1 the table."""
    table_height: float
    """z of the table top in the base frame, in metres."""
    workspace_in_base: Float[ndarray, "2 3"]
    """Lowest and highest corner of the box that a map should cover, in metres."""
    objects: tuple[TrueObject, ...]


def write_truth(truth: Truth) -> None:
    """Write truth/scene.json of its capture folder."""
    content = {"format": "jcr.truth/1", "depth_unit_m": DEPTH_UNIT_M} | asdict(truth)
    del content["folder"]
    write_text(
        truth.folder / "truth" / "scene.json", json.dumps(content, indent=1, default=np.ndarray.tolist) + "\n"
    )


def write_pixels(
    truth: Truth, image: int, depth: Float[ndarray, "h w"], label: UInt8[ndarray, "h w"]
) -> None:
    """Write the depth (m) of one image as a 16-bit PNG in tenths of millimetres, and its labels as a PNG."""
    counts = np.round(depth / DEPTH_UNIT_M).astype(np.uint16)
    for kind, pixels in (("depth", counts), ("labels", label)):
        file = truth.folder / "truth" / kind / f"{Path(truth.images[image]).stem}.png"
        write_bytes(file, encode_png(pixels))


def read_truth(folder: Path) -> Truth:
    """Read the truth of a capture that `python -m simulation` made; raise FileNotFoundError where there is none."""
    content = json.loads((folder / "truth" / "scene.json").read_text())
    del content["format"], content["depth_unit_m"]
    for name in ("gripper_from_camera", "base_from_gripper", "base_from_camera", "workspace_in_base"):
        content[name] = np.array(content[name], float)
    for name in ("images", "labels"):
        content[name] = tuple(content[name])
    for one in content["objects"]:
        one |= {name: np.array(value, float) for name, value in one.items() if isinstance(value, list)}
    objects = tuple(TrueObject(**one) for one in content["objects"])
    intrinsics = TypeAdapter(Intrinsics).validate_python(content["intrinsics"])
    return Truth(**content | {"folder": folder, "objects": objects, "intrinsics": intrinsics})


def true_depth(truth: Truth, image: int) -> Float[ndarray, "h w"]:
    """Read depth (m) along the optical axis at the pixels of one image; 0 where there is nothing."""
    return _pixels(truth, "depth", image) * DEPTH_UNIT_M


def true_labels(truth: Truth, image: int) -> UInt8[ndarray, "h w"]:
    """Read the labels of the pixels of one image."""
    return _pixels(truth, "labels", image)


def _pixels(truth: Truth, kind: str, image: int) -> ndarray:
    path = truth.folder / "truth" / kind / f"{Path(truth.images[image]).stem}.png"
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise FileNotFoundError(f"{path}: simulate the capture again with --truth full")
    return pixels


@dataclass(frozen=True)
class Surface:
    """Points at all pixels of a simulated capture, and the truth about each."""

    x_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    image: Int[ndarray, " n"]


def true_surface(truth: Truth) -> Surface:
    """Return the surface that the images show; it needs the depth that `--truth scene` leaves out."""
    parts = []
    for k, base_from_camera in enumerate(truth.base_from_camera):
        depth = true_depth(truth, k)
        shown = depth > 0
        with Image.open(truth.folder / truth.images[k]) as image:
            color = np.asarray(image)[shown]
        x_in_base = apply(base_from_camera, depth[shown][:, None] * rays(truth.intrinsics)[shown])
        label = true_labels(truth, k)[shown].astype(np.int64)
        parts.append((x_in_base, color, label, np.full(len(label), k)))
    return Surface(*map(np.concatenate, zip(*parts, strict=True)))


def surface_in_workspace(truth: Truth) -> Surface:
    """Return the surface of table and objects in the workspace that the images show."""
    surface, (low, high) = true_surface(truth), truth.workspace_in_base
    there = (surface.label > 0) & ((surface.x_in_base >= low) & (surface.x_in_base <= high)).all(1)
    return Surface(*(one[there] for one in vars(surface).values()))
