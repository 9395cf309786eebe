"""How exact a calibration will be, before it is made: one expectation for `jcr check` and proposed poses.

It is the covariance that the calibration itself would report, by its own equations (estimation/foreseen.py where there
are images, estimation/fit.py where camera poses are given): of the gripper poses, of what is known of the intrinsics
before, of random and systematic errors of the robot, and of how much images tell. The last two are those that a
calibration of some of the images found, else usual ones.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.calibration.adjust import estimate_in
from jcr.calibration.case import Case
from jcr.calibration.robot_errors import RobotErrors, of_poses
from jcr.calibration.seen import Scene, in_use, within_95
from jcr.estimation.equation import Poses, point_ahead, uncertainty
from jcr.estimation.foreseen import ForeseenCamera, expected_pose_covariance, foreseen
from jcr.estimation.intrinsics_prior import camera_about
from jcr.estimation.mixed_model import GIVEN_SHARE, TYPICAL
from jcr.estimation.next_poses import assumed_camera, candidates, looked_at, nearest, next_poses
from jcr.estimation.problem import LinearPrior, scale_prior
from jcr.estimation.wrist import wrist_arm
from jcr.geometry import inverse, rotation_angle
from jcr.least_squares import one_blas_thread
from jcr.records import Estimate, HandEye, Intrinsics, NextPose, RobotNoise, Seen, Where

COMPARED, TOO_MANY = 20, 40
"""Poses that are compared, beside those that are most informative of random errors, by what systematic errors of the
robot leave; and poses of a capture from which on the most informative ones are proposed as they are."""
FEWEST = 3
"""Poses, from which on something is expected."""
USUAL_FOCAL = 0.8
"""Of the width: an unknown focal length: of a camera that sees 64° across."""


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """What the exactness of a calibration depends on beside the gripper poses."""

    gripper_from_camera: Float[ndarray, "4 4"]
    distance_m: float
    """From the camera to the scene."""
    noise: RobotNoise
    camera: ForeseenCamera | None = None
    """None: camera poses are given, and exact."""
    scale_std: float | None = None
    """How well the scale is known beforehand (relative); None: not at all."""
    faults: Float[ndarray, "7 7"] | None = None
    """What findings add to the covariance; None: nothing."""

    @property
    def priors(self) -> tuple[LinearPrior, ...]:
        """Measurement of the scale."""
        return () if self.scale_std is None else (scale_prior(1.0, self.scale_std),)


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """What a calibration is expected to report."""

    estimate: Estimate
    seen: Seen
    """Of a point at the centre of the image, at the distance of the scene."""

    @property
    def std(self) -> Float[ndarray, "7"]:
        """In COVARIANCE_ORDER."""
        return np.sqrt(np.diag(self.estimate.covariance))

    def reached(self, at: Where) -> tuple[float, float]:
        """mm and degrees that 95 % of errors stay below; mapped points are taken for points that are seen."""
        if at != "camera":
            return self.seen.within_95_mm, self.seen.rotation_95_deg
        covariance = self.estimate.covariance
        return 1e3 * within_95(covariance[:3, :3]), float(np.degrees(within_95(covariance[3:6, 3:6])))


@dataclass(frozen=True, kw_only=True)
class Ahead:
    """Poses to add to those of a capture, best first, and what a calibration with them is expected to report."""

    assumptions: Assumptions
    base_from_gripper: Float[ndarray, "n 4 4"]
    robot: RobotErrors
    """Of the poses of the capture."""
    added: Float[ndarray, "c 4 4"]

    @staticmethod
    def of(
        assumptions: Assumptions,
        base_from_gripper: Poses,
        robot: RobotErrors,
        count: int,
        reach: Float[ndarray, "2 3"] | None = None,
        seed: int = 0,
        is_likely: Callable[[Poses], Bool[ndarray, " k"]] | None = None,
    ) -> "Ahead":
        """The `count` that help most; `robot` is of the others, `reach` as `candidates` takes it, drawn with `seed`.

        `is_likely`: whether an image at a pose is likely to register; others are taken only where none is.
        """
        x, noise = assumptions.gripper_from_camera, assumptions.noise
        of_random, distance = (noise.translation, noise.rotation), assumptions.distance_m
        possible = candidates(base_from_gripper, x, reach, np.random.default_rng(seed))
        if is_likely is not None and (likely := is_likely(possible)).any():
            possible = possible[likely]
        added = next_poses(base_from_gripper, possible, count, x, of_random, distance)
        ahead = Ahead(assumptions=assumptions, base_from_gripper=base_from_gripper, robot=robot, added=added)
        if count == 0 or len(base_from_gripper) > TOO_MANY:
            return ahead
        return replace(ahead, added=np.concatenate([added, possible[:COMPARED]]))._best(count)

    def _best(self, count: int) -> "Ahead":
        """The `count` of them that leave the least, systematic errors of the robot included, chosen one by one."""
        now, x = self.base_from_gripper, self.assumptions.gripper_from_camera
        systematic, noise = self.robot.with_poses(now, self.added), self.assumptions.noise
        point, priors = point_ahead(x, self.assumptions.distance_m), self.assumptions.priors
        chosen, left = list[int](), list(range(len(self.added)))

        def remaining(row: int) -> float:
            rows = np.r_[np.arange(len(now)), len(now) + np.array([*chosen, row])]
            poses = np.concatenate([now, self.added])[rows]
            of_rows = of_poses(systematic, rows)
            return float(
                uncertainty(expected_pose_covariance(poses, x, noise, of_rows, priors, averaged=False), point)
            )

        for _ in range(count):
            best = min(left, key=remaining)
            chosen.append(best)
            left.remove(best)
        return replace(self, added=self.added[chosen])

    def expected(self, count: int) -> Expectation:
        """With the first `count` of them."""
        now, added = self.base_from_gripper, self.added[:count]
        return expected(self.assumptions, np.concatenate([now, added]), self.robot.with_poses(now, added))

    def next_pose(self, count: int, then: Expectation) -> NextPose:
        """The last of the first `count`, and what is expected with these."""
        pose = self.added[count - 1]
        like = int(nearest(pose[None], self.base_from_gripper)[0])
        motion = inverse(self.base_from_gripper[like]) @ pose
        return NextPose(
            base_from_gripper=pose,
            expected_std=then.std,
            within_95_mm=then.seen.within_95_mm,
            rotation_95_deg=then.seen.rotation_95_deg,
            like=like,
            moved_m=float(np.linalg.norm(motion[:3, 3])),
            rotation_rad=float(rotation_angle(motion[:3, :3])),
        )


def assumed_of(case: Case) -> Assumptions:
    """That further images and gripper poses are as those of an accepted calibration."""
    assumptions = assumed_of_poses(
        case.hand_eye, case.base_from_gripper[case.used], case.reconstruction.metric_std
    )
    if case.adjusted is None or (distance := case.scene_distance_m) is None:
        return assumptions
    return replace(assumptions, distance_m=distance, camera=ForeseenCamera.of(case.adjusted))


def assumed_of_poses(
    hand_eye: HandEye, used: Float[ndarray, "n 4 4"], scale_std: float | None = None
) -> Assumptions:
    """The same of a calibration from camera poses that were given; `used` are the gripper poses that it rests on."""
    return Assumptions(
        gripper_from_camera=hand_eye.gripper_from_camera,
        distance_m=scene_distance(used @ hand_eye.gripper_from_camera),
        noise=hand_eye.robot_noise,
        scale_std=scale_std,
    )


def assumed(
    base_from_gripper: Poses, camera: ForeseenCamera | None, noise: tuple[float, float] | None = None
) -> Assumptions:
    """Before anything is found: a usual robot, `noise` (m, rad) being a lower bound, and the camera at its gripper."""
    x = assumed_camera(base_from_gripper)
    return Assumptions(
        gripper_from_camera=x,
        distance_m=scene_distance(base_from_gripper @ x),
        noise=typical_noise(noise),
        camera=camera,
    )


def typical_noise(given: tuple[float, float] | None = None) -> RobotNoise:
    """Typical errors of a robot whose errors are not measured; `given` (m, rad) is a lower bound on the random ones."""
    metres, radians, systematic = TYPICAL
    if given is not None:
        metres, radians = np.hypot(1.0, GIVEN_SHARE) * np.array(given)
    return RobotNoise(
        translation=float(metres),
        rotation=float(radians),
        estimated=False,
        given=given,
        systematic=float(systematic),
    )


def worse_of(noise: RobotNoise, other: RobotNoise) -> RobotNoise:
    """The larger errors of two robots, with what is given of the first."""
    return replace(
        noise,
        translation=max(noise.translation, other.translation),
        rotation=max(noise.rotation, other.rotation),
        systematic=max(noise.systematic, other.systematic),
    )


def typical_camera(
    intrinsics: Intrinsics | None, size: tuple[int, int], std: Float[ndarray, " q"] | None = None
) -> ForeseenCamera:
    """A camera whose images are not matched yet; `size` is width and height (px), `std` as camera_about takes it."""
    width, height = size
    focal, centre = USUAL_FOCAL * width, ((width - 1) / 2, (height - 1) / 2)
    camera = intrinsics or Intrinsics(focal, focal, *centre, width, height)
    return ForeseenCamera(camera=camera_about(camera, intrinsics is not None, std))


def scene_distance(camera: Poses) -> float:
    """How far (m) cameras in the base frame are from what they look at, the median."""
    return float(np.median(looked_at(camera)[1]))


@one_blas_thread
def expected(
    assumptions: Assumptions, base_from_gripper: Poses, systematic: Float[ndarray, "s s"]
) -> Expectation:
    """What a calibration from these poses is expected to report.

    `systematic` is the covariance of their systematic errors at 1 rad.
    """
    x, camera, identity = assumptions.gripper_from_camera, assumptions.camera, np.eye(4)
    if camera is None:
        covariance = expected_pose_covariance(
            base_from_gripper, x, assumptions.noise, systematic, assumptions.priors
        )
        estimate = Estimate(gripper_from_camera=x, scale=1.0, base_from_recon=identity, covariance=covariance)
    else:
        adjusted = foreseen(
            wrist_arm(base_from_gripper, systematic), x, camera, assumptions.noise, assumptions.distance_m
        )
        estimate = estimate_in(adjusted, 1.0, identity)
    if assumptions.faults is not None:
        estimate = estimate.with_fault(assumptions.faults)
    return Expectation(estimate=estimate, seen=in_use(estimate, Scene(assumptions.distance_m)).seen)
