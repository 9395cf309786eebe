"""A transform is read from what `jcr export` writes, from easy_handeye's results, and from matrices of any document."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jcr.capture.transform_file import read_transform
from jcr.geometry import transform
from refusal import refused

ROTATION = Rotation.from_quat([0.1, -0.2, 0.3, 0.9])
TRUE = transform(ROTATION.as_matrix(), np.array([0.05, -0.02, 0.04]))
QUATERNION = dict(zip("xyzw", ROTATION.as_quat().tolist(), strict=True))
ARGUMENTS = " ".join(
    f"--{name} {value:.12f}"
    for name, value in zip(
        ("x", "y", "z", "qx", "qy", "qz", "qw"), [0.05, -0.02, 0.04, *ROTATION.as_quat()], strict=True
    )
)
RPY = " ".join(map(str, ROTATION.as_euler("xyz")))
FILES = {
    "static.launch.xml": f'<launch><node args="{ARGUMENTS} --frame-id tool0"/></launch>',
    "static.launch.py": "arguments=[" + ", ".join(f'"{word}"' for word in ARGUMENTS.split()) + "]",
    "camera.urdf": f'<robot name="a"><joint name="j" type="fixed"><origin xyz="0.05 -0.02 0.04" rpy="{RPY}"/>'
    "</joint></robot>",
    "hand_eye.calib": "parameters:\n  name: a\ntransform:\n"
    + "  translation: {x: 0.05, y: -0.02, z: 0.04}\n"
    + f"  rotation: {json.dumps(QUATERNION)}\n",
    "matrix.txt": "\n".join(" ".join(map(str, row)) for row in TRUE),
    "matrix in mm.txt": "\n".join(" ".join(map(str, [*row[:3], 1e3 * row[3]])) for row in TRUE[:3])
    + "\n0 0 0 1\n",
    "matrix.json": json.dumps({"gripper2cam": TRUE.tolist()}),
    "list.json": json.dumps(TRUE.tolist()),
    "matrix.yaml": f"%YAML:1.0\n---\nX: !!opencv-matrix\n  rows: 4\n  cols: 4\n  data: {TRUE.ravel().tolist()}\n",
}


@pytest.mark.parametrize("name", FILES)
def test_a_transform_is_read(name: str, tmp_path: Path):
    (tmp_path / name).write_text(FILES[name])
    assert np.allclose(read_transform(tmp_path / name), TRUE, rtol=0, atol=1e-9)


def test_several_or_no_transforms_are_refused(tmp_path: Path):
    (tmp_path / "two.xml").write_text(FILES["static.launch.xml"] * 2)
    assert np.allclose(read_transform(tmp_path / "two.xml"), TRUE, rtol=0, atol=1e-9)  # the same one twice
    other = FILES["static.launch.xml"].replace("--x 0.05", "--x 0.06")
    (tmp_path / "two.xml").write_text(FILES["static.launch.xml"] + other)
    with refused("several transforms"):
        read_transform(tmp_path / "two.xml")
    (tmp_path / "README.md").write_text(f"# Results\n\nThe transform:\n\n{FILES['matrix.txt']}\n")
    with refused("README.md: is a text, not a document of a transform; give a file that holds only"):
        read_transform(tmp_path / "README.md")
    (tmp_path / "none.txt").write_text("hello\n1 2 3\n")
    with refused("no transform"):
        read_transform(tmp_path / "none.txt")


@pytest.mark.parametrize(("text", "fault"), [
    ('<!DOCTYPE r [<!ENTITY a "aaaa">]><robot name="&a;"/>', "document type or entities"),
    (FILES["camera.urdf"].replace("</", "<//"), "not XML"),
    (FILES["camera.urdf"].replace("0.05 -0.02", "0.05"), "three numbers"),
])  # fmt: skip
def test_a_damaged_urdf_is_refused(text: str, fault: str, tmp_path: Path):
    (tmp_path / "arm.urdf").write_text(text)
    with refused(fault):
        read_transform(tmp_path / "arm.urdf")
