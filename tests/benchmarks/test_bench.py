"""The evidence: every claim of the README is a measured one, and one failing bench loses no other's page."""

import os
import re
import subprocess
import sys
from importlib import import_module
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from benchmarks.freshness import (
    COMMIT,
    changed_since_measured,
    essence,
    has_history,
    is_marked_old,
    marked,
)

from benchmarks.peers import grid_search
from benchmarks.suite import CLAIM, MARKS, Outcome, claims, run, with_claims, write_index
from benchmarks.table import BENCHES, LONG, paths_of
from jcr.cli import call
from jcr.errors import InputError
from jcr.geometry import rotation_between_deg, scale_translation
from places import ROOT
from simulation.problem import hand_eye_problem

RESULTS = ROOT / "docs" / "results"
MEASURED = re.compile(r"(\d[\d,.]*\d|\d)\s?(mm|cm|°|%|ms|s|dB|GiB|GB|MiB|M|minutes|times)(?![\w])")


def test_the_index_claims_what_the_benches_found_and_nothing_else():
    index = (RESULTS / "README.md").read_text()
    assert with_claims(index, RESULTS) == index, "write it again: python -m benchmarks stale --write"


def test_every_number_of_the_readme_is_in_the_results():
    section = (ROOT / "README.md").read_text().split("## Evidence")[1].split("\n## ")[0]
    quoted = 0
    for row in section.splitlines():
        pages = re.findall(r"\((docs/results/\w+\.md)\)", row)
        found = {number for page in pages for number in MEASURED.findall((ROOT / page).read_text())}
        assert [number for number in MEASURED.findall(row) if number not in found] == [], row
        quoted += len(MEASURED.findall(row))
    assert quoted >= 8


def test_the_manual_quotes_the_dense_depth_that_was_measured():
    text = (ROOT / "docs" / "explanation" / "dense-depth.md").read_text().split("| before | now |", 1)[1]
    now = " ".join(row.split("|")[-2] for row in text.split("\n\n")[0].splitlines() if "|" in row)
    quoted = [number for number in MEASURED.findall(now) if number[1] == "%"]
    assert len(quoted) >= 10
    assert set(quoted) <= set(MEASURED.findall((RESULTS / "depth_long.md").read_text()))


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(RESULTS.glob("*.md")), ids=lambda page: page.stem)
def test_a_page_of_results_shows_where_it_is_older_than_the_code_it_measures(page: Path):
    paths = paths_of(page.stem)
    if paths is None:
        assert page.name == "README.md", "a page of no bench"
        return
    assert all((ROOT / path).exists() for path in paths)
    text = page.read_text()
    assert COMMIT.search(text), "names no commit"
    if not has_history():
        pytest.skip("a shallow clone, or no repository: git cannot tell what changed since")
    old = bool(changed_since_measured(page, paths, at_most=1))
    assert old is is_marked_old(text), "measure it again, or: python -m benchmarks stale --write"


def test_what_code_shows_does_not_make_a_page_old():
    code = (
        "def f(x):\n    'Two.'\n    if x < 0:\n        raise ValueError(f'{x} too low')\n    return x + 1\n"
    )
    said_otherwise = code.replace("Two", "2").replace("too low", "below zero") + "# more\n"
    assert essence(code) == essence(said_otherwise)
    assert essence(code) != essence(code.replace("x + 1", "x + 2"))


def test_a_page_shows_that_it_is_old_below_its_commit_and_once():
    page = "# python -m benchmarks map\n\n2026-11-22, commit `abcdef0`. A machine.\n\n> found\n"
    once = marked(page, ["src/jcr/a.py"])
    assert is_marked_old(once) and once.splitlines()[4].endswith("`src/jcr/a.py` changed since.")
    assert marked(once, ["src/jcr/a.py"]) == once and marked(once, []) == page


def test_every_page_of_results_shows_which_command_writes_it():
    named = set(re.findall(r"\((\w+)\.md\)", (RESULTS / "README.md").read_text()))
    assert named == {page.stem for page in RESULTS.glob("*.md")} - {"README"}
    for page in named:
        text, name = (RESULTS / f"{page}.md").read_text(), page.removesuffix(LONG)
        assert name in BENCHES and claims(RESULTS / f"{page}.md"), page
        assert f"\n    python -m benchmarks {name}" in text, page
        images = re.findall(r"\]\((\w+\.png)\)", text)
        assert all((RESULTS / image).is_file() for image in images)


