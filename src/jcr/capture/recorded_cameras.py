"""Further cameras of a recording: which were asked for, and their images beside the frames that were chosen."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8
from numpy import ndarray

from jcr.capture.cell_cameras import MOUNTS
from jcr.capture.checks import image_sizes
from jcr.capture.images import encode_png
from jcr.capture.options import ReadOptions
from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.records import CellCamera, Intrinsics, Mount

ImagesOfRows = Callable[[Int[ndarray, " k"]], Iterator[tuple[int, bytes | UInt8[ndarray, "h w 3"], str]]]
"""Frames of ascending rows, one by one: row, an encoded file's bytes or RGB pixels, and the file's ending."""
IntrinsicsOfSize = Callable[[tuple[int, int]], Intrinsics | None]
"""Intrinsics of images of a size."""
OF_FIXED = 3
"""Images of a fixed camera: more show the same again, fewer may have the arm in the way."""
FOLDER = "cameras"
NOT_ITS_NAME = re.compile(
    r"^(observation\.)?(images?[./])?|[./](color|rgb|image(_raw|_rect|_rect_color|_color)?|compressed)(?=[./]|$)"
)
"""Parts of a topic or key that all cameras have."""


@dataclass(frozen=True)
class RecordedCamera:
    """A camera of a recording beside the one whose frames are chosen."""

    name: str
    mount: Mount
    images_of_rows: ImagesOfRows
    """Images of the rows of the chosen camera's frames, where it has some."""
    intrinsics_of_size: IntrinsicsOfSize


def asked_cameras(options: ReadOptions) -> dict[str, Mount | None]:
    """What --further-cameras names: by topic or key what carries the camera, None where the recording is to tell."""
    asked: dict[str, Mount | None] = {}
    for text in options.further_cameras:
        key, _, given = text.partition("=")
        mount: Mount | None = None
        for known in MOUNTS:
            mount = known if given == known else mount
        if given and mount is None:
            raise InputError(
                f"--further-cameras {text}: write {key}=gripper for a camera on the gripper, {key}=base for a fixed one"
            )
        if key in asked:
            raise InputError(f"--further-cameras {text}: names {key} twice")
        asked[key] = mount
    return asked


def camera_names(keys: Sequence[str]) -> list[str]:
    """Short names of topics or keys, all different: arm_left of /arm/left/image_raw, top of observation.images.top."""
    names: list[str] = []
    for key in keys:
        words = re.sub(r"[^A-Za-z0-9]+", "_", NOT_ITS_NAME.sub("", key.strip("/"))).strip("_")
        name = (words if words[:1].isalpha() else f"camera_{words}".rstrip("_"))[:48]
        same = sum(other == name or other.startswith(f"{name}_again") for other in names)
        names.append(f"{name}_again{same}" if same else name)
    return names


def further_cameras(
    cameras: Sequence[RecordedCamera], rows: Int[ndarray, " n"], names: Sequence[str], into: Path, where: str
) -> tuple[CellCamera, ...]:
    """The cameras with images in the folder `into`: of one on the gripper at each of the chosen `rows` that it has, of
    a fixed one a few; `names` are those of all frames. InputError where one has none, or of several sizes.
    """
    out = []
    for camera in cameras:
        wanted = rows
        if camera.mount == "base":
            wanted = np.unique(rows[np.linspace(0, len(rows) - 1, OF_FIXED).round().astype(int)])
        images, found = [], []
        for row, image, ending in camera.images_of_rows(wanted):
            images.append(f"{FOLDER}/{camera.name}/{names[row]}{ending}")
            found.append(row)
            write_bytes(into / images[-1], image if isinstance(image, bytes) else encode_png(image))
        if not images:
            raise InputError(
                f"{where}: camera {camera.name} has no image of a moment at which the frames were taken; leave it out"
            )
        sizes = set(image_sizes(into, images))
        if len(sizes) > 1:
            raise InputError(
                f"{where}: the images of camera {camera.name} are of several sizes; leave it out"
            )
        (size,) = sizes
        frame = np.searchsorted(rows, found) if camera.mount == "gripper" else None
        intrinsics = camera.intrinsics_of_size(size)
        out.append(
            CellCamera(
                name=camera.name,
                mount=camera.mount,
                images=tuple(images),
                image_size=size,
                intrinsics=intrinsics,
                frame=frame,
            )
        )
    return tuple(out)
