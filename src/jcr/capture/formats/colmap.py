"""COLMAP models with their images, beside a table of gripper poses.

COLMAP has the centre of the top-left pixel at (0.5, 0.5) and stores camera from world.
"""

import struct
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import HALF_PIXEL
from jcr.capture.camera_info import IntrinsicsEntry
from jcr.capture.formats import Format, table
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, validated
from jcr.errors import InputError
from jcr.geometry import inverse, transform
from jcr.records import COEFFICIENTS, Capture, DistortionModel, Intrinsics

if TYPE_CHECKING:
    import pycolmap

_PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap")
_COEFFICIENTS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": COEFFICIENTS["rational"],
    "OPENCV_FISHEYE": COEFFICIENTS["fisheye"],
}
"""Coefficients in the parameters of the known camera models of COLMAP."""


def find_model(path: Path) -> Path | None:
    """Return the folder of a COLMAP model in or at a folder; None where there is none."""
    places = [path / place for place in _PLACES]
    return next(
        (place for place in places if any((place / f"cameras.{end}").is_file() for end in ("bin", "txt"))),
        None,
    )


def read(path: Path, options: ReadOptions) -> Capture:
    """Read the images that a COLMAP model and a table of gripper poses both know."""
    folder = find_model(path)
    if folder is None:
        raise InputError(f"{path}: holds no COLMAP model (cameras.bin or .txt, images, points3D)")
    root = next((parent for parent in (path, *folder.parents[:3]) if (parent / "images").is_dir()), path)
    model = read_model(folder)
    names, _ = _posed(model, folder)
    located = []
    for name in names:
        beside = f"images/{name}"
        located.append(beside if contained(root, beside, str(folder)).is_file() else name)
    whole = table.read(root, options)
    rows = [k for k, name in enumerate(whole.images) if name in located]
    if not rows:
        raise InputError(
            f"{whole.source}: lists none of the model's images; it lists {whole.images[0]}, the model {located[0]}"
        )
    images = tuple(whole.images[k] for k in rows)
    notes = whole.notes
    if unknown := len(located) - len(rows):
        notes = (f"{unknown} of {len(located)} images of the model have no gripper pose: left out", *notes)
    return replace(
        whole,
        images=images,
        base_from_gripper=whole.base_from_gripper[rows],
        depths=None if whole.depths is None else tuple(whole.depths[k] for k in rows),
        intrinsics=_common_intrinsics(
            model, {names[located.index(name)] for name in images}, folder, whole.image_size
        ),
        source=folder,
        cameras=folder,
        notes=notes,
    )


def read_model(folder: Path) -> "pycolmap.Reconstruction":
    """Read a model; InputError when it cannot be read."""
    import pycolmap

    for name, check in (("images.bin", _check_images), ("points3D.bin", _check_points)):
        if (folder / name).is_file():
            try:
                check((folder / name).read_bytes())
            except (struct.error, ValueError):
                raise InputError(
                    f"{folder / name}: cut short or damaged; export the COLMAP model again"
                ) from None
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        return pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises whatever its C++ threw
        reason = str(error).strip().splitlines()[-1:] or ["damaged"]
        raise InputError(f"{folder}: not a readable COLMAP model ({reason[0]}); export it again") from None
    finally:
        pycolmap.logging.minloglevel = before


def _check_images(data: bytes) -> None:
    """Raise where counts lead past the end: COLMAP would read on for minutes. Layout: colmap.github.io/format."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        name = at + 64  # after its number, a rotation, a translation, the camera's number
        at = data.index(b"\0", name) + 1
        data[name:at].decode()
        at += 8 + 24 * struct.unpack_from("<Q", data, at)[0]
    _check_end(data, at)


def _check_points(data: bytes) -> None:
    """Raise where the counts of points and their tracks lead past the end."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
    _check_end(data, at)


def _check_end(data: bytes, at: int) -> None:
    """Raise where the counts of a file do not lead to its end."""
    if at != len(data):
        raise ValueError("counts do not lead to the end")


def read_cameras(folder: Path) -> tuple[list[str], Float[ndarray, "n 4 4"]]:
    """Read the names of the registered images, in order, and their recon_from_camera (n,4,4)."""
    return _posed(read_model(folder), folder)


def _posed(model: "pycolmap.Reconstruction", folder: Path) -> tuple[list[str], Float[ndarray, "n 4 4"]]:
    """Return the names of the registered images, in order, and their recon_from_camera (n,4,4)."""
    images = sorted((model.image(k) for k in model.reg_image_ids()), key=lambda image: image.name)
    if not images:
        raise InputError(f"{folder}: the COLMAP model has no registered image")
    motions = [image.cam_from_world() for image in images]
    camera_from_recon = [transform(motion.rotation.matrix(), motion.translation) for motion in motions]
    return [image.name for image in images], inverse(np.stack(camera_from_recon))


def read_intrinsics(folder: Path, size: tuple[int, int]) -> Intrinsics:
    """Read the intrinsics of all images of the given size; InputError when there are several, or unknown ones."""
    model = read_model(folder)
    return _common_intrinsics(model, set(_posed(model, folder)[0]), folder, size)


def _common_intrinsics(
    model: "pycolmap.Reconstruction", names: set[str], folder: Path, size: tuple[int, int]
) -> Intrinsics:
    """Return the intrinsics that the images of the names share; InputError where they differ."""
    images = [image for k in model.reg_image_ids() if (image := model.image(k)).name in names]
    cameras = [model.camera(image.camera_id) for image in images]
    kinds = {
        (camera.model.name, camera.width, camera.height, *map(float, camera.params)) for camera in cameras
    }
    if len(kinds) > 1:
        raise InputError(
            f"{folder}: {len(kinds)} different cameras; reconstruct with a single camera (--ImageReader.single_camera)"
        )
    return _intrinsics(cameras[0], folder, size)


def _intrinsics(camera: "pycolmap.Camera", folder: Path, size: tuple[int, int]) -> Intrinsics:
    """Return the intrinsics of a camera of a model; InputError for another size or an unknown model."""
    name, width, height, params = camera.model.name, camera.width, camera.height, [*map(float, camera.params)]
    if name not in _COEFFICIENTS:
        raise InputError(
            f"{folder}: camera model {name}, which jcr does not know; run colmap image_undistorter"
        )
    two_focals = name in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
    focals, rest = (params[:2], params[2:]) if two_focals else (params[:1] * 2, params[1:])
    value = dict(zip(_COEFFICIENTS[name], rest[2:], strict=True))
    model: DistortionModel = "fisheye" if "FISHEYE" in name else "rational" if any(rest[7:]) else "pinhole"
    entry = {
        "fx": focals[0],
        "fy": focals[1],
        "cx": rest[0] - HALF_PIXEL,
        "cy": rest[1] - HALF_PIXEL,
        "distortion": [value.get(key, 0.0) for key in COEFFICIENTS[model]],
        "model": model,
        "width": width,
        "height": height,
    }
    return validated(IntrinsicsEntry, entry, str(folder)).record(size, f"{folder}: cameras")


FORMAT = Format(
    name="colmap",
    about="a COLMAP model and gripper poses",
    recognises=lambda path: find_model(path) is not None,
    read=read,
)
