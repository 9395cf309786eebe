"""Recipes of real captures: a capture is built from a commit of a repository, and wrong content is refused."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.real_captures.fetch import Recipe, build, recipes
from jcr.capture.controllers import numbers_from_poses
from jcr.capture.read import read_capture
from jcr.errors import InputError
from simulation.problems import hand_eye_problem


@pytest.mark.slow
def test_a_capture_is_built_from_a_commit_and_wrong_content_is_refused(tmp_path: Path):
    folder, poses = tmp_path / "repository", hand_eye_problem(np.random.default_rng(0), 11).base_from_gripper
    (folder / "data").mkdir(parents=True)
    for k in range(11):
        grey = np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(grey).save(folder / "data" / f"view_{k}.png")
    rows = numbers_from_poses(poses, "rotation-vector")
    (folder / "data" / "poses.txt").write_text("\n".join(", ".join(map(repr, row)) for row in rows.tolist()))

    def git(*words: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(["git", "-C", str(folder), *identity, *words], check=True, capture_output=True)
        return done.stdout.decode().strip()

    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "-m", "data")
    recipe = Recipe(
        repository=str(folder),
        commit=git("rev-parse", "HEAD"),
        licence="MIT",
        images="data/view_*.png",
        poses="data/poses.txt",
        convention="rotation-vector",
        use_images="1:",
        use_poses=[1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
        intrinsics=[60.0, 61.0, 31.5, 23.5],
    )
    capture = read_capture(build(recipe, tmp_path / "capture"))
    # Names are in the order of their numbers, not of their letters.
    assert capture.images[1] == "images/view_2.png" and capture.images[-1] == "images/view_10.png"
    np.testing.assert_allclose(capture.base_from_gripper, poses[1:], atol=1e-12)
    assert capture.intrinsics is not None and capture.intrinsics.fy == 61.0
    assert (
        json.loads((tmp_path / "capture" / "capture.json").read_text())["source"]["commit"] == recipe.commit
    )
    # A clone that is there already is used as it is; other content than the recipe's is refused.
    with pytest.raises(InputError, match="not that of the recipe"):
        build(replace(recipe, repository="nowhere", sha256="0"), tmp_path / "other", str(folder))
    with pytest.raises(InputError, match="11 images and 10 poses"):
        build(replace(recipe, use_images=":"), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_every_recipe_names_a_commit_a_licence_and_what_it_makes():
    known = recipes()
    assert len(known) == 14
    for name, recipe in known.items():
        assert len(recipe.commit) == 40 and len(recipe.sha256) == 64 and recipe.licence, name
