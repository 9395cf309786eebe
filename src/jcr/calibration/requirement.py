"""Required accuracy of a calibration, its accuracy in use, and the gripper poses to add until it is reached."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.options import GRASPING, MOST_POSES, CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import RobotErrorPrior, of_poses
from jcr.estimation.point_uncertainty import seen_points, within_95
from jcr.estimation.prediction import (
    Assumptions,
    PredictedCamera,
    assumed_camera,
    candidate_poses,
    choose_poses,
    median_distance,
    nearest,
    predict,
    predict_covariance,
    total_uncertainty,
    typical_noise,
)
from jcr.findings import Concerns, Finding, FindingKind
from jcr.geometry import Poses, inverse, rotation_angle
from jcr.records import NextPose, Requirement, SceneUncertainty, Uncertainty, Where

PROPOSED = 2
"""Number of gripper poses proposed after a calibration, if these are enough."""
COMPARED, EXISTING = 80, 40
"""Number of candidate poses that are compared, and of poses of the capture by which they are compared."""


@dataclass(frozen=True, kw_only=True)
class Proposals:
    """Poses to add to those of a capture, best first."""

    assumptions: Assumptions
    base_from_gripper: Float[ndarray, "n 4 4"]
    robot: RobotErrorPrior
    """Errors of the poses of the capture."""
    names: Sequence[str]
    """Names of the poses of the capture."""
    added: Float[ndarray, "c 4 4"]

    @staticmethod
    def of(
        assumptions: Assumptions,
        base_from_gripper: Poses,
        names: Sequence[str],
        robot: RobotErrorPrior,
        count: int,
        reach: Float[ndarray, "2 3"] | None = None,
        seed: int = 0,
        is_likely: Callable[[Poses], Bool[ndarray, " k"]] | None = None,
    ) -> "Proposals":
        """Return the `count` poses that reduce the predicted uncertainty most.

        `names` and `robot` are of the poses of the capture, `reach` is that of `candidates`, drawn with `seed`.
        `is_likely` tells at which poses an image is likely to register; others are taken only where there are none.
        """
        now, x = base_from_gripper, assumptions.gripper_from_camera
        found = Proposals(
            assumptions=assumptions, base_from_gripper=now, robot=robot, names=names, added=now[:0]
        )
        if count == 0:
            return found
        possible = candidate_poses(now, x, reach, np.random.default_rng(seed))
        if is_likely is not None and (likely := is_likely(possible)).any():
            possible = possible[likely]
        possible = possible[:COMPARED]
        existing = np.linspace(0, len(now) - 1, min(len(now), EXISTING)).round().astype(int)
        systematic, poses = robot.with_poses(now, possible), np.concatenate([now, possible])

        def uncertainty_of(rows: Int[ndarray, " c"]) -> float:
            together = np.r_[existing, len(now) + rows]
            errors = of_poses(systematic, together)
            covariance = predict_covariance(assumptions, poses[together], errors, averaged=False)
            return total_uncertainty(covariance, assumptions.distance_m * x[:3, 2])

        return replace(found, added=possible[choose_poses(count, len(possible), uncertainty_of)])

    def predict(self, count: int) -> Uncertainty:
        """Return the predicted uncertainty with the first `count` of the added poses."""
        now, added = self.base_from_gripper, self.added[:count]
        return predict(self.assumptions, np.concatenate([now, added]), self.robot.with_poses(now, added))

    def next_pose(self, count: int, predicted: Uncertainty) -> NextPose:
        """Return the last of the first `count` added poses with the uncertainty predicted for these."""
        pose, seen = self.added[count - 1], predicted.seen
        assert seen is not None
        like = int(nearest(pose[None], self.base_from_gripper)[0])
        motion = inverse(self.base_from_gripper[like]) @ pose
        return NextPose(
            base_from_gripper=pose,
            expected_std=predicted.std,
            within_95_mm=seen.within_95_mm,
            rotation_95_deg=seen.rotation_95_deg,
            like=self.names[like],
            moved_m=float(np.linalg.norm(motion[:3, 3])),
            rotation_rad=float(rotation_angle(motion[:3, :3])),
        )

    def next_poses(self, count: int) -> list[NextPose]:
        """Return the first `count` added poses, each with the prediction for all up to it."""
        return [self.next_pose(k, self.predict(k)) for k in range(1, count + 1)]


def assumptions_of(case: Case) -> Assumptions:
    """Return the assumption that further images and gripper poses are like those of an accepted calibration."""
    used, metric_std = case.base_from_gripper[case.used], case.reconstruction.metric_std
    assumptions = assumptions_of_poses(case.hand_eye, used, metric_std)
    if case.adjusted is None or (distance := case.scene_distance_m) is None:
        return assumptions
    return replace(assumptions, distance_m=distance, camera=PredictedCamera.of(case.adjusted))


def assumptions_of_poses(
    hand_eye: Calibration, used: Float[ndarray, "n 4 4"], scale_std: float | None = None
) -> Assumptions:
    """Return the same assumption for a calibration from given camera poses; `used` are its gripper poses."""
    return Assumptions(
        gripper_from_camera=hand_eye.gripper_from_camera,
        distance_m=median_distance(used @ hand_eye.gripper_from_camera),
        noise=hand_eye.robot_noise,
        scale_std=scale_std,
    )


def reached(uncertainty: Uncertainty, at: Where) -> tuple[float, float]:
    """Return the bounds (mm, degrees) of 95 % of the errors at one place; without a scene at a seen point."""
    covariance, scene, seen = uncertainty.covariance, uncertainty.scene, uncertainty.seen
    if at == "camera":
        metres = within_95(covariance[:3, :3])
    elif at == "scene" and scene is not None:
        covariance, metres = scene.covariance, scene.within_95_m
    else:
        assert seen is not None
        return seen.within_95_mm, seen.rotation_95_deg
    return 1e3 * metres, float(np.degrees(within_95(covariance[3:6, 3:6])))


def advised(
    hand_eye: Calibration,
    gripper: Float[ndarray, "m 4 4"],
    options: CalibrateOptions,
    robot: RobotErrorPrior,
    assumptions: Assumptions,
    scene: SceneUncertainty | None = None,
) -> Calibration:
    """Return the calibration with its point uncertainty, the requirement, and the poses to add.

    Poses are proposed where the requirement is not met or the user asks: the prediction takes a third of a calibration.
    `gripper` are the poses that the solver was given, in its order, `robot` is of these; `assumptions` are those of the
    calibration, `scene` is the uncertainty of the scene, where images were adjusted.
    """
    used, robot = gripper[hand_eye.inliers], robot.of(np.flatnonzero(hand_eye.inliers))
    x, uncertainty = hand_eye.gripper_from_camera, hand_eye.uncertainty
    seen = seen_points(x, uncertainty, hand_eye.intrinsics, assumptions.distance_m)
    uncertainty = replace(uncertainty, seen=seen, scene=scene)
    hand_eye, names = replace(hand_eye, uncertainty=uncertainty), hand_eye.names_used
    required = _required(hand_eye, options)
    # Wrong intrinsics and a strained robot stay the same with further images.
    lasting = [
        one.covariance
        for one in hand_eye.findings
        if one.concerns == "intrinsics" or one.kind.row.group == "strain"
    ]
    assumptions = replace(assumptions, faults=sum(lasting, start=np.zeros((7, 7))))
    proposed = list[NextPose]()
    if hand_eye.converged and required.met and not options.next_poses:
        required = replace(required, more_images=0)
    elif hand_eye.converged:
        count = options.next_poses if required.met else max(PROPOSED, options.next_poses)
        more, proposed = _worthwhile(hand_eye, used, required, assumptions, robot, count)
        required = replace(required, more_images=more)
    else:
        # A rejected X is not used, and a robot that is worse than usual is not expected to improve.
        found, usual = hand_eye.robot_noise, typical_noise()
        sizes = ("translation", "rotation", "systematic")
        noise = replace(found, **{name: max(getattr(found, name), getattr(usual, name)) for name in sizes})
        assumptions = replace(assumptions, gripper_from_camera=assumed_camera(used), noise=noise, camera=None)
        proposed = Proposals.of(assumptions, used, names, robot, PROPOSED).next_poses(PROPOSED)
    earlier = tuple(one for one in hand_eye.findings if one.kind is not FindingKind.NOT_EXACT_ENOUGH)
    hand_eye = replace(hand_eye, next_poses=tuple(proposed), requirement=required, findings=earlier)
    short = not_exact_enough(
        required, uncertainty.budget is not None and uncertainty.budget.mostly_systematic
    )
    return hand_eye if short is None or not hand_eye.converged else hand_eye.with_findings(short)


def not_exact_enough(required: Requirement, systematic: bool) -> Finding | None:
    """Report that a calibration is not as exact as is required; it rejects where a user asked for the accuracy.

    `systematic`: the uncertainty comes mostly from systematic errors of the robot.
    """
    if required.met:
        return None
    concerns: Concerns = "images" if required.more_images is not None else "robot" if systematic else "none"
    numbers = {
        name: value if isinstance(value, str) else float(value)
        for name, value in vars(required).items()
        if value is not None
    }
    finding = Finding.of(FindingKind.NOT_EXACT_ENOUGH, "rejects" if required.asked else "warns", concerns)
    return replace(finding, value=1e-3 * required.reached_mm, details=numbers)


def _required(hand_eye: Calibration, options: CalibrateOptions) -> Requirement:
    """Return the requirement beside the accuracy in use of a calibration."""
    seen, at = hand_eye.uncertainty.seen, options.require_at
    assert seen is not None
    reached_mm, reached_deg = reached(hand_eye.uncertainty, at)
    translation_mm, rotation_deg = options.require or GRASPING
    return Requirement(
        translation_mm=translation_mm,
        rotation_deg=rotation_deg,
        asked=options.require is not None,
        distance_mm=0.0 if at == "camera" else seen.distance_mm,
        reached_mm=reached_mm,
        reached_deg=reached_deg,
        at=at,
    )


def _worthwhile(
    hand_eye: Calibration,
    used: Float[ndarray, "k 4 4"],
    required: Requirement,
    assumptions: Assumptions,
    robot: RobotErrorPrior,
    least: int,
) -> tuple[int | None, list[NextPose]]:
    """Return how many poses would reach the requirement, and those poses or `least`, the best first.

    The reported uncertainty shrinks by the ratio by which the predicted one does: images and robot may be better or
    worse than predicted.
    """
    proposals = Proposals.of(
        assumptions, used, hand_eye.names_used, robot, least if required.met else MOST_POSES
    )
    predicted = cache(proposals.predict)

    def shrunk(count: int, at: Where, mm: float, deg: float) -> tuple[float, float]:
        (now_mm, now_deg), (then_mm, then_deg) = (
            reached(one, at) for one in (predicted(0), predicted(count))
        )
        return mm * then_mm / now_mm, deg * then_deg / now_deg

    def is_met(count: int) -> bool:
        mm, deg = shrunk(count, required.at, required.reached_mm, required.reached_deg)
        return replace(required, reached_mm=mm, reached_deg=deg).met

    more = 0 if required.met else None
    if not required.met and is_met(MOST_POSES):
        more = next(count for count in range(1, MOST_POSES + 1) if is_met(count))
    seen, std = hand_eye.uncertainty.seen, hand_eye.uncertainty.std
    assert seen is not None
    proposed = []
    for count in range(1, max(least, more or 0) + 1):
        mm, deg = shrunk(count, "seen", seen.within_95_mm, seen.rotation_95_deg)
        proposed.append(
            replace(
                proposals.next_pose(count, predicted(count)),
                expected_std=std * predicted(count).std / predicted(0).std,
                within_95_mm=mm,
                rotation_95_deg=deg,
            )
        )
    return more, proposed
