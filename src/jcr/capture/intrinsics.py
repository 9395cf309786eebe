"""Intrinsics from the files of OpenCV, ROS, Kalibr, RealSense, OpenICC and COLMAP, or from a 3x3 matrix."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import HALF_PIXEL
from jcr.capture.documents import read_content, read_tables
from jcr.capture.documents.table import decode_text, read_limited
from jcr.capture.options import ReadOptions
from jcr.capture.readings import numbers_of_table, words_of
from jcr.errors import InputError, shown
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics
from jcr.records.capture_schema import IntrinsicsEntry
from jcr.records.json_file import validated_content

INTRINSICS_NAMES = re.compile(
    r"cam(era)?[_-]?(info|intr|param|calib)|intrin|calib|^ost$|cameras?$|^k$|opencv", re.IGNORECASE
)
"""Names of files that may hold intrinsics."""
CERTAIN = ("camera_info.yaml", "camera_info.yml", "camera_info.json")
"""Names of files that are intrinsics of the capture's camera, whatever size they state."""
MODELS: dict[str, DistortionModel] = {
    "": "pinhole", "plumb_bob": "pinhole", "radtan": "pinhole", "brown_conrady": "pinhole", "opencv": "pinhole",
    "none": "pinhole", "pinhole": "pinhole", "inverse_brown_conrady": "pinhole", "rational_polynomial": "rational",
    "full_opencv": "rational", "rational": "rational", "thin_prism": "thin_prism",
    "equidistant": "fisheye", "equi": "fisheye", "fisheye": "fisheye",
    "opencv_fisheye": "fisheye", "kannala_brandt4": "fisheye",
}  # fmt: skip
"""Distortion models by their names in ROS, Kalibr, librealsense and COLMAP."""
DISTORTION_KEYS = (
    "distortion_coefficients", "dist_coeffs", "distortion_coeffs", "distcoeffs", "coeffs", "distortion", "dist", "d",
)  # fmt: skip
"""Keys of distortion coefficients, the usual ones first."""
SKEW = 1e-4
"""Largest skew, as a share of the focal length, that counts as none: a tenth of a pixel at the edge of an image."""
COLMAP_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Parameters of COLMAP's camera models, in the order of cameras.txt."""


def intrinsics_of_capture(
    folder: Path, documents: Sequence[Path], options: ReadOptions, size: tuple[int, int]
) -> tuple[Intrinsics | None, tuple[str, ...]]:
    """Return the intrinsics for images of `size` (width, height) that a capture's documents state, and notes.

    The file of `options.camera_info` is read; without it, a camera_info.yaml, or the only document that states
    intrinsics for this size. The result is None without one. Raises InputError for an unusable file that was named.
    """
    if options.camera_info is not None:
        return intrinsics_of_file(options.camera_info, size), ()
    for file in documents:
        if file.name.lower() in CERTAIN and file.parent in (folder, folder / "images"):
            return intrinsics_of_file(file, size), ()
    found = dict[Path, Intrinsics]()
    for file in (one for one in documents if INTRINSICS_NAMES.search(one.stem)):
        with suppress(InputError):
            entry = read_intrinsics(file)
            if entry is not None and entry.width is not None:  # else it may be of another camera
                found[file] = entry.record(size, str(file))
    listed = ", ".join(str(file.relative_to(folder)) for file in found)
    if len({str(one) for one in found.values()}) == 1:
        return next(iter(found.values())), (f"intrinsics of {listed}",)
    note = f"intrinsics of {listed} differ and were not used; name one with --camera-info"
    return None, (note,) if found else ()


def intrinsics_of_file(file: Path, size: tuple[int, int]) -> Intrinsics | None:
    """Return the intrinsics of a file for images of `size` (width, height); None if the camera was never calibrated.

    Raises InputError as read_intrinsics, for another size, and for a distortion that folds over within the image.
    """
    entry = read_intrinsics(file)
    return None if entry is None else entry.record(size, f"{file}: intrinsics")


def read_intrinsics(file: Path) -> IntrinsicsEntry | None:
    """Read the first intrinsics of a file; None if the camera was never calibrated.

    Raises InputError for a file without intrinsics, an unknown distortion model, and a skew.
    """
    for entry in _entries(file):
        return intrinsics_entry(entry, str(file)) if entry["fx"] or entry["fy"] else None
    raise InputError(
        f"{file}: no intrinsics were found in it; give those of OpenCV, ROS, Kalibr, RealSense or COLMAP, or a 3x3 "
        "matrix"
    )


