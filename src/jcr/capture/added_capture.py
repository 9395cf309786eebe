"""Images that are added to a run after its calibration: a capture folder inside the run folder."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from jcr.capture.folder import require_decided
from jcr.capture.formats import capture_json
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.errors import InputError, other_size, shown
from jcr.files import path_inside, write_bytes
from jcr.records import Capture
from jcr.records.json_file import read_json

FOLDER, OWNER = "added", "added_to"


def read_added(run_folder: Path, capture: Capture) -> Capture:
    """Return the images added to a run by `jcr map --add`, oldest first, as a capture; without images if none was added.

    `capture` is the run's own capture. Raises InputError if an image file is missing, or if the images in `run_folder`
    were added to a run of another capture.
    """
    folder = run_folder / FOLDER
    file = folder / capture_json.FILE
    if not file.is_file():
        none, size, known = np.zeros((0, 4, 4)), capture.image_size, capture.intrinsics
        return Capture(folder=folder, images=(), base_from_gripper=none, image_size=size, intrinsics=known)
    added, owner = capture_json.read(folder), read_json(file).get(OWNER)
    if owner != str(capture.folder.resolve()):
        raise InputError(
            f"{folder}: holds images added to the run of {shown(owner)}; choose another folder or remove it"
        )
    return added


def with_added_images(added: Capture, path: Path, options: ReadOptions | None = None) -> Capture:
    """Return the capture `added` (images added to a run) extended by the images and poses of the capture at `path`.

    The image files are copied into the folder of `added`; its capture.json changes only in `write_added`. Raises
    InputError for images of another size than the run's, and for images that were added before.
    """
    with tempfile.TemporaryDirectory(prefix="jcr-added-") as scratch:
        new = require_decided(read_capture(path, options, into=scratch, at_least=1))
        if new.image_size != added.image_size:
            raise other_size(f"{path}: images", new.image_size, added.image_size, "the run has images")
        names = list(added.images)
        known = {(added.folder / name).read_bytes() for name in names}
        for image in new.images:
            content = (new.folder / image).read_bytes()
            if content in known:
                raise InputError(f"{new.folder / image}: this image was added before; take a new one")
            known.add(content)
            names.append(f"{len(names):03d}{Path(image).suffix.lower()}")
            write_bytes(path_inside(added.folder, names[-1], str(added.folder)), content)
    poses = np.concatenate([added.base_from_gripper, new.base_from_gripper])
    return replace(added, images=tuple(names), base_from_gripper=poses)


def write_added(added: Capture, capture: Capture) -> None:
    """Write the capture.json of the images `added` to the run of `capture`, so that later maps of the run use them."""
    capture_json.write(added.folder, added, **{OWNER: str(capture.folder.resolve())})
