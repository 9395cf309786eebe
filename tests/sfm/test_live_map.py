"""Map of a capture that is being taken: images that come, leave and come back are matched once."""

from pathlib import Path

import pytest

import jcr
from jcr.capture.images import read_image
from jcr.features import sift
from jcr.records import Capture
from jcr.sfm.live_map import LiveMap
from scenes import center_errors

pytestmark = pytest.mark.slow


def off_mm(capture: Capture, found: LiveMap) -> float:
    """Return the largest distance of a camera from where the reference and its gripper put it, of all images."""
    made = found.reconstruction()
    assert made is not None and made.image_index.tolist() == list(range(len(capture)))
    return 1e3 * float(center_errors(capture, made).max())


def test_images_that_come_leave_and_come_back_are_matched_once(
    tabletop: Path, monkeypatch: pytest.MonkeyPatch
):
    whole, matched = jcr.read_capture(tabletop), list[int]()
    real = sift.matches
    monkeypatch.setattr(sift, "matches", lambda *of: (matched.append(1), real(*of))[1])
    live = LiveMap(whole)

    def update(rows: list[int], new: list[int]) -> Capture:
        """Map the images of these rows, of which some are new, and return their capture."""
        capture, before = whole.of_rows(rows), len(matched)
        live.update(capture, {whole.images[row]: read_image(tabletop / whole.images[row]) for row in new})
        others = len(rows) - len(new)
        assert len(matched) - before == others * len(new) + len(new) * (len(new) - 1) // 2
        return capture

    update(list(range(6)), list(range(6)))
    assert off_mm(update(list(range(7)), [6]), live) < 1.0
    capture = update([0, 1, 3, 4, 5, 6], [])
    assert off_mm(capture, live) < 1.0 and live.registered == list(range(6))
    capture = update(list(range(7)), [2])
    assert off_mm(capture, live) < 1.0 and live.matched_with(2) >= 3
