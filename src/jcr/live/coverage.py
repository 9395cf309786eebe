"""What the images taken so far will tell, and the pose that adds most; as text and as an answer."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.expected import (
    FEWEST,
    Ahead,
    Expectation,
    assumed,
    expected,
    typical_camera,
)
from jcr.calibration.robot_errors import RobotErrors, errors_of, of_poses
from jcr.errors import InputError
from jcr.handeye.observability import observability
from jcr.live.arm_words import ArmWords, Path, joints_at, pose_lines
from jcr.live.asks import Answer
from jcr.live.folder import LiveFolder
from jcr.records import NextPose
from jcr.rounding import significant

ALTERNATIVES = 6
"""Proposals; the first that the arm reaches is taken."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How far a capture is."""

    images: int
    unseen: tuple[str, ...]
    """What the motions do not show yet, in words."""
    expected: tuple[Expectation, ...]
    """With the first 3, 4, … images, if all register; of a usual robot and usual images."""
    next_pose: NextPose | None = None
    next_joints: Float[ndarray, " dof"] | None = None
    """rad; None where the arm is not known."""
    like: str | None = None
    """The image nearest to the next pose."""
    words: ArmWords

    @property
    def now(self) -> Expectation | None:
        """With all images; None below three."""
        return self.expected[-1] if self.expected else None


def coverage(
    live: LiveFolder,
    reach: Float[ndarray, "2 3"] | None = None,
    words: ArmWords | None = None,
    before: Coverage | None = None,
) -> Coverage:
    """What the gripper poses in the folder will show, whatever is in the images; `before` is what earlier ones did."""
    words = words or ArmWords()
    if len(places := live.places()) < 2:
        return Coverage(images=len(places), unseen=(), expected=(), words=words)
    capture = live.capture()
    poses, joints = capture.base_from_gripper, capture.joints
    camera = typical_camera(capture.intrinsics, capture.image_size)
    assumptions, robot = assumed(poses, camera), _errors(poses, words, joints)
    proposed = Ahead.of(assumptions, poses, robot, ALTERNATIVES if words.arm else 1, reach)
    row, next_joints = reachable(proposed.added, Path(poses, joints), words)
    chosen = replace(proposed, added=proposed.added[row : row + 1])
    known = () if before is None else before.expected
    rows = [np.arange(count) for count in range(FEWEST + len(known), len(poses) + 1)]
    more = [expected(assumptions, poses[some], of_poses(robot.systematic, some)) for some in rows]
    next_pose = chosen.next_pose(1, chosen.expected(1))
    return Coverage(
        images=len(poses),
        unseen=observability(poses).unobservable,
        expected=(*known, *more),
        next_pose=next_pose,
        next_joints=next_joints,
        like=capture.images[next_pose.like],
        words=words,
    )


def _errors(
    poses: Float[ndarray, "n 4 4"], words: ArmWords, joints: Float[ndarray, "n dof"] | None
) -> RobotErrors:
    """Of the arm that is named, where the poses are its own."""
    try:
        return errors_of(poses, words.arm, joints)
    except InputError:
        return errors_of(poses)


def reachable(
    proposed: Float[ndarray, "c 4 4"], path: Path, words: ArmWords
) -> tuple[int, Float[ndarray, " dof"] | None]:
    """The first proposal that the arm reaches within its joint limits, and the angles; else the first, without."""
    if words.arm is not None:
        for row, pose in enumerate(proposed):
            if (joints := joints_at(words.arm, path, pose)) is not None:
                return row, joints
    return 0, None


def in_words(found: Coverage) -> list[str]:
    """A line on what is covered, and lines with the next pose."""
    if found.next_pose is None:
        first = "one image; " if found.images else "no image yet; "
        return [first + "rotate the wrist by 20° or more, and move, between images"]
    pose = found.next_pose
    lines = [f"{found.images} images" + "".join(f"; not observable yet: {name}" for name in found.unseen)]
    if (now := found.now) is not None and not found.unseen:
        mm, deg = (significant(value) for value in now.reached("seen"))
        far = significant(1e-3 * now.seen.distance_mm)
        lines[0] += (
            f"; a point seen at {far} m is expected within {mm} mm and {deg}° (95 % of errors, usual robot)"
        )
    moved, rotated = 1e3 * pose.moved_m, np.degrees(pose.rotation_rad)
    then = f", then {significant(pose.within_95_mm)} mm" if now is not None else ""
    lines.append(f"best next: {moved:.0f} mm and {rotated:.0f}° from {found.like}{then}")
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
        "pictures": found.images,
        "unobservable": list(found.unseen),
        "expected_std": None if now is None else now.std.tolist(),
        "expected_seen": None if now is None else vars(now.seen),
        "next_base_from_gripper": None if pose is None else pose.base_from_gripper.tolist(),
        "next_joints": None if found.next_joints is None else found.next_joints.tolist(),
    }
