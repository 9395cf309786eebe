"""Fixed cameras that are added to a run after its calibration; their images are copied to the run folder."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jcr.capture.formats.capture_json import camera_entries, with_cameras
from jcr.capture.images import read_image, require_unlike, size_of_all
from jcr.capture.intrinsics import intrinsics_of_file
from jcr.errors import InputError
from jcr.files import path_inside, read_bytes, write_bytes, write_text
from jcr.records import Capture, CellCamera
from jcr.records.capture_schema import NAME
from jcr.records.json_file import read_json

FOLDER, FILE = "cameras", "cameras.json"
"""Folder of the added cameras' images in the run folder, and the file of the cameras in it."""


def read_added_cameras(run_folder: Path, capture: Capture) -> tuple[CellCamera, ...]:
    """Read the cameras that were added to a finished run; raise InputError if their file or an image is damaged."""
    folder = run_folder / FOLDER
    if not (folder / FILE).is_file():
        return ()
    alone = replace(capture, folder=folder, others=())
    content = read_json(folder / FILE)
    if not isinstance(content, dict) or not content:
        raise InputError(
            f"{folder / FILE}: damaged; remove {folder}, and add the cameras again (jcr add-camera)"
        )
    read = with_cameras(alone, content, str(folder / FILE))
    return tuple(replace(camera, folder=folder) for camera in read.others)


def added_camera(
    name: str,
    files: Sequence[Path],
    intrinsics: Path | None,
    capture: Capture,
    taken: Sequence[str],
    folder: Path,
) -> CellCamera:
    """Return a fixed camera with images copied to `folder`; raise InputError if the files cannot be of one camera.

    `files` are image files, none of which may be an image of the run's `capture`. `intrinsics` is a file of intrinsics.
    `taken` are the names of the other cameras.
    """
    if not re.fullmatch(NAME, name):
        raise InputError(f"--name {name}: a name has letters, digits and _, and begins with a letter")
    if name in taken:
        raise InputError(f"--name {name}: the cell has a camera of that name; choose another")
    pixels = {str(file): read_image(file) for file in files}
    size = size_of_all({file: image.shape[1::-1] for file, image in pixels.items()}, f"--name {name}")
    if size == capture.image_size:
        own = ((image, read_image(capture.folder / image)) for image in capture.images)
        require_unlike(pixels, own, "the run's capture")
    known = None if intrinsics is None else intrinsics_of_file(intrinsics, size)
    # Messages name the copies, so they have the names of the user's files.
    names = [re.sub(r"[^\w.() -]", "_", file.name) for file in files]
    is_unique = len({one.casefold() for one in names}) == len(names)
    images = tuple(f"{name}/{'' if is_unique else f'{k:03d}_'}{one}" for k, one in enumerate(names))
    for image, file in zip(images, files, strict=True):
        write_bytes(folder / image, file.read_bytes())
    return CellCamera(
        name=name, mount="base", images=images, image_size=size, intrinsics=known, folder=folder
    )


def keep_camera(run_folder: Path, capture: Capture, camera: CellCamera) -> None:
    """Add the camera to the run folder: copy its images and write its entry to the file of added cameras."""
    folder = run_folder / FOLDER
    for image in camera.images:
        copy = path_inside(folder, image, str(folder))
        write_bytes(copy, read_bytes((camera.folder or capture.folder) / image))
    every = (*read_added_cameras(run_folder, capture), camera)
    entries = camera_entries(replace(capture, others=every))
    del entries[capture.camera_name]
    content = {name: entry.model_dump(mode="json", exclude_unset=True) for name, entry in entries.items()}
    write_text(folder / FILE, json.dumps(content, indent=1) + "\n")
