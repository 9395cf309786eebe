"""The evidence: every claim of the README is a measured one, and one failing bench loses no other's page."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import BENCHES
from benchmarks.peers import grid_search
from benchmarks.suite import CLAIM, MARKS, Outcome, between_marks, claims, run, write_index
from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.geometry import rotation_between_deg, scale_translation
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_benches_run_as_a_package_of_their_own_and_are_not_installed(tmp_path: Path):
    """`python -m benchmarks` is the command line; the package alone says where they are and completes all else."""

    def ended(*arguments: str, source: Path, at: Path) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(source)}
        command = [sys.executable, "-m", *arguments]
        return subprocess.run(command, env=environment, cwd=at, capture_output=True, text=True)

    shutil.copytree(
        ROOT / "src" / "jcr", tmp_path / "jcr", ignore=shutil.ignore_patterns("__pycache__", "*.html")
    )
    alone = ended("jcr", "bench", "run", "--out", "pages", source=tmp_path, at=tmp_path)
    assert alone.returncode == 2 and "python -m benchmarks" in alone.stderr and alone.stderr.count("\n") == 1
    script = ended("jcr", "--completion", "bash", source=tmp_path, at=tmp_path)
    assert script.returncode == 0 and "--backend" in script.stdout and "table1" not in script.stdout

    refused = ended("benchmarks", "real", source=ROOT / "src", at=ROOT)
    assert refused.returncode == 2 and "name the folder" in refused.stderr and refused.stderr.count("\n") == 1
    assert set(BENCHES) <= {path.stem for path in (ROOT / "benchmarks").glob("*.py")}


def test_a_bench_refuses_what_it_does_not_use(capsys: pytest.CaptureFixture[str]):
    assert dispatch(["bench", "pairs", "captures"]) == 2
    assert "takes no folder of captures" in capsys.readouterr().err


def test_the_bench_of_robots_tells_what_each_way_of_knowing_them_is_worth():
    from benchmarks.robots import KNOWN, PEER, measure, page

    rows = measure(("ur5e",), ("poor",), (8,), draws=2)
    assert [row.known for row in rows] == [*KNOWN, PEER]
    assert all(row.beyond_5 == 0 and row.accepted == 1 for row in rows[:3])
    text = page(rows, 2)
    assert text.startswith(CLAIM) and text.count("| poor | 8 |") == 5
