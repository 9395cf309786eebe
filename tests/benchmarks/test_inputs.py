"""The bench of inputs: numbers of a known pose in each notation, options in messages, and layouts read right."""

import pytest

from benchmarks.inputs import ORDERS, WRONG, _outcome
from simulation.layouts import LAYOUTS
from simulation.recordings import simulated_recordings


@pytest.mark.long
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
