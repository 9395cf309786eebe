"""Point clouds as PLY, the format every viewer reads."""

from pathlib import Path

import numpy as np

from jcr.files import write_bytes
from jcr.records import PointCloud


def write_cloud(path: Path, cloud: PointCloud) -> None:
    """Write binary PLY: x y z in metres in the base frame, RGB, label, confidence, margin (m)."""
    vertex = np.empty(
        len(cloud.points_in_base),
        dtype=[
            *((axis, "<f4") for axis in "xyz"),
            *((channel, "u1") for channel in ("red", "green", "blue")),
            ("label", "<i4"),
            ("confidence", "<f4"),
            ("margin", "<f4"),
        ],
    )
    for k, axis in enumerate("xyz"):
        vertex[axis] = cloud.points_in_base[:, k]
    for k, channel in enumerate(("red", "green", "blue")):
        vertex[channel] = cloud.color[:, k]
    vertex["label"], vertex["confidence"], vertex["margin"] = cloud.label, cloud.confidence, cloud.margin
    kinds = {"<f4": "float", "u1": "uchar", "|u1": "uchar", "<i4": "int"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment frame: robot base; unit: metre; margin: one sigma in metre",
        f"element vertex {len(vertex)}",
        *(f"property {kinds[vertex.dtype[name].str]} {name}" for name in vertex.dtype.names or ()),
        "end_header\n",
    ]
    write_bytes(path, "\n".join(header).encode() + vertex.tobytes())
