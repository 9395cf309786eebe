"""COLMAP models with their images, and a table of gripper poses.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5) and stores camera_from_world.
"""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import HALF_PIXEL
from jcr.capture.formats import table
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, validated_content
from jcr.errors import InputError
from jcr.geometry import inverse, transform
from jcr.records import COEFFICIENTS, Capture, DistortionModel, Intrinsics
from jcr.records.capture_json import IntrinsicsEntry

if TYPE_CHECKING:
    import pycolmap

_PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap")
_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
"""Camera models of COLMAP that a distortion model of jcr can represent."""


def find_model(path: Path) -> Path | None:
    """Return the folder of the COLMAP model at a path or in a subfolder such as sparse/0; None if there is none."""
    files = (path / place / f"cameras.{end}" for place in _PLACES for end in ("bin", "txt"))
    return next((file.parent for file in files if file.is_file()), None)


def recognises(path: Path) -> bool:
    """Test whether a path is the folder of a COLMAP model or contains one."""
    return find_model(path) is not None


def read(path: Path, options: ReadOptions) -> Capture:
    """Read the images that have both a camera pose in the COLMAP model at a path and a gripper pose in a table.

    The table of gripper poses is read with `options`, as by `table.read`. Intrinsics and camera poses are those of the
    model; the field `cameras` names its folder. Raises InputError if there is no such image.
    """
    folder = find_model(path)
    if folder is None:
        raise InputError(f"{path}: holds no COLMAP model (cameras.bin or .txt, images, points3D)")
    root = next((parent for parent in (path, *folder.parents[:3]) if (parent / "images").is_dir()), path)
    names, _ = read_registered_cameras(folder)
    name_of = dict[str, str]()
    """Names of the images in the model, by the paths of their files."""
    for name in names:
        beside = f"images/{name}"
        name_of[beside if contained(root, beside, str(folder)).is_file() else name] = name
    whole = table.read(root, options)
    rows = [k for k, name in enumerate(whole.images) if name in name_of]
    if not rows:
        first = next(iter(name_of))
        raise InputError(
            f"{whole.source}: lists none of the model's images; it lists {whole.images[0]}, the model {first}"
        )
    capture, notes = whole.of_rows(rows), whole.notes
    if unknown := len(name_of) - len(rows):
        notes = (f"{unknown} of {len(name_of)} images of the model have no gripper pose: left out", *notes)
    return replace(
        capture,
        intrinsics=read_intrinsics(folder, whole.image_size, {name_of[name] for name in capture.images}),
        source=folder,
        cameras=folder,
        notes=notes,
    )


def read_model(folder: Path) -> "pycolmap.Reconstruction":
    """Read a COLMAP model; raise InputError if it cannot be read."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        return pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap passes on C++ exceptions of many types
        reason = str(error).strip().splitlines()[-1:] or ["damaged"]
        raise InputError(f"{folder}: not a readable COLMAP model ({reason[0]}); export it again") from None
    finally:
        pycolmap.logging.minloglevel = before


def read_registered_cameras(folder: Path) -> tuple[list[str], Float[ndarray, "n 4 4"]]:
    """Read the names of the n registered images of a COLMAP model, sorted, and recon_from_camera (n,4,4) of each.

    The recon frame is the model's world frame, in its unit. Raises InputError if no image is registered.
    """
    model = read_model(folder)
    images = sorted((model.image(k) for k in model.reg_image_ids()), key=lambda image: image.name)
    if not images:
        raise InputError(f"{folder}: the COLMAP model has no registered image")
    motions = [image.cam_from_world() for image in images]
    camera_from_recon = [transform(motion.rotation.matrix(), motion.translation) for motion in motions]
    return [image.name for image in images], inverse(np.stack(camera_from_recon))


def read_intrinsics(folder: Path, size: tuple[int, int], names: Collection[str] | None = None) -> Intrinsics:
    """Return the intrinsics that all registered images of a COLMAP model share, or all registered images in `names`.

    Pixel (0, 0) is the centre of the top-left pixel, unlike in the model. Raises InputError if intrinsics differ, are
    for images of another size than `size` (width, height), or have a distortion model that jcr does not support.
    """
    model = read_model(folder)
    images = [model.image(k) for k in model.reg_image_ids()]
    cameras = [model.camera(one.camera_id) for one in images if names is None or one.name in names]
    kinds = {(c.model.name, c.params_info, c.width, c.height, *map(float, c.params)) for c in cameras}
    if len(kinds) != 1:
        raise InputError(
            f"{folder}: {len(kinds)} different cameras; reconstruct with a single camera (--ImageReader.single_camera)"
        )
    ((name, names_of_params, width, height, *params),) = kinds
    if name not in _MODELS:
        raise InputError(f"{folder}: unknown camera model {name}; run colmap image_undistorter")
    value = dict(zip(names_of_params.split(", "), params, strict=True))
    kind: DistortionModel = "fisheye" if "FISHEYE" in name else "rational" if any(params[9:]) else "pinhole"
    value = {"fx": value.get("f"), "fy": value.get("f"), "k1": value.get("k", 0.0)} | value
    entry = {"fx": value["fx"], "fy": value["fy"], "width": width, "height": height, "model": kind}
    entry |= {key: value[key] - HALF_PIXEL for key in ("cx", "cy")}
    entry["distortion"] = [value.get(key, 0.0) for key in COEFFICIENTS[kind]]
    return validated_content(IntrinsicsEntry, entry, str(folder)).record(size, f"{folder}: cameras")
