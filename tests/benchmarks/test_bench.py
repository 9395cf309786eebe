"""The evidence: every claim of the README is a measured one, and one failing bench loses no other's page."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.compact import scored

from benchmarks.peers import grid_search
from benchmarks.suite import CLAIM, MARKS, Outcome, between_marks, claims, run, write_index
from benchmarks.synthetic_pairs import PairErrors, pairs_of_capture
from jcr.capture.read import read_capture
from jcr.cli.bench import BENCHES
from jcr.errors import InputError
from jcr.geometry import rotation_between_deg, rotation_exp, scale_translation, transform
from jcr.pipeline import RunOptions, calibrate
from jcr.reconstruct.backends import ReconstructOptions
from jcr.reconstruct.global_alignment.pairs import write_pairs
from jcr.simulate.capture import SimulateOptions, simulate
from jcr.simulate.problem import hand_eye_problem
from places import ROOT

RESULTS = ROOT / "docs" / "results"
MEASURED = re.compile(r"(\d[\d,.]*\d|\d)\s?(mm|cm|°|%|ms|s|dB|GiB|GB|MiB|M|minutes|times)(?![\w])")


def test_the_readme_claims_what_the_benches_found_and_nothing_else():
    readme = (ROOT / "README.md").read_text()
    assert between_marks(readme, RESULTS, list(BENCHES), "docs/results") == readme


def test_every_number_of_the_readme_is_in_the_results():
    section = (ROOT / "README.md").read_text().split("## What it measures")[1].split("\n## ")[0]
    pages = "\n".join(page.read_text() for page in RESULTS.glob("*.md") if page.name != "README.md")
    quoted, found = MEASURED.findall(section), set(MEASURED.findall(pages))
    assert len(quoted) > 10
    assert [number for number in quoted if number not in found] == []


def test_every_page_of_results_says_which_command_writes_it():
    named = set(re.findall(r"\((\w+)\.md\)", (RESULTS / "README.md").read_text()))
    assert named and named <= set(BENCHES)
    for name in named:
        text = (RESULTS / f"{name}.md").read_text()
        assert f"\n    jcr bench {name}" in text and claims(RESULTS / f"{name}.md"), name
        pictures = re.findall(r"\]\((\w+\.png)\)", text)
        assert all((RESULTS / picture).is_file() for picture in pictures)


def test_a_bench_that_fails_is_named_and_loses_no_other(tmp_path: Path):
    (tmp_path / "map.md").write_text(f"{CLAIM}the map is good\n")
    told: list[Outcome] = []
    outcomes = run(
        {"nonsense": False, "real": True, "map": True},
        tmp_path,
        {"real": [str(tmp_path / "nowhere")]},
        True,
        told.append,
    )
    assert [outcome.name for outcome in outcomes] == ["nonsense", "real", "map"]
    assert "nonsense" in outcomes[0].trouble and "nowhere" in outcomes[1].trouble
    assert outcomes[2].seconds is None and not outcomes[2].trouble  # newer than the sources: left out
    assert len(told) == 2
    write_index(outcomes, tmp_path, "jcr bench all", "a machine.", ["a network: no weights"], 90.0)
    index = (tmp_path / "README.md").read_text()
    assert "2 of 3 benches were run this time, in 1.5 minutes" in index
    assert "- the map is good ([map](map.md))" in index
    assert "- a network: no weights" in index and "- **nonsense** ended with status 2" in index


def test_a_page_older_than_the_sources_is_measured_again(tmp_path: Path):
    page = tmp_path / "real.md"
    page.write_text("old\n")
    os.utime(page, (0, 0))
    (outcome,) = run({"real": True}, tmp_path, {}, True, lambda outcome: None)
    assert outcome.seconds is not None


def test_claims_go_between_the_marks_and_a_readme_without_them_is_refused(tmp_path: Path):
    (tmp_path / "map.md").write_text(f"# map\n{CLAIM}1 mm off\n{CLAIM}2 s long\n")
    readme = f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n"
    written = between_marks(readme, tmp_path, ["map", "limits"], "results")
    link = "([`jcr bench map`](results/map.md))"
    assert written == f"before\n{MARKS[0]}\n- 1 mm off {link}\n- 2 s long {link}\n{MARKS[1]}\nafter\n"
    with pytest.raises(InputError, match="marks|lines"):
        between_marks("no marks", tmp_path, ["map"], "results")


def test_the_papers_grid_search_finds_the_answer_within_its_grid_and_only_there():
    problem = hand_eye_problem(np.random.default_rng(5), 8)
    for scale, found_there in ((2.0, True), (5.0, False)):
        x, found = grid_search(
            problem.base_from_gripper,
            scale_translation(problem.recon_from_camera, problem.scale / scale),
        )
        assert rotation_between_deg(x[:3, :3], problem.gripper_from_camera[:3, :3]) < 1e-5
        assert (abs(found - scale) < 3 / 20_000) == found_there


def test_calibrations_are_scored_by_the_truth_of_their_capture(tmp_path: Path):
    """Exact pointmaps score nothing; then an offset, a turn and a scale are changed by known amounts."""
    folder = simulate(tmp_path / "capture", SimulateOptions(images=6, seed=200, texture=False))
    exact = PairErrors(pixel=0.0, warp=0.0, outliers=0.0)
    write_pairs(tmp_path / "pairs.npz", pairs_of_capture(folder, errors=exact)[0])
    options = RunOptions(ReconstructOptions("predictions", weights=str(tmp_path / "pairs.npz")))
    result = calibrate(read_capture(folder), tmp_path / "out", options)
    right = scored(result, folder)
    assert right.trusted and right.height_percent < 2
    assert max(right.mm, 10 * right.deg, right.scale_percent) < 0.5
    found = result.hand_eye
    move = transform(rotation_exp(np.radians([0, 0, 3.0])), np.array([0.02, 0, 0]))
    moved = replace(found, gripper_from_camera=found.gripper_from_camera @ move)
    wrong = scored(replace(result, hand_eye=moved), folder)
    assert wrong.mm == pytest.approx(20, abs=1) and wrong.deg == pytest.approx(3, abs=0.1)
    assert wrong.sigmas > 10
    large = scored(replace(result, hand_eye=replace(found, scale=1.1 * found.scale)), folder)
    assert large.scale_percent == pytest.approx(10, abs=0.5)
    assert large.height_percent > 9  # of views from several heights, which no longer agree
