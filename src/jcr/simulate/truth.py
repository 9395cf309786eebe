"""The truth beside a simulated capture: written by the simulation, read by whoever scores against it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr.capture.images import encode_png
from jcr.capture.plain_files import first_fault, read_json
from jcr.errors import InputError
from jcr.files import read_bytes, write_bytes, write_text
from jcr.intrinsics_json import IntrinsicsJson
from jcr.records import Intrinsics
from jcr.simulate.bent_arm import BentArm

_DEPTH_UNIT_M = 1e-4
"""Metres per count of the 16-bit depth images."""
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]
Numbers3 = Annotated[list[float], Field(min_length=3, max_length=3)]


@dataclass(frozen=True)
class TrueObject:
    """One object of the scene as it is."""

    name: str
    label: int
    height: float
    """Of its highest point above the table, in metres."""
    footprint_in_base: Float[ndarray, "k 2"]
    """Convex outline seen from straight above: x and y in metres."""
    base_from_box: Float[ndarray, "4 4"]
    """Centre and axes of the smallest upright box around it, z up."""
    box_size: Float[ndarray, "3"]
    """Along the axes of that box, in metres."""


@dataclass(frozen=True)
class Truth:
    """What a simulated capture should be found to show."""

    folder: Path
    """Of the capture."""
    scene: str
    seed: int
    """Of the scene: `make_scene` makes its meshes again."""
    images: tuple[str, ...]
    """As in capture.json."""
    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Where the gripper was, whatever the robot reported."""
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
    content = {"format": "jcr.truth/1", "depth_unit_m": _DEPTH_UNIT_M} | asdict(truth)
    del content["folder"]
    write_text(_folder(truth) / "scene.json", json.dumps(content, indent=1, default=np.ndarray.tolist) + "\n")


def write_robot(truth: Truth, bent: BentArm, joints: Float[ndarray, "n dof"]) -> None:
    """Write truth/robot.json: the errors of the arm that carried the camera, by name in m and rad."""
    content = {
        "format": "jcr.robot_truth/1",
        "robot": bent.arm.name,
        "joints": joints.tolist(),
        "errors": bent.named_errors(),
        "reported_base_from_gripper": bent.reported(joints).tolist(),
        "base_from_gripper": truth.base_from_gripper.tolist(),
    }
    write_text(_folder(truth) / "robot.json", json.dumps(content, indent=1) + "\n")


def read_truth(folder: Path) -> Truth:
    """The truth of a simulated capture folder; InputError where there is none."""
    path = folder / "truth" / "scene.json"
    if not path.is_file():
        raise InputError(f"{path}: not found; only captures made by jcr simulate have the truth")
    read_json(path)  # says what is no JSON
    try:
        content = _Content.model_validate_json(read_bytes(path), strict=True)
    except ValidationError as error:
        raise InputError(f"{path}: {first_fault(error)}; simulate the capture again") from None
    parts = {name: value for name, value in vars(content).items() if name not in ("format", "depth_unit_m")}
    for name in ("gripper_from_camera", "base_from_gripper", "base_from_camera", "workspace_in_base"):
        parts[name] = np.array(parts[name], float)
    for name in ("images", "labels"):
        parts[name] = tuple(parts[name])
    things = tuple(
        TrueObject(
            thing.name,
            thing.label,
            thing.height,
            np.array(thing.footprint_in_base, float),
            np.array(thing.base_from_box, float),
            np.array(thing.box_size, float),
        )
        for thing in content.objects
    )
    return Truth(**parts | {"folder": folder, "objects": things, "intrinsics": content.intrinsics.record()})


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Thing(_Part):
    name: str
    label: int
    height: float
    footprint_in_base: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=3)
    ]
    base_from_box: Matrix
    box_size: Numbers3


class _Content(_Part):
    format: str
    depth_unit_m: float
    scene: str
    seed: int
    images: list[str]
    gripper_from_camera: Matrix
    base_from_gripper: Annotated[list[Matrix], Field(min_length=1)]
    base_from_camera: Annotated[list[Matrix], Field(min_length=1)]
    intrinsics: IntrinsicsJson
    labels: list[str]
    table_height: float
    workspace_in_base: Annotated[list[Numbers3], Field(min_length=2, max_length=2)]
    objects: list[_Thing]


def write_depth(truth: Truth, image: int, depth: Float[ndarray, "h w"]) -> None:
    """Write the depth (m) of one image as a 16-bit PNG in tenths of millimetres."""
    _write(_path(truth, "depth", image), np.round(depth / _DEPTH_UNIT_M).astype(np.uint16))


def write_labels(truth: Truth, image: int, label: UInt8[ndarray, "h w"]) -> None:
    """Write the labels of one image as a PNG."""
    _write(_path(truth, "labels", image), label)


def true_depth(truth: Truth, image: int) -> Float[ndarray, "h w"]:
    """Depth along the optical axis at the pixels of one image, in metres; 0 where there is nothing."""
    return _read(_path(truth, "depth", image)) * _DEPTH_UNIT_M


def true_labels(truth: Truth, image: int) -> UInt8[ndarray, "h w"]:
    """Labels of the pixels of one image."""
    return _read(_path(truth, "labels", image))


def _folder(truth: Truth) -> Path:
    return truth.folder / "truth"


def _path(truth: Truth, kind: str, image: int) -> Path:
    return _folder(truth) / kind / f"{Path(truth.images[image]).stem}.png"


def _write(path: Path, pixels: ndarray) -> None:
    write_bytes(path, encode_png(pixels))


def _read(path: Path) -> ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if pixels is None:
        raise InputError(f"{path}: not readable; simulate the capture again with --truth full")
    return pixels
