"""The machinery of the benches, the numbers that the README quotes, and two of the benches."""

import re
from importlib import import_module
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

from benchmarks import __main__ as machinery
from benchmarks.__main__ import BENCHES, Arguments, claims, main, run_all, write_index
from benchmarks.peers import grid_search
from benchmarks.pointmaps import end_to_end
from jcr.errors import InputError
from jcr.geometry import rotation_between_deg, scale_translation
from jcr.records import Intrinsics
from places import ROOT
from simulation.problems import hand_eye_problem
from simulation.render import render
from simulation.scenes import make_scene

RESULTS = ROOT / "docs" / "results"
MEASURED = re.compile(r"(\d[\d,.]*\d|\d)\s?(mm|cm|°|%|ms|s|dB|GiB|GB|MiB|M|minutes|times)(?![\w])")


def test_every_page_of_results_belongs_to_a_bench_and_the_index_is_current(tmp_path: Path):
    for page in RESULTS.glob("*.md"):
        if page.name != "README.md":
            text = page.read_text()
            assert f"\n    python -m benchmarks {page.stem}" in text and claims(page), page
            assert page.stem in BENCHES
            (tmp_path / page.name).write_text(text)
    write_index(tmp_path)
    assert (tmp_path / "README.md").read_text() == (RESULTS / "README.md").read_text()


@pytest.mark.slow
def test_a_bench_that_fails_is_reported_and_stops_no_other_and_options_it_does_not_use_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for arguments, message in (
        (Arguments("real"), "name the folder"),
        (Arguments("map", captures=Path("captures")), "does not use captures"),
        (Arguments("all"), "--out"),
    ):
        with pytest.raises(InputError, match=message):
            main(arguments)
    monkeypatch.setattr(machinery, "BENCHES", {name: BENCHES[name] for name in ("real", "cameras")})
    (tmp_path / "captures").mkdir()
    assert run_all(tmp_path, tmp_path / "captures") == 1
    reported = "\n" + capsys.readouterr().err
    assert all(f"\n{name}: exit status 2: error: " in reported for name in ("real", "cameras"))


def test_every_bench_can_be_imported_and_takes_known_options():
    for name in BENCHES:
        known = signature(import_module(f"benchmarks.{name}").run).parameters
        assert set(known) <= {"captures", "boards"}, name


def test_every_number_of_the_readme_is_in_the_results():
    section = (ROOT / "README.md").read_text().split("## Evidence")[1].split("\n## ")[0]
    quoted = 0
    for row in section.splitlines():
        pages = re.findall(r"\((docs/results/\w+\.md)\)", row)
        found = {number for page in pages for number in MEASURED.findall((ROOT / page).read_text())}
        assert [number for number in MEASURED.findall(row) if number not in found] == [], row
        quoted += len(MEASURED.findall(row))
    assert quoted >= 8


@pytest.mark.gl
@pytest.mark.slow
def test_predictions_become_a_calibration_and_a_map_in_metres():
    """Pointmaps with a network's errors, against the truth of a simulated capture."""
    camera = Intrinsics(610.0, 610.0, 319.5, 239.5, 640, 480)
    try:
        next(render(make_scene("measuring", 0), camera, np.eye(4)[None], textured=False, with_truth=False))
    except InputError as error:
        pytest.skip(str(error))
    found = end_to_end(5, 1, (0.0, 0.0))
    assert found.translation_mm < 1.5 and found.rotation_deg < 0.1 and found.scale_percent < 0.3
    assert found.surface_mm < 5 and found.sigmas < 2


def test_the_papers_grid_search_finds_the_answer_within_its_grid_and_only_there():
    problem = hand_eye_problem(np.random.default_rng(5), 8)
    for scale, found_there in ((2.0, True), (5.0, False)):
        x, found = grid_search(
            problem.base_from_gripper, scale_translation(problem.recon_from_camera, problem.scale / scale)
        )
        assert rotation_between_deg(x[:3, :3], problem.gripper_from_camera[:3, :3]) < 1e-5
        assert (abs(found - scale) < 3 / 20_000) == found_there