def intrinsics_entry(stated: dict[str, Any], where: str) -> IntrinsicsEntry:
    """Return the entry of stated fx, fy, cx, cy, skew, distortion, model by the name of a tool, width, height.

    Raises InputError for what jcr's camera models cannot express.
    """
    model = str(stated.get("model") or "").lower()
    coefficients = [*map(float, stated.get("distortion") or ())]
    if abs(skew := float(stated.get("skew") or 0.0)) > SKEW * abs(stated["fx"]):
        raise InputError(
            f"{where}: a skew of {skew:.4g} px between the axes, which cameras do not have; calibrate without skew, or "
            "leave the intrinsics out: they are estimated"
        )
    known = MODELS.get(model)
    if known is None and not any(coefficients):
        known = "pinhole"
    if model in ("", "opencv", "pinhole") and len(coefficients) > 5:  # other names state the number
        known = "rational"
    if known is None or any(coefficients[len(COEFFICIENTS[known]) :]):
        raise InputError(
            f"{where}: distortion model {shown(model)} with {len(coefficients)} coefficients; jcr knows plumb_bob (5), "
            "rational_polynomial (8) and equidistant (4): use rectified images, or calibrate with one of these"
        )
    if known == "rational" and not any(coefficients[5:]):
        known = "pinhole"
    count = len(COEFFICIENTS[known])
    numbers = {key: float(stated[key]) for key in ("fx", "fy", "cx", "cy")}
    sides = {key: int(stated[key]) for key in ("width", "height") if stated.get(key)}
    distortion = [*coefficients[:count], *[0.0] * (count - len(coefficients))]
    return validated_content(
        IntrinsicsEntry, numbers | sides | {"model": known, "distortion": distortion}, where
    )


def _entries(file: Path) -> Iterator[dict[str, Any]]:
    """Yield the intrinsics that a file may state, in the fields of `intrinsics_entry`."""
    if file.suffix.lower() in (".npy", ".npz", ".mat"):
        yield from _of_matrices(file)
        return
    text = decode_text(file, read_limited(file))
    cells = next((line.split() for line in text.splitlines() if line[:1].isdecimal()), [])
    if len(cells) > 4 and cells[1] in COLMAP_MODELS and len(cells) == 4 + len(COLMAP_MODELS[cells[1]]):
        yield entry_of_colmap(cells[1], [*map(float, cells[2:])])
        return
    if "camera matrix" in text:
        yield from _of_ost(text)
    try:
        content = read_content(file)
    except InputError:
        yield from _of_matrices(file)
        return
    yield from _of_content(content)


def _of_content(content: Any, width: Any = None, height: Any = None) -> Iterator[dict[str, Any]]:
    """Yield the intrinsics in nested data, outer ones first; an outer size applies to what lies below."""
    if isinstance(content, list):
        for part in content[:64]:
            yield from _of_content(part, width, height)
        return
    if not isinstance(content, dict):
        return
    keys = {str(key).lower(): value for key, value in content.items()}
    resolution = keys.get("resolution") or keys.get("image_size") or keys.get("size")
    pair = resolution if isinstance(resolution, list) and len(resolution) == 2 else (None, None)
    width = _first(keys, "image_width", "width", "w") or pair[0] or width
    height = _first(keys, "image_height", "height", "h") or pair[1] or height
    found = _numbers(keys)
    if found is not None:
        yield found | {"width": width, "height": height}
        return
    for part in content.values():
        yield from _of_content(part, width, height)


def _first(keys: dict[str, Any], *names: str) -> Any:
    """Return the value of the first key that is there; None without one."""
    return next((keys[name] for name in names if keys.get(name) is not None), None)


