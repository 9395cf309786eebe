"""cloud.ply: a PointCloud on disk, as a PLY file that others open too."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jcr.errors import InputError
from jcr.files import read_bytes, write_bytes
from jcr.records import PointCloud

_VERTEX = np.dtype(
    [(axis, "<f4") for axis in "xyz"]
    + [(channel, "|u1") for channel in ("red", "green", "blue")]
    + [("label", "<i4"), ("confidence", "<f4"), ("margin", "<f4"), ("image", "<i4")]
)
_DENSE = [("reason", "|u1"), ("depth_std", "<f4")]
"""Further properties of clouds with a reason and a standard deviation (m) for each depth."""
_PLY_TYPES = {"f4": "float", "u1": "uchar", "i4": "int"}


def write_cloud(path: Path, cloud: PointCloud, notes: Mapping[str, str] | None = None) -> None:
    """Write points with colour, label, confidence, margin (m) and image as binary PLY.

    The header's comments name the labels and the camera centres, so that `read_cloud` gives all of it back;
    `notes`, each of one line, are added to them.
    """
    further = [(name, kind) for name, kind in _DENSE if getattr(cloud, name) is not None]
    vertices = np.empty(len(cloud.points_in_base), [*_VERTEX.descr, *further])
    for name, column in zip("xyz", cloud.points_in_base.T, strict=True):
        vertices[name] = column
    for name, column in zip(("red", "green", "blue"), cloud.color.T, strict=True):
        vertices[name] = column
    for name in ("label", "confidence", "margin", "image", *dict(further)):
        vertices[name] = getattr(cloud, name)
    centers = cloud.camera_centers_in_base.tolist()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment jcr cloud in the base frame, metres",
        *(f"comment {name} {text}" for name, text in (notes or {}).items()),
        *(f"comment label {k} {name}" for k, name in enumerate(cloud.label_names)),
        *(f"comment camera {k} {x} {y} {z}" for k, (x, y, z) in enumerate(centers)),
        f"element vertex {len(vertices)}",
        *(
            f"property {_PLY_TYPES[vertices.dtype[name].str[1:]]} {name}"
            for name in vertices.dtype.names or ()
        ),
        "end_header\n",
    ]
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes())


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud that `write_cloud` wrote; raise InputError for any other file."""
    try:
        header, separator, body = read_bytes(path).partition(b"end_header\n")
        lines = header.decode().splitlines()
    except OSError as error:
        raise InputError(f"{path}: no cloud here ({error.strerror}); make one with jcr map OUT") from None
    except UnicodeDecodeError:
        separator, lines, body = b"", [], b""
    words = [line.split(maxsplit=3) for line in lines]
    if not separator or "comment jcr cloud in the base frame, metres" not in lines:
        raise InputError(f"{path}: is no cloud of jcr; make it again with jcr map OUT")
    further = [(name, kind) for name, kind in _DENSE if f"property {_PLY_TYPES[kind[1:]]} {name}" in lines]
    vertex = np.dtype([*_VERTEX.descr, *further])
    if len(body) % vertex.itemsize:
        raise InputError(f"{path}: the cloud is cut short; make it again with jcr map OUT")
    vertices = np.frombuffer(body, vertex)
    if not all(np.isfinite(vertices[name]).all() for name in vertex.names or ()):
        raise InputError(
            f"{path}: the cloud is damaged (a number is not finite); make it again with jcr map OUT"
        )
    try:
        centers = [[float(x) for x in word[3].split()] for word in words if word[:2] == ["comment", "camera"]]
        names = tuple(word[3] for word in words if word[:2] == ["comment", "label"])
        camera_centers = np.array(centers, np.float64).reshape(-1, 3)
    except (ValueError, IndexError):
        raise InputError(f"{path}: the cloud's header is damaged; make it again with jcr map OUT") from None
    return PointCloud(
        points_in_base=np.stack([vertices[name] for name in "xyz"], 1).astype(np.float64),
        color=np.stack([vertices[name] for name in ("red", "green", "blue")], 1),
        confidence=vertices["confidence"].astype(np.float64),
        margin=vertices["margin"].astype(np.float64),
        label=vertices["label"].astype(int),
        image=vertices["image"].astype(int),
        camera_centers_in_base=camera_centers,
        label_names=names,
        reason=vertices["reason"].copy() if "reason" in dict(further) else None,
        depth_std=vertices["depth_std"].astype(np.float64) if "depth_std" in dict(further) else None,
    )
