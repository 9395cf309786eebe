"""Rigs of a cell: images that move as one with the capture's own camera, its gripper, or another arm.

A camera whose images contradict how it is mounted is refused here, before anything is adjusted.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.cell.camera_views import CameraViews
from jcr.cell.placement import CameraPlacement
from jcr.distributions import chi2
from jcr.estimation.hand_eye import fit_hand_eye
from jcr.estimation.hypotheses import arm_rows
from jcr.estimation.problem import ReportedPoses
from jcr.estimation.systematic import smooth_errors
from jcr.findings import Finding, FindingKind
from jcr.geometry import Transform, inverse, motion_length, step_between
from jcr.records import Capture, HandEye

SAME_PLACE = (0.02, np.radians(2.0))
"""m, rad: gripper poses that differ by less are one."""
MAP_STD = (4e-3, np.radians(0.25))
"""m, rad: standard deviations of a place by errors of map and intrinsics, which its covariance does not contain."""
APART = float(chi2.isf(1e-6, 6))
"""Squared Mahalanobis distance from which two places of a camera differ."""
AT_A_FRAME = (0.01, np.radians(1.0))
"""m, rad: nearer than this to where the wrist camera was, a fixed camera is likely to be that camera."""
LEAST_POSES = 3
"""Fewest images of another arm, or of another camera on the gripper."""


class Rigs:
    """Rigs: the capture's own camera at each used image, then those that other cameras add."""

    def __init__(
        self, capture: Capture, hand_eye: HandEye, own: Float[ndarray, "m 4 4"], rows: Int[ndarray, " m"]
    ) -> None:
        self._capture, self._hand_eye, self._rows = capture, hand_eye, rows
        self.poses = list(own)
        self.arms: list[str] = []
        self._of_arms: list[tuple[Int[ndarray, " n"], Float[ndarray, "n 4 4"], HandEye]] = []

    def add(self, seen: CameraViews) -> CameraViews | CameraPlacement:
        """Add the images of a camera to the rigs; return a rejected placement where it cannot be placed."""
        if not seen.registered:
            most = int(np.argmax(seen.counts))
            best, count = seen.camera.images[most], float(seen.counts[most])
            return seen.refused(FindingKind.FEW_POINTS_SHARED, "images", best, value=count)
        if seen.camera.arm is not None:
            return self._on_other_arm(seen, seen.camera.arm)
        return self._on_same_gripper(seen) if seen.camera.mount == "gripper" else self._fixed(seen)

    def _fixed(self, seen: CameraViews) -> CameraViews | CameraPlacement:
        places, covariances = seen.places, seen.covariances
        names = [seen.camera.images[k] for k in seen.rows]
        squared = _squared(places[:, None], covariances[:, None], places, covariances)
        if squared.max() > APART:
            a, b = np.unravel_index(squared.argmax(), squared.shape)
            metres, radians = _apart(places[[a]], places[[b]])
            apart = {"value": float(metres[0]), "rotation": float(radians[0])}
            return seen.refused(FindingKind.NOT_FIXED, "mount", names[a], names[b], **apart)
        middle = places[int(squared.sum(1).argmin())]
        rig = np.full(len(seen.found), -1)
        rig[seen.rows] = len(self.poses)
        metres, radians = _apart(np.stack(self.poses[: len(self._rows)]), middle)
        near = np.flatnonzero((metres < AT_A_FRAME[0]) & (radians < AT_A_FRAME[1]))
        images = [self._capture.images[self._rows[row]] for row in near[:1]]
        own = self._capture.camera_name
        at_own = [
            Finding.of(FindingKind.AT_ANOTHER_CAMERA, "warns", "mount", one, camera=own) for one in images
        ]
        self.poses.append(middle)
        return replace(seen, rig=rig, findings=tuple(at_own))

    def _on_same_gripper(self, seen: CameraViews) -> CameraViews | CameraPlacement:
        assert seen.camera.frame is not None
        rig, unused = np.full(len(seen.found), -1), dict[int, str]()
        for k in seen.rows.tolist():
            frame = int(seen.camera.frame[k])
            at = np.flatnonzero(self._rows == frame)
            if len(at):
                rig[k] = at[0]
            else:
                unused[k] = f"{self._capture.images[frame]}, taken with it, is not used"
        seen = seen.without(unused)
        taken = np.flatnonzero(rig >= 0)
        if not len(taken):
            return seen.refused(FindingKind.NO_COMMON_POSE, "images")
        wrist = np.stack(self.poses)[rig[taken]]
        metres, radians = _apart(wrist[:, None], wrist)
        if not ((metres > SAME_PLACE[0]) | (radians > SAME_PLACE[1])).any():
            return seen.refused(
                FindingKind.ONE_GRIPPER_POSE, "images", *(seen.camera.images[k] for k in taken)
            )
        among = np.isin(seen.rows, taken)
        places, covariances = seen.places[among], seen.covariances[among]
        on_rig = inverse(wrist) @ places
        between = np.asarray(motion_length(inverse(on_rig)[:, None] @ on_rig[None]))
        middle = int(np.median(between, axis=1).argmin())
        expected = wrist @ on_rig[middle]
        astray = _squared(places, covariances, expected, covariances[middle]) > APART
        if astray.mean() > 0.4:
            most_m, own = float(_apart(places, expected)[0].max()), self._capture.camera_name
            return seen.refused(FindingKind.NOT_RIGID, "mount", value=most_m, camera=own)
        rig[taken[astray]] = -1
        why = "its place on the gripper is not that of its other images"
        seen = seen.without(dict.fromkeys(taken[astray].tolist(), why))
        return replace(seen, rig=rig, rig_from_camera=on_rig[middle], arm=0)

    def _on_other_arm(self, seen: CameraViews, arm: str) -> CameraViews | CameraPlacement:
        assert seen.camera.base_from_gripper is not None
        if arm in self.arms:
            return seen.refused(FindingKind.SECOND_ON_ARM, arm=arm)
        if len(seen.rows) < LEAST_POSES:
            counts = {"value": float(len(seen.rows)), "needed": float(LEAST_POSES)}
            return seen.refused(FindingKind.FEW_LOCALISED, "images", **counts)
        places, gripper = seen.places, seen.camera.base_from_gripper[seen.rows]
        std = max(float(np.sqrt(self._hand_eye.covariance[6, 6])), 1e-4)
        found = fit_hand_eye(gripper, places, scale=1.0, scale_std=std, in_sequence=False)
        if not found.converged:
            return seen.not_placed(*found.findings)
        rig = np.full(len(seen.found), -1)
        used = np.flatnonzero(found.inliers)
        rig[seen.rows[used]] = len(self.poses) + np.arange(len(used))
        why = {int(seen.rows[k]): str(found.reasons[k]) for k in np.flatnonzero(~found.inliers)}
        self.poses += list(places[used])
        self.arms.append(arm)
        self._of_arms.append((rig[seen.rows[used]], gripper[used], found))
        return replace(seen.without(why), rig=rig, arm=len(self.arms))

    def arm_poses(
        self, options: CalibrateOptions
    ) -> tuple[list[ReportedPoses], list[tuple[Transform, Transform]]]:
        """Return the arms, the capture's own first, and initial X and base_from_world of each."""
        robot = robot_errors(self._capture, options).of(self._rows)
        hand_eye = self._hand_eye
        poses = self._capture.base_from_gripper[self._rows]
        kinds = {one.kind for one in hand_eye.findings if one.kind.row.group == "strain"}
        bent = [row.prior_std * row.columns for row in arm_rows(poses) if row.kind in kinds]
        arms = [
            ReportedPoses(
                rigs=np.arange(len(self._rows)),
                base_from_gripper=poses,
                error_covariance=robot.systematic,
                confirmed_errors=np.concatenate(bent, axis=1) if bent else None,
            )
        ]
        for rigs, gripper, _ in self._of_arms:
            arms.append(
                ReportedPoses(rigs=rigs, base_from_gripper=gripper, error_covariance=smooth_errors(gripper))
            )
        found = [hand_eye, *(one for _, _, one in self._of_arms)]
        return arms, [(one.gripper_from_camera, one.base_from_recon) for one in found]


def _squared(
    places: Float[ndarray, "*#k 4 4"],
    covariances: Float[ndarray, "*#k 6 6"],
    others: Float[ndarray, "*#k 4 4"],
    covariances_of_others: Float[ndarray, "*#k 6 6"],
) -> Float[ndarray, "..."]:
    """Return the squared Mahalanobis distance between poses, which broadcast."""
    step = step_between(places, others)
    covariance = covariances + covariances_of_others + 2 * np.diag(np.repeat(MAP_STD, 3) ** 2)
    return (step * np.linalg.solve(covariance, step[..., None])[..., 0]).sum(-1)


def _apart(
    places: Float[ndarray, "*#k 4 4"], others: Float[ndarray, "*#k 4 4"]
) -> tuple[Float[ndarray, "..."], Float[ndarray, "..."]]:
    """Return distance (m) and angle (rad) between poses, which broadcast."""
    step = step_between(places, others)
    return np.linalg.norm(step[..., :3], axis=-1), np.linalg.norm(step[..., 3:], axis=-1)