def _numbers(keys: dict[str, Any]) -> dict[str, Any] | None:
    """Return focal lengths, principal point, skew and distortion from one map; None if it has no intrinsics."""
    distortion = _flat(_first(keys, *DISTORTION_KEYS))
    model = _first(keys, "distortion_model", "model")
    made: dict[str, Any] = {"distortion": distortion, "model": model if isinstance(model, str) else ""}
    matrix = _flat(
        _first(keys, "camera_matrix", "k", "intrinsic_matrix", "mtx", "cameramatrix", "intrinsics", "matrix")
    )
    if len(matrix) == 9:
        by_columns = abs(matrix[6]) > 1 and not matrix[2]
        return made | entry_of_matrix(np.array(matrix).reshape(3, 3).T.ravel() if by_columns else matrix)
    if len(matrix) == 4:  # Kalibr
        return made | dict(zip(("fx", "fy", "cx", "cy"), matrix, strict=True))
    fx, fy = _first(keys, "fx", "fl_x", "focal_length", "f"), _first(keys, "fy", "fl_y")
    cx = _first(keys, "cx", "ppx", "principal_pt_x", "principal_point_x")
    cy = _first(keys, "cy", "ppy", "principal_pt_y", "principal_point_y")
    if not all(isinstance(one, float) for one in (fx, cx, cy)):
        return None
    aspect = keys.get("aspect_ratio")
    fy = fy if isinstance(fy, float) else fx * (aspect if isinstance(aspect, float) else 1.0)
    named = [_first(keys, name, f"radial_distortion_{name[1]}" if name[0] == "k" else f"tangential_distortion_{name[1]}")
             for name in COEFFICIENTS["pinhole"]]  # fmt: skip
    if not distortion and any(isinstance(one, float) for one in named):
        made["distortion"] = [one if isinstance(one, float) else 0.0 for one in named]
    return made | {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": keys.get("skew") or 0.0}


def _flat(value: Any) -> list[float]:
    """Return nested lists, or the entry "data" of a map, as a flat list of numbers; empty for other content."""
    if isinstance(value, dict):
        value = next((one for key, one in value.items() if str(key).lower() == "data"), None)
    if not isinstance(value, list):
        return []
    flat = [cell for row in value for cell in (row if isinstance(row, list) else [row])]
    return flat if all(isinstance(cell, float) for cell in flat) else []


def entry_of_matrix(numbers: Sequence[float] | Float[ndarray, "9"]) -> dict[str, Any]:
    """Return the entry (`intrinsics_entry`) of a camera matrix of nine numbers by rows."""
    fx, skew, cx, _, fy, cy, *_ = numbers
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew}


def entry_of_colmap(model: str, numbers: Sequence[float]) -> dict[str, Any]:
    """Return the entry (`intrinsics_entry`) of a camera of COLMAP, whose pixel centres are at half integers.

    `model` is a key of COLMAP_MODELS; `numbers` are width, height and its parameters.
    """
    named = dict(zip(("width", "height", *COLMAP_MODELS[model]), numbers, strict=True))
    focal, fisheye = named.get("f"), model == "OPENCV_FISHEYE"
    centre = {key: named[key] - HALF_PIXEL for key in ("cx", "cy")}
    return {"fx": focal, "fy": focal, **named, **centre} | {
        "distortion": [named.get(name, 0.0) for name in COEFFICIENTS["fisheye" if fisheye else "rational"]],
        "model": "fisheye" if fisheye else "rational_polynomial",
    }


def _of_ost(text: str) -> Iterator[dict[str, Any]]:
    """Yield the intrinsics of ost.txt, which ROS' camera calibrator prints."""
    sections = dict[str, list[float]]()
    name = ""
    for line in text.splitlines():
        words = line.strip().strip("[]").lower()
        if words and not re.match(r"[-+.\d]", words):
            name = words
            continue
        try:
            sections.setdefault(name, []).extend(map(float, line.split()))
        except ValueError:
            return
    matrix = sections.get("camera matrix", [])
    if len(matrix) == 9:
        sides = {side: sections[side][0] for side in ("width", "height") if sections.get(side)}
        yield entry_of_matrix(matrix) | sides | {"distortion": sections.get("distortion", [])}


def _of_matrices(file: Path) -> Iterator[dict[str, Any]]:
    """Yield the intrinsics of the 3x3 matrices of a text or an array file, with five numbers beside as distortion."""
    tables = read_tables(file)
    for table in tables:
        numbers = numbers_of_table(table)
        matrix = numbers.reshape(3, 3) if numbers.size == 9 else np.full((3, 3), np.nan)
        if not np.isfinite(matrix).all() or not np.allclose(matrix[2], (0, 0, 1)) or matrix[0, 0] <= 2:
            continue
        named = [one for one in tables if {"dist", "d", "distortion", "distcoeffs"} & {*words_of(one.place)}]
        distortion = numbers_of_table(named[0]).ravel().tolist() if named else []
        distortion = distortion if len(distortion) in (4, 5, 8) else []
        yield entry_of_matrix(matrix.ravel()) | {"distortion": distortion}
