"""Each way of writing poses wrongly is named, and sound poses never are."""

import re
from pathlib import Path

import numpy as np
import pytest

from jcr.calibration.checks.convention import BY_NUMBER, BY_TEXT, MIRRORED, better_reading
from jcr.capture.pairing import paired_by_name
from jcr.findings import sentence
from scenes import MISTAKES
from simulation.problems import hand_eye_problem


def misfit(words: object) -> float:
    """Return the misfit (mm) that a finding states: translation plus 5 mm per degree."""
    mm, deg = re.findall(r"[\d.]+", str(words))[:2]
    return float(mm) + 5 * float(deg)


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named(mistake: str):
    write, words = MISTAKES[mistake]
    problem = hand_eye_problem(
        np.random.default_rng(1), 9, robot_noise=(2e-4, 5e-4), camera_noise=(1e-4, 1e-4)
    )
    (found,) = better_reading(write(problem.base_from_gripper), problem.recon_from_camera)
    assert re.search(words, sentence(found)) and found.value is not None
    # Where only rotations are misread, positions may still fit to 0.4 mm, with rotations that are tens of degrees off.
    assert misfit(found.details["fits"]) < 1.0 and found.value < 0.5e-3
    assert misfit(found.details["given"]) > 10.0


@pytest.mark.slow
def test_images_that_are_mirrored_are_named():
    problem = hand_eye_problem(np.random.default_rng(3), 10, robot_noise=(2e-4, 5e-4))
    mirror = np.diag([-1, 1, 1, 1.0])
    (found,) = better_reading(problem.base_from_gripper, mirror @ problem.recon_from_camera @ mirror)
    assert found.details["reading"] == MIRRORED and "over 10 images" in str(found.details["fits"])


@pytest.mark.slow
def test_rows_in_another_order_of_the_images_names_are_named():
    problem = hand_eye_problem(np.random.default_rng(2), 12, robot_noise=(2e-4, 5e-4))
    names, poses = [f"images/{k}.png" for k in range(1, 13)], problem.base_from_gripper
    by_text = sorted(range(12), key=lambda k: names[k])
    # Rows of a table in order of the names as text, images paired as people count; and the other way round.
    for images, rows, order in (
        (names, poses[by_text], BY_TEXT),
        ([names[k] for k in by_text], poses, BY_NUMBER),
    ):
        cameras = problem.recon_from_camera[[int(Path(name).stem) - 1 for name in images]]
        (found,) = better_reading(rows, cameras, by_name=paired_by_name(images, rows))
        assert found.details["reading"] == order and "add a column image" in sentence(found)


@pytest.mark.slow
def test_the_order_counts_images_without_a_camera_pose():
    """The reverse order of the images that registered is no reverse order."""
    problem = hand_eye_problem(np.random.default_rng(4), 10, robot_noise=(2e-4, 5e-4))
    rows = np.array([0, 2, 3, 4, 5, 6, 7, 8, 9])
    (found,) = better_reading(problem.base_from_gripper[::-1], problem.recon_from_camera[rows], rows=rows)
    assert "reverse order" in str(found.details["reading"]) and "over 9 images" in str(found.details["fits"])


@pytest.mark.slow
@pytest.mark.parametrize("noise", [(0.0, 0.0), (5e-3, np.radians(1.0))])
def test_sound_poses_are_left_alone(noise):
    problem = hand_eye_problem(np.random.default_rng(0), 10, robot_noise=noise)
    assert better_reading(problem.base_from_gripper, problem.recon_from_camera) == ()
