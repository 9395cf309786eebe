"""The truth of a simulated capture, read from the files beside it, for benches and tests that score against it."""

import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.intrinsics_json import IntrinsicsJson
from jcr.simulate.truth import DEPTH_UNIT_M, TrueObject, Truth


def read_truth(folder: Path) -> Truth:
    """The truth of a capture folder that `jcr simulate` made; FileNotFoundError where there is none."""
    content = json.loads((folder / "truth" / "scene.json").read_text())
    del content["format"], content["depth_unit_m"]
    for name in ("gripper_from_camera", "base_from_gripper", "base_from_camera", "workspace_in_base"):
        content[name] = np.array(content[name], float)
    for name in ("images", "labels"):
        content[name] = tuple(content[name])
    for one in content["objects"]:
        one |= {name: np.array(value, float) for name, value in one.items() if isinstance(value, list)}
    objects = tuple(TrueObject(**one) for one in content["objects"])
    intrinsics = IntrinsicsJson.model_validate(content["intrinsics"]).record()
    return Truth(**content | {"folder": folder, "objects": objects, "intrinsics": intrinsics})


def true_depth(truth: Truth, image: int) -> Float[ndarray, "h w"]:
    """Depth (m) along the optical axis at the pixels of one image; 0 where there is nothing."""
    return _pixels(truth, "depth", image) * DEPTH_UNIT_M


def true_labels(truth: Truth, image: int) -> UInt8[ndarray, "h w"]:
    """Labels of the pixels of one image."""
    return _pixels(truth, "labels", image)


def _pixels(truth: Truth, kind: str, image: int) -> ndarray:
    path = truth.folder / "truth" / kind / f"{Path(truth.images[image]).stem}.png"
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise FileNotFoundError(f"{path}: simulate the capture again with --truth full")
    return pixels
