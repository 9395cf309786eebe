"""Gripper poses that contradict the images: the first message names poses, pairing, order or convention."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jcr
from jcr.calibration.stage import calibrate_reconstruction
from jcr.findings import FindingKind, kinds_of, without_consequences
from jcr.geometry import inverse, rotation_exp, transform
from jcr.pipeline.check import check_capture
from jcr.records import Capture, Reconstruction
from jcr.sfm.colmap import reconstruct_colmap
from simulation.faults import Faults, faulty_capture, reconstructed

Change = Callable[[np.ndarray], np.ndarray]
OTHER = "franka_wood_table"


def permuted(seed: int) -> Change:
    return lambda poses: poses[np.random.default_rng(seed).permutation(len(poses))]


def half_permuted(poses: np.ndarray) -> np.ndarray:
    half = len(poses) // 2
    return np.concatenate([poses[:half], permuted(3)(poses[half:])])


def with_quaternion(order: list[int]) -> Change:
    def change(poses: np.ndarray) -> np.ndarray:
        quat_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        return transform(Rotation.from_quat(quat_xyzw[:, order]).as_matrix(), poses[:, :3, 3])

    return change


def euler_misread(poses: np.ndarray) -> np.ndarray:
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
    return transform(Rotation.from_euler("xyz", angles).as_matrix(), poses[:, :3, 3])


def four_permuted(poses: np.ndarray) -> np.ndarray:
    """Return poses of which a third is permuted in one cycle, the others agree."""
    changed = poses.copy()
    changed[[4, 6, 9, 11]] = poses[[6, 9, 11, 4]]
    return changed


CONTRADICT: dict[str, Change] = {
    **{f"permuted {seed}": permuted(seed) for seed in range(3)},
    "second half permuted": half_permuted,
    "four permuted": four_permuted,
}
"""Poses that no other reading explains."""
READ_WRONG: dict[str, tuple[Change, str]] = {
    "off by one": (lambda poses: np.roll(poses, 1, axis=0), "1 ahead"),
    "off by two": (lambda poses: np.roll(poses, -2, axis=0), "2 behind"),
    "reversed": (lambda poses: poses[::-1].copy(), "reverse order"),
    "wxyz taken as xyzw": (with_quaternion([3, 0, 1, 2]), "quaternions w, x, y, z"),
    "xyzw taken as wxyz": (with_quaternion([1, 2, 3, 0]), "quaternions x, y, z, w"),
    "inverted": (inverse, "their inverses"),
    "transposed": (
        lambda poses: transform(np.swapaxes(poses[:, :3, :3], 1, 2), poses[:, :3, 3]),
        "transposed rotations",
    ),
    "Euler angles": (euler_misread, "Euler angles ZYX"),
}
"""Poses that fit when read otherwise, and how."""
OF_POSES = (FindingKind.POSES_CONTRADICT_IMAGES, FindingKind.FEW_AGREE, FindingKind.POSES_SWAPPED)
CONSEQUENCES = kinds_of("camera", "order", "strain", "robot")
"""Kinds that such poses look like."""


def with_poses(capture: Capture, poses: np.ndarray) -> Capture:
    return replace(capture, base_from_gripper=np.ascontiguousarray(poses), joints=None)


def first_kinds(capture: Capture, reconstruction: Reconstruction) -> tuple[list[FindingKind], str]:
    """Return the kinds of what is said of a rejected calibration, and its reason."""
    found = calibrate_reconstruction(capture, reconstruction)
    said = [one.kind for one in without_consequences(found.findings) if one.severity != "informs"]
    assert not found.converged and not CONSEQUENCES & {one.kind for one in found.findings}
    assert found.doubt is not None
    return said, found.doubt


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "contradict", "read_wrong"),
    [
        ("cobotta_stage", ["permuted 2", "of another capture", "second half permuted"], list(READ_WRONG)),
        ("ur_snack_table", ["second half permuted", "of another capture"], list(READ_WRONG)[::4]),
        # Five of its poses are then permuted in one cycle, and the other ten images agree.
        ("elephant_floor", ["second half permuted"], []),
    ],
)
def test_the_first_message_names_the_poses(
    real_captures: Path, name: str, contradict: list[str], read_wrong: list[str]
):
    """Focal lengths that differ by 0.2 % led, where the poses were 60 mm and 13° from the images."""
    capture = jcr.read_capture(real_captures / name)
    changes: dict[str, Change] = {
        **CONTRADICT,
        "of another capture": lambda _: jcr.read_capture(real_captures / OTHER).base_from_gripper,
    }
    for what, change in ((one, changes[one]) for one in contradict):
        poses = np.resize(change(capture.base_from_gripper), capture.base_from_gripper.shape)
        wrong = with_poses(capture, poses)
        said, _ = first_kinds(wrong, reconstruct_colmap(wrong))
        assert said[0] in OF_POSES and check_capture(wrong).findings[0].kind in OF_POSES, (what, said)
    for what in read_wrong:
        change, words = READ_WRONG[what]
        wrong = with_poses(capture, change(capture.base_from_gripper))
        said, doubt = first_kinds(wrong, reconstruct_colmap(wrong))
        assert said[0] is FindingKind.POSE_CONVENTION and words in doubt, (what, doubt)


@pytest.fixture(scope="module")
def faultless() -> tuple[Capture, Reconstruction]:
    return reconstructed(faulty_capture(np.random.default_rng(0), 12, Faults()), estimated=False)


@pytest.mark.slow
@pytest.mark.parametrize("change", CONTRADICT.values(), ids=CONTRADICT)
def test_poses_that_contradict_simulated_images_lead(
    faultless: tuple[Capture, Reconstruction], change: Change
):
    capture, made = faultless
    said, _ = first_kinds(with_poses(capture, change(capture.base_from_gripper)), made)
    assert said[0] in OF_POSES


@pytest.mark.slow
def test_a_reconstruction_in_pieces_leads(faultless: tuple[Capture, Reconstruction]):
    """A pattern that repeats lets part of the images register one period away from where they belong."""
    capture, made = faultless
    away = transform(rotation_exp(np.array([0.05, -0.1, 0.3])), np.array([0.3, 0.1, 0.0]))
    astray = np.arange(12) % 5 % 2 == 1
    camera = made.recon_from_camera.copy()
    camera[astray] = away @ camera[astray]
    nothing = made.tracks.only(np.zeros(len(made.tracks.image), bool))
    found = calibrate_reconstruction(capture, replace(made, recon_from_camera=camera, tracks=nothing))
    assert found.findings[0].kind is FindingKind.PIECES, found.warnings
    assert set(found.findings[0].images) == {capture.images[k] for k in np.flatnonzero(astray)}
