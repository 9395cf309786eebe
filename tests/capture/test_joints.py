"""Joint angles of recordings: interpolation across ±π, and the forward kinematics of a URDF's chain."""

from pathlib import Path

import numpy as np
import pytest

from capture_writers import LIMIT, URDF, arm_poses
from jcr.capture.options import ReadOptions
from jcr.capture.urdf_chain import read_arm, read_chain
from refusal import refused

MIMIC = URDF.replace(
    f'<axis xyz="1 0 0"/>{LIMIT}</joint>',
    f'<axis xyz="1 0 0"/>{LIMIT}<mimic joint="lift" multiplier="2" offset="0.1"/></joint>',
)


def arm_of(folder: Path, text: str, **options):
    (folder / "arm.urdf").write_text(text)
    return read_arm(ReadOptions(urdf=folder / "arm.urdf", gripper_frame="tool0", **options))


def test_forward_kinematics_agree_with_a_hand_computation(tmp_path: Path):
    angles = np.random.default_rng(0).uniform(-3, 3, (5, 3))
    arm = arm_of(tmp_path, URDF)
    assert arm.joints == ("pan", "lift", "roll")
    np.testing.assert_allclose(arm.poses(angles, ""), arm_poses(angles), atol=1e-12)
    # From a link in the middle, the joints before it are another arm's.
    ahead = read_arm(ReadOptions(urdf=tmp_path / "arm.urdf", gripper_frame="upper"))
    behind = arm_of(tmp_path, URDF, base_frame="upper")
    assert (ahead.joints, behind.joints) == (("pan",), ("lift", "roll"))
    whole = ahead.poses(angles[:, :1], "") @ behind.poses(angles[:, 1:], "")
    np.testing.assert_allclose(whole, arm_poses(angles), atol=1e-12)


@pytest.mark.parametrize(("options", "words"), [
    ({}, "a link: choose one with --gripper-frame: base_link, upper"),
    ({"gripper_frame": "nose"}, "a link: nose is not there; choose one with --gripper-frame: base_link, upper"),
    ({"gripper_frame": "base_link"}, "nothing moves between base_link and base_link"),
    ({"gripper_frame": "tool0", "base_frame": "finger"}, "no joints lead from finger to tool0"),
])  # fmt: skip
def test_frames_between_which_there_is_no_arm_are_named(tmp_path: Path, options: dict, words: str):
    (tmp_path / "arm.urdf").write_text(URDF)
    with refused(words):
        read_arm(ReadOptions(urdf=tmp_path / "arm.urdf", **options))


def test_what_is_no_urdf_is_refused(tmp_path: Path):
    joints = "".join(
        f'<joint name="{a}{b}" type="revolute"><parent link="{a}"/><child link="{b}"/><axis xyz="0 0 1"/></joint>'
        for a, b in ("ab", "bc", "ca")
    )
    ring = f'<robot name="ring"><link name="a"/><link name="b"/><link name="c"/>{joints}</robot>'
    for text, words in (("<robot", "not a readable URDF"), (ring, "lead back")):
        with refused(words):
            arm_of(tmp_path, text)


@pytest.mark.parametrize("units", ["m-rad", "m-deg"])
def test_an_angle_that_wraps_is_interpolated_the_shorter_way(tmp_path: Path, units: str):
    arm = arm_of(tmp_path, URDF, pose_units=units)
    turn = 360.0 if units == "m-deg" else 2 * np.pi
    stamps = np.array([0, 10_000_000])
    pan, still = np.array([0.49, -0.49]) * turn, np.zeros(2)
    samples = [(stamps, pan), (stamps, still), (stamps, still)]
    recorded, gap = arm.interpolated(samples, np.array([5_000_000]))
    np.testing.assert_allclose(arm.poses(recorded, ""), arm_poses(np.array([[np.pi, 0, 0]])), atol=1e-12)
    assert gap.tolist() == [10_000_000]


@pytest.mark.parametrize(("text", "dof", "words"), [
    (URDF, 5, "no chain with 5 joints; give one angle for each joint"),
    (URDF, 4, "joint grip is prismatic; errors of arms are modelled for rotating joints only"),
    (MIMIC, 3, "joint roll is coupled to another"),
])  # fmt: skip
def test_joints_that_are_no_chain_of_the_urdf_are_refused(tmp_path: Path, text: str, dof: int, words: str):
    (tmp_path / "arm.urdf").write_text(text)
    with refused(rf"arm\.urdf: {words}"):
        read_chain(tmp_path / "arm.urdf", dof)


def test_recorded_joints_that_do_not_rotate_by_themselves_are_refused(tmp_path: Path):
    with refused("joint roll is coupled to another"):
        arm_of(tmp_path, MIMIC)
