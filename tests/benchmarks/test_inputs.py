"""The bench of inputs: numbers of a known pose in each notation, options in messages, and layouts read right."""

import numpy as np
import pytest

from benchmarks.inputs import ORDERS, WRONG, _outcome, named_options
from jcr.geometry import transform
from simulation.layouts import LAYOUTS, numbers_of
from simulation.recordings import simulated_recordings

HALF = np.sqrt(0.5)
TURNED = transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 3.0]))
"""Pose at (1, 2, 3) after a quarter turn about z."""


@pytest.mark.parametrize(
    ("rotation", "numbers"),
    [
        ("xyzw", [1, 2, 3, 0, 0, HALF, HALF]),
        ("wxyz", [1, 2, 3, HALF, 0, 0, HALF]),
        ("rotvec", [1, 2, 3, 0, 0, 90]),
        ("ZYX", [1, 2, 3, 90, 0, 0]),
        ("xyz", [1, 2, 3, 0, 0, 90]),
        ("3x4", [0, -1, 0, 1, 1, 0, 0, 2, 0, 0, 1, 3]),
        ("columns", [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]),
    ],
)
def test_a_quarter_turn_in_each_notation(rotation: str, numbers: list[float]):
    np.testing.assert_allclose(numbers_of(TURNED[None], rotation, "deg"), [numbers], atol=1e-12)


def test_options_that_a_message_names():
    message = (
        "poses.txt: two readings; give --pose-convention euler:ZYX --pose-units mm-deg, or --pose-inverted; see "
        "(--poses robot/a.txt), --nonsense 3."
    )
    assert named_options(message) == [
        {"pose_convention": "euler:ZYX", "pose_units": "mm-deg"},
        {"pose_inverted": True},
        {"poses": "robot/a.txt"},
    ]
    assert named_options("no option") == []


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_no_layout_is_read_wrong(layout, tmp_path):
    (one,) = simulated_recordings(tmp_path / "simulated", [4])
    true = _outcome(tmp_path / "layout", layout, one, "", one.base_from_gripper)
    assert true.kind not in WRONG, true.message
    assert true.kind == "right" or not layout.names_fix, true.message
    if layout.names_fix and layout is not LAYOUTS[0]:
        return  # what a calibration makes of shifted poses does not depend on the file that they are in
    shifted = one.base_from_gripper[ORDERS["off by one"](one)]
    assert _outcome(tmp_path / "layout", layout, one, "off by one", shifted).kind in ("refused", "rejected")
