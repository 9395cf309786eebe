"""Each way of writing poses wrongly is named, and sound poses never are."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from jcr.calibration.checks import convention
from jcr.calibration.checks.convention import MIRRORED, better_reading
from jcr.capture.notations import numbers_of, poses_of
from jcr.capture.pairing import AS_NUMBERS, AS_TEXT
from jcr.estimation.pose_misfit import Misfit, pose_misfit
from jcr.findings import FindingKind, sentence
from jcr.geometry import inverse, rotation_exp
from jcr.records import Reading
from scenes import MISTAKES
from simulation.problems import hand_eye_problem

pytestmark = pytest.mark.slow


def misfit(words: object) -> float:
    """Return the misfit (mm) that a finding states: translation plus 5 mm per degree."""
    mm, deg = re.findall(r"[\d.]+", str(words))[:2]
    return float(mm) + 5 * float(deg)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named(mistake: str):
    write, words = MISTAKES[mistake]
    problem = hand_eye_problem(
        np.random.default_rng(1), 9, robot_noise=(2e-4, 5e-4), camera_noise=(1e-4, 1e-4)
    )
    # Rows of images: pairs of poses do not tell inverses of the gripper from inverses of the marker.
    (found,) = better_reading(write(problem.base_from_gripper), problem.recon_from_camera, rows=np.arange(9))
    assert re.search(words, sentence(found)) and found.value is not None
    # Where only rotations are misread, positions may still fit to 0.4 mm, with rotations that are tens of degrees off.
    assert misfit(found.details["fits"]) < 1.0 and found.value < 0.5e-3
    assert found.details["given"] == "no fit" or misfit(found.details["given"]) > 10.0
    assert found.kind is FindingKind.POSE_CONVENTION


def test_images_that_are_mirrored_are_named():
    problem = hand_eye_problem(np.random.default_rng(3), 10, robot_noise=(2e-4, 5e-4))
    mirror = np.diag([-1, 1, 1, 1.0])
    (found,) = better_reading(problem.base_from_gripper, mirror @ problem.recon_from_camera @ mirror)
    assert found.details["reading"] == MIRRORED and "over 10 images" in str(found.details["fits"])


def test_rows_in_another_order_of_the_images_names_are_named():
    problem = hand_eye_problem(np.random.default_rng(2), 12, robot_noise=(2e-4, 5e-4))
    names, poses = [f"images/{k}.png" for k in range(1, 13)], problem.base_from_gripper
    by_text = sorted(range(12), key=lambda k: names[k])
    # Rows of a table in order of the names as text, images paired as people count; and the other way round.
    for images, rows, order in (
        (names, poses[by_text], AS_TEXT),
        ([names[k] for k in by_text], poses, AS_NUMBERS),
    ):
        cameras = problem.recon_from_camera[[int(Path(name).stem) - 1 for name in images]]
        (found,) = better_reading(rows, cameras, names=images, rows=np.arange(12))
        assert found.details["reading"] == order and "add a column image" in sentence(found)


def test_the_order_counts_images_without_a_camera_pose():
    """The reverse order of the images that registered is no reverse order."""
    problem = hand_eye_problem(np.random.default_rng(4), 10, robot_noise=(2e-4, 5e-4))
    rows = np.array([0, 2, 3, 4, 5, 6, 7, 8, 9])
    (found,) = better_reading(problem.base_from_gripper[::-1], problem.recon_from_camera[rows], rows=rows)
    assert "reverse order" in str(found.details["reading"]) and "over 9 images" in str(found.details["fits"])


@pytest.mark.parametrize("noise", [(0.0, 0.0), (5e-3, np.radians(1.0))])
def test_sound_poses_are_left_alone(noise):
    problem = hand_eye_problem(np.random.default_rng(0), 10, robot_noise=noise)
    assert better_reading(problem.base_from_gripper, problem.recon_from_camera) == ()


def test_poses_of_another_capture_are_not_fitted_in_readings_whose_angles_differ(
    monkeypatch: pytest.MonkeyPatch,
):
    """The angles of gripper and camera rule out each reading before it is fitted."""
    fitted = list[int]()

    def counting(*poses: ndarray) -> Misfit:
        fitted.append(1)
        return pose_misfit(*poses)

    monkeypatch.setattr(convention, "pose_misfit", counting)
    gripper = hand_eye_problem(np.random.default_rng(8), 20).base_from_gripper
    turned = np.stack([rotation_exp(one) for one in np.random.default_rng(9).normal(size=(20, 3))])
    cameras = hand_eye_problem(np.random.default_rng(10), 20).recon_from_camera
    cameras[:, :3, :3] = turned
    assert better_reading(gripper, cameras, rows=np.arange(20)) == ()
    assert len(fitted) == 1  # the given poses


def test_a_wrong_name_or_option_is_found_by_the_readings_it_ruled_out():
    """ZYZ angles that were read as ZYX: the remedy is an option that reads the file."""
    problem = hand_eye_problem(np.random.default_rng(5), 10, robot_noise=(2e-4, 5e-4))
    numbers, position = (
        numbers_of(problem.base_from_gripper[:, :3, :3], "euler:ZYZ"),
        problem.base_from_gripper[:, :3, 3],
    )
    kinds = ("euler:XYZ", "euler:ZYZ", "rotvec")
    untaken = [(Reading(file="poses.csv", notation=one), poses_of(position, numbers, one)) for one in kinds]
    (found,) = better_reading(
        poses_of(position, numbers, "euler:ZYX"), problem.recon_from_camera, rows=np.arange(10),
        untaken=untaken,
    )  # fmt: skip
    assert found.details["remedy"] == "give --pose-convention euler:ZYZ"
    assert found.details["pose_convention"] == "euler:ZYZ" and misfit(found.details["fits"]) < 1.0


def test_inverted_samples_name_both_possibilities():
    """Of pairs without images, the gripper's or the marker's poses may be inverted: G⁻¹·X = Z·C and G·Z = X·C⁻¹."""
    problem = hand_eye_problem(np.random.default_rng(6), 10)
    near = np.linalg.norm(problem.gripper_from_camera[:3, 3])
    for gripper, cameras in (
        (inverse(problem.base_from_gripper), problem.recon_from_camera),
        (problem.base_from_gripper, inverse(problem.recon_from_camera)),
    ):
        (found,) = better_reading(gripper, cameras)
        assert found.kind is FindingKind.INVERTED_PAIR and found.severity == "rejects"
        distances = (found.value, found.details["other"])
        assert min(abs(float(one) - near) for one in distances if one is not None) < 1e-6


def test_poses_of_the_camera_itself_are_named():
    """A board's inverse pose, given for the robot's: gripper_from_camera would be the identity."""
    problem = hand_eye_problem(np.random.default_rng(7), 10)
    (found,) = better_reading(
        inverse(problem.base_from_camera), problem.recon_from_camera, rows=np.arange(10)
    )
    assert found.kind is FindingKind.POSES_OF_CAMERA and found.severity == "rejects"
