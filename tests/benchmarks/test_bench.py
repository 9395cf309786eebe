"""The benches: their pages, the numbers that the README quotes, references of real captures and how these are built."""

import re
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import PAGES, claims, write_index
from benchmarks.real import WristCamera, pixels_of
from benchmarks.real_captures.fetch import recipes
from benchmarks.references import Corners, reference
from jcr.camera import parameters
from jcr.geometry import step_between
from jcr.records import Intrinsics
from places import ROOT
from simulation.problems import TARGET_IN_BASE, HandEyeProblem, hand_eye_problem

RESULTS = ROOT / "docs" / "results"
MEASURED = re.compile(r"(\d[\d,.]*\d|\d)\s?(mm|cm|°|%|ms|s|dB|GiB|GB|MiB|M|minutes|times)(?![\w])")


def test_every_page_of_results_belongs_to_a_bench_and_the_index_is_current(tmp_path: Path):
    for page in RESULTS.glob("*.md"):
        if page.name != "README.md":
            text = page.read_text()
            assert f"\n    python -m benchmarks {page.stem}" in text and claims(page), page
            assert page.stem in PAGES
            (tmp_path / page.name).write_text(text)
    write_index(tmp_path)
    assert (tmp_path / "README.md").read_text() == (RESULTS / "README.md").read_text()


def test_every_bench_can_be_imported_and_takes_known_options():
    for name in (name for _, benches in PAGES.values() for name in benches):
        known = signature(import_module(f"benchmarks.{name}").run).parameters
        assert set(known) <= {"captures", "boards", "every", "seed"}, name


def test_every_number_of_the_readme_is_in_the_results():
    section = (ROOT / "README.md").read_text().split("## Evidence")[1].split("\n## ")[0]
    quoted = 0
    for row in section.splitlines():
        pages = re.findall(r"\((docs/results/\w+\.md)[#\w-]*\)", row)
        found = {number for page in pages for number in MEASURED.findall((ROOT / page).read_text())}
        assert [number for number in MEASURED.findall(row) if number not in found] == [], row
        quoted += len(MEASURED.findall(row))
    assert quoted >= 8


CAMERA = Intrinsics(620.0, 620.0, 322.0, 236.0, 640, 480, (-0.08, 0.03, 0.0, 0.0, 0.0))
NOISE_PX = 0.1
X_IN_BOARD = np.stack([*np.meshgrid(np.arange(8), np.arange(5)), np.zeros((5, 8))], -1).reshape(-1, 3) * 0.025


def seen(
    problem: HandEyeProblem, bend: float = 0.0, noise_px: float = NOISE_PX
) -> tuple[WristCamera, Corners]:
    """Return the true camera, and a board about the target, its edges raised by `bend` (m), in its images."""
    camera = WristCamera(CAMERA, problem.gripper_from_camera, problem.true_base_from_gripper)
    x_in_base = X_IN_BOARD - X_IN_BOARD.mean(0)
    x_in_base[:, 2] = bend * (x_in_base[:, 0] / x_in_base[:, 0].max()) ** 2
    image, corner = (index.ravel() for index in np.indices((len(problem.base_from_gripper), len(X_IN_BOARD))))
    corners = Corners(image, corner, np.zeros((len(image), 2)), X_IN_BOARD)
    x_px = pixels_of(camera, corners, x_in_base + TARGET_IN_BASE)
    return camera, replace(corners, x_px=x_px + noise_px * np.random.default_rng(1).normal(size=x_px.shape))


@pytest.mark.slow
def test_references_state_their_own_error():
    """Errors over σ of X and intrinsics of boards that are bent and of another size than stated: χ² per parameter."""
    squared = []
    for seed in range(2):
        problem = hand_eye_problem(np.random.default_rng(seed), 10, robot_noise=(4e-4, 1e-3))
        camera, corners = seen(problem, 0.001)
        stated = replace(corners, x_in_board=X_IN_BOARD / 1.02)
        found = reference(problem.base_from_gripper, stated, (CAMERA.width, CAMERA.height))
        off = np.r_[
            step_between(found.gripper_from_camera, camera.gripper_from_camera),
            parameters(CAMERA) - parameters(found.intrinsics),
        ]
        squared.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        assert found.size == pytest.approx(1.02, abs=0.005)
        assert found.noise[0] == pytest.approx(4e-4, rel=0.5) and found.rms_px < 2 * NOISE_PX
    # The mean square of 30 parameters is 1 ± 0.26.
    assert 0.22 < np.mean(squared) < 1.78


def test_every_recipe_names_a_commit_a_licence_and_what_it_makes():
    known = recipes()
    assert len(known) == 15
    for name, recipe in known.items():
        assert len(recipe.commit) == 40 and len(recipe.sha256) == 64 and recipe.licence, name
