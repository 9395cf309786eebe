"""Images added to a run after its calibration: copies of them in the run folder, with their gripper poses."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.checks import check_metres, read_rigid
from jcr.capture.images import read_image
from jcr.capture.plain_files import contained, is_written, read_json, read_npy, shown
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.records import Capture

FOLDER, FILE = "added", "added.json"


def read_added(run_folder: Path, capture: Capture) -> Capture:
    """The images added to a run of the capture so far, oldest first; none where nothing was added.

    Raises InputError where one is gone, or where they were added to the run of another capture.
    """
    folder = run_folder / FOLDER
    file = folder / FILE
    if not is_written(file):
        return replace(capture, folder=folder, images=(), base_from_gripper=np.zeros((0, 4, 4)), joints=None)
    content = read_json(file)
    try:
        whose, frames = content["capture"], content["frames"]
        names = tuple(str(frame["image"]) for frame in frames)
        matrices = [frame["base_from_gripper"] for frame in frames]
    except (KeyError, TypeError, IndexError):
        raise InputError(
            f"{file}: damaged; remove {folder}, and add the images again (jcr map --add)"
        ) from None
    if whose != str(capture.folder.resolve()):
        raise InputError(
            f"{folder}: holds images added to the run of {shown(whose)}; choose another folder for this run, or remove "
            f"{folder}"
        )
    for name in names:
        if not contained(folder, name, str(file)).is_file():
            raise InputError(f"{folder / name}: an added image is gone; put it back, or remove {folder}")
    poses = [read_rigid(matrix, f"{file}: {name}") for name, matrix in zip(names, matrices, strict=True)]
    poses = np.array(poses).reshape(-1, 4, 4)
    return replace(capture, folder=folder, images=names, base_from_gripper=poses, joints=None)


def with_images(added: Capture, images_and_poses: Sequence[tuple[Path, Path]]) -> Capture:
    """More images, copied beside the others; `write_added` makes them part of the run.

    Raises InputError for an image or pose that cannot be read, is in millimetres, of another size than the
    capture's, or there already.
    """
    names, poses = list(added.images), list(added.base_from_gripper)
    known = {(added.folder / name).read_bytes() for name in names}
    for image, pose in images_and_poses:
        pixels = read_image(image)
        size = pixels.shape[1], pixels.shape[0]
        if size != added.image_size:
            raise InputError(
                f"{image}: {size[0]}x{size[1]} pixels, but the capture has "
                f"{added.image_size[0]}x{added.image_size[1]}; take it with the same camera and resolution"
            )
        content = image.read_bytes()
        if content in known:
            raise InputError(f"{image}: this image was added before; take a new one")
        known.add(content)
        base_from_gripper = read_pose(pose)
        names.append(f"{len(names):03d}{image.suffix.lower()}")
        poses.append(base_from_gripper)
        write_bytes(added.folder / names[-1], content)
    return replace(added, images=tuple(names), base_from_gripper=np.array(poses).reshape(-1, 4, 4))


def write_added(added: Capture, capture: Capture) -> None:
    """Make the images part of the run, so that each later map has them."""
    frames = [
        {"image": name, "base_from_gripper": pose.tolist()}
        for name, pose in zip(added.images, added.base_from_gripper, strict=True)
    ]
    content = {"capture": str(capture.folder.resolve()), "frames": frames}
    write_text(added.folder / FILE, json.dumps(content, indent=1) + "\n")


def read_pose(path: Path) -> Float[ndarray, "4 4"]:
    """base_from_gripper (4,4) from .json (rows, or a frame with base_from_gripper), .npy, or text of 16 numbers."""
    if not path.is_file():
        raise InputError(f"{path}: no such pose file (base_from_gripper, 4x4, as .json, .npy or text)")
    try:
        if path.suffix == ".npy":
            value = read_npy(path)
        elif path.suffix == ".json":
            value = read_json(path)
            value = value["base_from_gripper"] if isinstance(value, dict) else value
        else:
            value = np.array(path.read_text("utf-8").replace(",", " ").split(), float)
            value = value.reshape(4, 4) if value.size == 16 else value
    except InputError:
        raise
    except (KeyError, ValueError, OSError, EOFError) as error:
        raise InputError(
            f"{path}: cannot be read as a pose ({error}); give base_from_gripper, 4x4 in metres"
        ) from None
    matrix = read_rigid(value, str(path))
    check_metres(matrix[None], str(path))
    return matrix