@pytest.mark.slow
def test_a_bench_that_fails_is_named_and_loses_no_other(tmp_path: Path):
    (tmp_path / "map.md").write_text(f"{CLAIM}the map is good\n")
    printed: list[Outcome] = []
    outcomes = run(
        {"nonsense": False, "real": True}, tmp_path, {"real": [str(tmp_path / "nowhere")]}, printed.append
    )
    assert [outcome.name for outcome in outcomes] == ["nonsense", "real"] and len(printed) == 2
    assert "nonsense" in outcomes[0].trouble and "nowhere" in outcomes[1].trouble
    write_index(outcomes, tmp_path, "python -m benchmarks all", "a machine.", ["a network: no weights"], 90.0)
    index = (tmp_path / "README.md").read_text()
    assert "2 benches in 1.5 minutes" in index
    assert "| [The map](map.md) | the map is good |" in index
    assert "- a network: no weights" in index and "- **nonsense** ended with status 2" in index


def test_claims_go_between_the_marks_as_a_table_and_an_index_without_them_is_refused(tmp_path: Path):
    about = "# The map\n\nof things\n\n    python -m benchmarks map\n\n2026-11-22, commit `abcdef0`.\n"
    (tmp_path / "map.md").write_text(f"{about}{CLAIM}the map: 1 mm off\n{CLAIM}2 s long\n")
    (tmp_path / "seen.md").write_text(f"{CLAIM}10 draws\n")
    (tmp_path / "seen_long.md").write_text(f"{CLAIM}40 draws\n")
    written = with_claims(f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n", tmp_path)
    assert "| [The map](map.md) | the map: 1 mm off 2 s long |\n" in written
    assert "| [Points that the camera sees](seen_long.md) ([short](seen.md)) | 40 draws |\n" in written
    assert written.index("accuracy true") < written.index("camera sees") < written.index("## Depth")
    assert written.startswith("before\n") and written.endswith("after\n") and "old" not in written
    with pytest.raises(InputError, match="marks|lines"):
        with_claims("no marks", tmp_path)


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
def test_benches_run_as_a_package_of_their_own():
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-m", "benchmarks", "real"]
    refused = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert refused.returncode == 2 and "name the folder" in refused.stderr and refused.stderr.count("\n") == 1
    assert set(BENCHES) <= {path.stem for path in (ROOT / "benchmarks").glob("*.py")}


def test_a_bench_refuses_what_it_does_not_use(capsys: pytest.CaptureFixture[str]):
    for given, said in {
        ("map", "captures"): "takes no folder of captures",
        ("cameras", "captures", "--boards", "a=charuco"): "takes no --boards",
        ("map", "--runs", "runs"): "keeps no run folders",
        ("map", "--long"): "has no --long",
        ("all", "--long", "--out", "pages"): "of one bench at a time",
    }.items():
        assert call(lambda: import_module("benchmarks.__main__"), "python -m benchmarks", given) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(BENCHES))
def test_a_bench_takes_what_its_row_of_the_table_shows(name: str):
    row, run_one = BENCHES[name], import_module(f"benchmarks.{name}").run
    asks = {"captures": row.of_captures, "boards": row.of_boards, "runs": row.keeps_runs}
    asks |= {"out": row.draws, "long": bool(row.long)}
    assert set(signature(run_one).parameters) == {option for option, is_asked in asks.items() if is_asked}


@pytest.mark.slow
def test_the_bench_of_robots_tells_what_each_way_of_knowing_them_is_worth():
    from benchmarks.robots import KNOWN, PEER, measure, page

    rows = measure(("ur5e",), ("poor",), (8,), draws=2)
    assert [row.known for row in rows] == [*KNOWN, PEER]
    assert all(row.beyond_5 == 0 and row.accepted == 1 for row in rows[:3])
    text = page(rows, 2)
    assert text.startswith(CLAIM) and text.count("| poor | 8 |") == 5
