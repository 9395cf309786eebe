"""The end of `jcr capture`: its exit status, and the command that it names."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jcr.cli.capture import Arguments, _conclude
from jcr.live.session import SessionOptions
from jcr.records import Finding, FindingKind, Requirement


def result(converged: bool, reached_mm: float) -> Any:
    """A calibration of all images, accepted or not, that reaches an accuracy."""
    required = Requirement(
        translation_mm=2.0, rotation_deg=0.3, asked=True, distance_mm=500.0, reached_mm=reached_mm, reached_deg=0.1
    )  # fmt: skip
    findings = (
        () if converged else (Finding.of(FindingKind.NO_RECONSTRUCTION, "rejects", text="no map", remedy=""),)
    )
    hand_eye = SimpleNamespace(requirement=required, findings=findings)
    verdict = "accepted" if converged else "rejected"
    return SimpleNamespace(
        converged=converged, hand_eye=hand_eye, verdict=verdict, out=Path("captures/live/result")
    )


@pytest.mark.parametrize(
    ("images", "found", "until_accurate", "status", "last"),
    [
        (2, None, False, 0, "2 images in captures/live; 3 or more are needed: the same command resumes"),
        (9, None, False, 3, "next: jcr check captures/live"),
        (9, result(False, 1.0), False, 3, "next: jcr check captures/live"),
        (9, result(True, 1.0), False, 0, "next: jcr run captures/live out/live"),
        (9, result(True, 1.0), True, 0, "next: jcr run captures/live out/live"),
        (9, result(True, 3.0), True, 3, "next: jcr run captures/live out/live"),
        (2, None, True, 3, "2 images in captures/live; 3 or more are needed: the same command resumes"),
    ],
)
def test_a_rejected_result_exits_with_three_and_the_last_line_is_a_command_that_works(
    images: int,
    found: Any,
    until_accurate: bool,
    status: int,
    last: str,
    capsys: pytest.CaptureFixture[str],
):
    options = SessionOptions(until_accurate=until_accurate, require=(2.0, 0.3))
    arguments = Arguments(out=Path("captures/live"), session=options)
    folder: Any = SimpleNamespace(names=[f"{k}.png" for k in range(images)])
    assert _conclude(arguments, folder, [], found, requirement_met=True) == status
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == last
    if found is not None:
        assert printed[0].startswith(f"captures/live/result: {found.verdict}")
