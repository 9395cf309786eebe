"""What the images taken so far will tell, and the pose that adds most; as text and as an answer."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.handeye.equation import ASSUMED_NOISE, expected_std, pose_information
from jcr.handeye.next_poses import next_poses
from jcr.handeye.observability import observability
from jcr.live.arm_words import ArmWords, Path, joints_at, pose_lines
from jcr.live.asks import Answer
from jcr.live.folder import LiveFolder
from jcr.records import NextPose

ALTERNATIVES = 6
"""Proposals; the first that the arm reaches is taken."""


@dataclass(frozen=True)
class Coverage:
    """How far a capture is."""

    pictures: int
    unseen: tuple[str, ...]
    """What the motions do not show yet, in words."""
    expected_std: Float[ndarray, "k 7"]
    """records.COVARIANCE_ORDER, one sigma expected with the first 3, 4, … images."""
    next_pose: NextPose | None
    next_joints: Float[ndarray, " dof"] | None
    """rad; None where the arm is not known."""
    like: str | None
    """The image nearest to the next pose."""
    words: ArmWords

    @property
    def now(self) -> Float[ndarray, "7"] | None:
        """One sigma expected with all images; None below three."""
        return self.expected_std[-1] if len(self.expected_std) else None


def coverage(
    live: LiveFolder, reach: Float[ndarray, "2 3"] | None = None, words: ArmWords | None = None
) -> Coverage:
    """What the gripper poses in the folder will show, whatever is in the images."""
    words = words or ArmWords()
    if len(live.poses) < 2:
        return Coverage(len(live.poses), (), np.zeros((0, 7)), None, None, None, words)
    poses = np.stack(live.poses)
    known = pose_information(poses, np.eye(4), ASSUMED_NOISE).cumsum(0)
    _, proposed = next_poses(poses, ALTERNATIVES if words.arm else 1, reach=reach)
    chosen, joints = _reachable(proposed, Path(poses, live.all_joints()), words)
    return Coverage(
        len(poses),
        observability(poses).unobservable,
        expected_std(known[2:]),
        chosen,
        joints,
        live.names[chosen.like],
        words,
    )


def _reachable(
    proposed: list[NextPose], path: Path, words: ArmWords
) -> tuple[NextPose, Float[ndarray, " dof"] | None]:
    """The first proposal that the arm reaches within its joint limits, and the angles; else the first, without."""
    if words.arm is None:
        return proposed[0], None
    for pose in proposed:
        if (joints := joints_at(words.arm, path, pose.base_from_gripper)) is not None:
            return pose, joints
    return proposed[0], None


def in_words(found: Coverage) -> list[str]:
    """A line on what is covered, and lines with the next pose."""
    if found.next_pose is None:
        first = "one image; " if found.pictures else "no image yet; "
        return [first + "rotate the wrist by 20° or more, and move, between images"]
    pose = found.next_pose
    lines = [f"{found.pictures} images" + "".join(f"; not observable yet: {name}" for name in found.unseen)]
    if (now := found.now) is not None and not found.unseen:
        offset = ", ".join(f"{1e3 * value:.2g}" for value in now[:3])
        lines[0] += f"; expected ± {offset} mm, scale {100 * now[6]:.2g} %"
    moved, turned = 1e3 * pose.moved_m, np.degrees(pose.turned_rad)
    lines.append(f"best next: {moved:.0f} mm and {turned:.0f}° from {found.like}")
    return lines + [f"  {line}" for line in next_lines(found)]


def next_lines(found: Coverage) -> list[str]:
    """The next pose in the words of the arm."""
    if found.next_pose is None:
        return []
    lines = pose_lines(found.next_pose.base_from_gripper, found.words, found.next_joints)
    if found.words.arm is not None and found.next_joints is None:
        lines.append(f"a {found.words.arm.name} cannot reach this pose within its joint limits: go near it")
    return lines


def as_answer(found: Coverage) -> Answer:
    """The same for a program."""
    pose, now = found.next_pose, found.now
    return {
        "pictures": found.pictures,
        "unobservable": list(found.unseen),
        "expected_std": None if now is None else now.tolist(),
        "next_base_from_gripper": None if pose is None else pose.base_from_gripper.tolist(),
        "next_joints": None if found.next_joints is None else found.next_joints.tolist(),
    }
