"""The end of `jcr capture`: its exit status, and the command that it names."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jcr.calibration.record import Calibration, read_calibration
from jcr.cli import dispatch
from jcr.cli.capture import CaptureCommand, _conclude
from jcr.estimation.arms import ROBOT_NAMES
from jcr.live.session import SessionOptions
from jcr.records import Requirement
from places import ROOT


def result(name: str, reached_mm: float) -> Any:
    """A calibration of all images, accepted or rejected, that reaches an accuracy."""
    required = Requirement(
        translation_mm=2.0, rotation_deg=0.3, asked=True, distance_mm=500.0, reached_mm=reached_mm, reached_deg=0.1
    )  # fmt: skip
    content = read_calibration(ROOT / "tests" / "calibrations" / f"{name}.json")
    assert isinstance(content, Calibration)
    content = replace(content, requirement=required)
    return SimpleNamespace(
        converged=content.converged,
        verdict=content.verdict,
        calibration=content,
        out=Path("captures/live/result"),
    )


CHECK, RUN = "jcr check captures/live", "jcr run captures/live out/live"
RESUME = "the same command resumes; 3 or more images are needed"


@pytest.mark.parametrize(
    ("images", "found", "until_accurate", "status", "last"),
    [
        (2, None, False, 0, RESUME),
        (2, None, True, 3, RESUME),
        (9, None, False, 3, CHECK),
        (9, result("rejected", 1.0), False, 3, CHECK),
        (9, result("accepted", 1.0), False, 0, RUN),
        (9, result("accepted", 1.0), True, 0, RUN),
        (9, result("accepted", 3.0), True, 3, RUN),
    ],
)
def test_a_rejected_result_exits_with_three_and_the_last_line_is_a_command_that_works(
    images: int, found: Any, until_accurate: bool, status: int, last: str, capsys: pytest.CaptureFixture[str]
):
    options = SessionOptions(until_accurate=until_accurate, require=(2.0, 0.3))
    facts = {"capture": "captures/live", "images": images * ["0.png"], "answers": []}
    assert _conclude(CaptureCommand(session=options), facts, found, requirement_met=True) == status
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == f"Next        {last}" and len(printed) <= 14
    if found is not None:
        assert printed[0].startswith("ACCEPTED" if found.converged else "REJECTED")


def test_the_arms_are_listed(capsys: pytest.CaptureFixture[str]):
    assert dispatch(["capture", "--robot", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(ROBOT_NAMES)
    assert dispatch(["capture"]) == 2
    assert capsys.readouterr().err == "error: OUT: required, and not given (jcr capture --help)\n"
