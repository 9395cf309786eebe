"""Reading of one rigid transform from a file: exports for ROS, results of easy_handeye, or a matrix in any document."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.documents import read_record_tables, root_of_xml
from jcr.capture.documents.table import decode_text, read_limited
from jcr.capture.options import ReadOptions
from jcr.capture.readings import readings_of
from jcr.errors import InputError
from jcr.geometry import transform

ARGUMENTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Arguments of ROS 2's static_transform_publisher."""
ARRAY_SUFFIXES = (".npy", ".npz", ".mat")
PROSE_SUFFIXES = (".md", ".rst", ".html", ".htm", ".ipynb")
"""Endings of texts for people, whose matrices are examples."""


def read_transform(file: Path) -> Float[ndarray, "4 4"]:
    """Read the rigid transform (m) in a file: the camera's pose in the gripper frame, as `jcr export` writes it.

    Read are a static_transform_publisher's arguments, the only fixed joint of a URDF, translation and rotation in YAML
    or JSON (easy_handeye's result among them), and a 4x4 matrix. Raises InputError if the file holds none, or several,
    and for a text such as a README, whatever it holds.
    """
    if file.suffix.lower() in PROSE_SUFFIXES:
        raise InputError(
            f"{file}: is a text, not a document of a transform; give a file that holds only the matrix"
        )
    text = "" if file.suffix.lower() in ARRAY_SUFFIXES else decode_text(file, read_limited(file))
    found = [*_of_arguments(text), *_of_urdf(file, text)] or _of_record(file)
    if not found:
        raise InputError(f"{file}: no transform; give a 4x4 matrix, or a file of `jcr export`")
    if any(not np.allclose(found[0], other, rtol=0, atol=1e-9) for other in found[1:]):
        raise InputError(f"{file}: holds several transforms; give a file with one")
    return found[0]


def _of_arguments(text: str) -> list[Float[ndarray, "4 4"]]:
    """Return the transforms of static_transform_publisher's named arguments in a launch file or a command."""
    columns = [re.findall(rf'--{name}[\s",=]+([-+.\deE]+)', text) for name in ARGUMENTS]
    rows = [[float(number) for number in row] for row in zip(*columns, strict=False)]
    return [transform(Rotation.from_quat(row[3:]).as_matrix(), np.array(row[:3])) for row in rows]


def _of_urdf(file: Path, text: str) -> list[Float[ndarray, "4 4"]]:
    """Return the transforms of a URDF's fixed joints that have an origin."""
    if "<robot" not in text:
        return []
    joints = root_of_xml(file, text).findall("joint[@type='fixed']")
    made = []
    for origin in (one for joint in joints for one in joint.findall("origin")):
        try:
            xyz, rpy = (
                np.array(origin.get(key, "0 0 0").split(), float).reshape(3) for key in ("xyz", "rpy")
            )
        except ValueError:
            raise InputError(f"{file}: an origin without three numbers for xyz and rpy; write them") from None
        made.append(transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz))
    return made


def _of_record(file: Path) -> list[Float[ndarray, "4 4"]]:
    """Return the transform of a document that is one record: a 4x4 matrix, or a translation and a quaternion."""
    for table in read_record_tables([file]):
        readings = readings_of(table, ReadOptions(), str(file))[1]
        stated = [
            poses[0] for reading, poses in readings if reading.decided_by == "names" or len(readings) == 2
        ]
        if stated:
            return stated[:1]
    return []
