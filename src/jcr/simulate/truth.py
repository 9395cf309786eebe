"""The truth beside a simulated capture: written by the simulation, read by whoever scores against it."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.files import write_text
from jcr.geometry import apply
from jcr.records import Intrinsics
from jcr.simulate.scenes import Scene

DEPTH_UNIT_M = 1e-4
"""Metres per count in the 16-bit depth images."""


@dataclass(frozen=True)
class TrueObject:
    """One object of the scene as it is."""

    name: str
    label: int
    height: float
    """Of its highest point above the table, in metres."""
    footprint_in_base: Float[ndarray, "k 2"]
    """Convex outline seen from straight above, in metres."""
    base_from_box: Float[ndarray, "4 4"]
    """Centre and axes of the smallest upright box around it."""
    box_size: Float[ndarray, "3"]
    """In metres along the axes of that box."""


@dataclass(frozen=True)
class Truth:
    """What a simulated capture should be found to show."""

    folder: Path
    scene: str
    images: tuple[str, ...]
    """As in capture.json."""
    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]
    """Without the robot's noise."""
    base_from_camera: Float[ndarray, "n 4 4"]
    intrinsics: Intrinsics
    labels: tuple[str, ...]
    """Name per label; 0 is nothing of the scene, 1 the table."""
    table_height: float
    """z of the table top in the base frame, in metres."""
    workspace_in_base: Float[ndarray, "2 3"]
    """Lowest and highest corner of the box that a map should cover."""
    objects: tuple[TrueObject, ...]


def write_truth(
    out: Path,
    scene: Scene,
    images: list[str],
    intrinsics: Intrinsics,
    gripper_from_camera: Float[ndarray, "4 4"],
    base_from_gripper: Float[ndarray, "n 4 4"],
) -> None:
    """Write truth/scene.json of a capture folder."""
    objects = []
    for label, thing in enumerate(scene.objects, start=2):
        around = thing.oriented_box
        objects.append(
            {
                "name": thing.name,
                "label": label,
                "height": thing.height,
                "footprint_in_base": thing.footprint_in_base.tolist(),
                "base_from_box": around.base_from_box.tolist(),
                "box_size": around.size.tolist(),
            }
        )
    content = {
        "format": "jcr.truth/1",
        "scene": scene.name,
        "images": images,
        "gripper_from_camera": gripper_from_camera.tolist(),
        "base_from_gripper": base_from_gripper.tolist(),
        "base_from_camera": (base_from_gripper @ gripper_from_camera).tolist(),
        "intrinsics": asdict(intrinsics),
        "labels": list(scene.labels),
        "table_height": scene.table_height,
        "workspace_in_base": scene.workspace_in_base.tolist(),
        "objects": objects,
        "depth_unit_m": DEPTH_UNIT_M,
    }
    write_text(out / "truth" / "scene.json", json.dumps(content, indent=1) + "\n")


def read_truth(folder: Path) -> Truth:
    """The truth of a simulated capture folder; InputError where there is none."""
    path = folder / "truth" / "scene.json"
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path}: not found; only folders made by jcr simulate have the truth") from None
    camera = content["intrinsics"]
    return Truth(
        folder=folder,
        scene=content["scene"],
        images=tuple(content["images"]),
        gripper_from_camera=np.array(content["gripper_from_camera"]),
        base_from_gripper=np.array(content["base_from_gripper"]),
        base_from_camera=np.array(content["base_from_camera"]),
        intrinsics=Intrinsics(**camera | {"distortion": tuple(camera["distortion"])}),
        labels=tuple(content["labels"]),
        table_height=content["table_height"],
        workspace_in_base=np.array(content["workspace_in_base"]),
        objects=tuple(
            TrueObject(
                name=thing["name"],
                label=thing["label"],
                height=thing["height"],
                footprint_in_base=np.array(thing["footprint_in_base"]),
                base_from_box=np.array(thing["base_from_box"]),
                box_size=np.array(thing["box_size"]),
            )
            for thing in content["objects"]
        ),
    )


def true_depth(truth: Truth, image: int) -> Float[ndarray, "h w"]:
    """Depth along the optical axis at every pixel of one image, in metres; 0 where there is nothing."""
    return _read(truth, "depth", image) * DEPTH_UNIT_M


def true_labels(truth: Truth, image: int) -> UInt8[ndarray, "h w"]:
    """Label of every pixel of one image."""
    return _read(truth, "labels", image)


def truth_points(folder: Path) -> tuple[Float[ndarray, "n 3"], Int[ndarray, "n"]]:
    """The visible surface in the base frame: points (n,3) m of all images' pixels, and their labels (n,).

    Only the table and the objects, within the workspace box. InputError without depth images (`--truth scene`).
    """
    truth = read_truth(folder)
    camera = truth.intrinsics
    x, y = np.meshgrid(
        (np.arange(camera.width) - camera.cx) / camera.fx, (np.arange(camera.height) - camera.cy) / camera.fy
    )
    rays_in_camera = np.stack([x, y, np.ones_like(x)], -1)
    points, labels = [], []
    for k in range(len(truth.images)):
        label = true_labels(truth, k)
        seen = label > 0
        points.append(
            apply(truth.base_from_camera[k], rays_in_camera[seen] * true_depth(truth, k)[seen][:, None])
        )
        labels.append(label[seen].astype(np.int64))
    points_in_base, label = np.concatenate(points), np.concatenate(labels)
    low, high = truth.workspace_in_base
    inside = ((points_in_base >= low) & (points_in_base <= high)).all(1)
    return points_in_base[inside], label[inside]


def _read(truth: Truth, kind: str, image: int) -> ndarray:
    path = truth.folder / "truth" / kind / f"{Path(truth.images[image]).stem}.png"
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path}: not readable; simulate again with --truth full")
    return picture
