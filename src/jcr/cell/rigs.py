"""Localisation of further cameras' images in the reconstruction, and their rigs (camera poses that move together).

There is a rig for each used pose of the capture's own camera, for each fixed camera, and for each pose of another arm's
camera. A camera whose images contradict its stated mount is rejected here, before the joint adjustment.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.case import MIN_IMAGES, Case
from jcr.calibration.checks.effects import EXAMINED_FROM, effects_of_fit
from jcr.calibration.checks.images import SAME
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.camera import guessed_intrinsics, usable_intrinsics
from jcr.capture.images import read_image
from jcr.cell.cameras_json import CameraPlacement
from jcr.distributions import chi2
from jcr.estimation.hypotheses import arm_effects
from jcr.estimation.problem import Effect, PoseModel, ReportedPoses, State, scale_prior, wrist_arm
from jcr.estimation.robot_noise import of_poses
from jcr.findings import Finding, FindingKind
from jcr.geometry import Transform, inverse, motion_length, scale_translation, step_between
from jcr.records import CellCamera, Intrinsics
from jcr.sfm.register import POSE_GATE_PX, KnownImages, Registration, features, registrations

CLEARLY_MORE = 1.1
"""Ratio of RANSAC inliers with estimated over given focal length, above which the given one is wrong."""
SAME_PLACE = (0.02, np.radians(2.0))
"""Difference (m, rad) below which two gripper poses count as equal."""
MAP_STD = (4e-3, np.radians(0.25))
"""Standard deviations (m, rad) of a localised pose by errors of map and intrinsics, not in its covariance."""
APART = float(chi2.isf(1e-6, 6))
"""Squared Mahalanobis distance above which two poses of a camera differ."""
EXACT_SCALE = 1e-4
"""Assumed relative standard deviation of the scale between two cameras of one reconstruction."""


def localise(
    known: KnownImages, image: UInt8[ndarray, "h w 3"], camera: CellCamera
) -> tuple[Registration | None, int]:
    """Return the registration (pose and inliers) of an image in the reconstruction, and the number of inliers.

    The pose is recon_from_camera in metres. The registration is None if the inliers are too few. The focal length is
    estimated if none is given, or if another value gives CLEARLY_MORE (1.1) times the inliers.
    """
    given, _ = usable_intrinsics(camera.intrinsics)
    start = given or guessed_intrinsics(camera.image_size)
    gate_px = 2 * POSE_GATE_PX * max(1.0, start.width / 1600)
    focals: Sequence[Literal["given", "free"]] = ("free",) if given is None else ("free", "given")
    found, *by_given = registrations(known, image, start, focals, gate_px)
    return by_given[0] if by_given and found[1] <= CLEARLY_MORE * by_given[0][1] else found


@dataclass(frozen=True, kw_only=True)
class CameraViews:
    """Images of one camera other than the own: registrations and rigs of k used images, reasons for unused ones."""

    camera: CellCamera
    points: Sequence[int]
    """Number of points that each image shares with the scene."""
    used: Mapping[int, Registration]
    """Registrations of the used images, by image number."""
    reasons: Mapping[int, str]
    """Reasons why images are not used, by image number."""
    rig: Int[ndarray, " k"] = field(default_factory=lambda: np.zeros(0, int))
    """Rig of each used image; empty before `Rigs.add`."""
    rig_from_camera: Float[ndarray, "4 4"] | None = None
    """Pose of the camera on its rig; None for the first camera of a rig."""
    number: int = 1
    """Number of the camera in the estimation problem; the capture's own camera is 0."""
    arm: int | None = None
    """Number of the camera's arm in the estimation problem; None for a fixed camera."""
    findings: tuple[Finding, ...] = ()

    @property
    def rows(self) -> Int[ndarray, " k"]:
        """Numbers of the used images, counted from 0 in the camera's list of images."""
        return np.array(list(self.used), dtype=int)

    @property
    def is_fixed(self) -> bool:
        """Whether all images were taken from one place in the scene."""
        return self.camera.mount == "base" and self.camera.frame is None

    @property
    def names(self) -> list[str]:
        """Names of the used images."""
        return [self.camera.images[k] for k in self.used]

    @property
    def places(self) -> Float[ndarray, "k 4 4"]:
        """Poses recon_from_camera (m) of the used images."""
        return np.stack([one.pose.a_from_camera for one in self.used.values()])

    @property
    def covariances(self) -> Float[ndarray, "k 6 6"]:
        """Covariances of the poses `places`: translation (m), then rotation vector (rad), in axes of the recon frame."""
        return np.stack([one.pose.covariance[:6, :6] for one in self.used.values()])

    @property
    def intrinsics(self) -> Intrinsics:
        """Given intrinsics, else those estimated from the image with most inliers."""
        given, _ = usable_intrinsics(self.camera.intrinsics)
        return given or max(self.used.values(), key=lambda one: len(one.x_px)).pose.camera

    def without(self, reasons: Mapping[int, str]) -> "CameraViews":
        """Return the views without some images; `reasons` maps the number of a removed image to the reason."""
        used = {k: one for k, one in self.used.items() if k not in reasons}
        return replace(self, used=used, reasons={**self.reasons, **reasons})

    def refused(self, *findings: Finding) -> CameraPlacement:
        """Return a rejected placement of the camera; at least one of the findings must reject."""
        return CameraPlacement.of(self.camera, findings, self.points, self.reasons)

    def parent_from_camera(self, state: State) -> Float[ndarray, "4 4"]:
        """Return base_from_camera of a fixed camera, else gripper_from_camera, for a state of the solution."""
        if self.arm is None:
            return state.z[0] @ scale_translation(state.world_from_rig[self.rig[0]], state.scale)
        return state.x[self.arm] @ scale_translation(state.rig_from_camera[self.number], state.scale)


class Rigs:
    """Poses of all rigs of a cell; a rig is a set of cameras that move together, at one time.

    There is one rig for each used image of the own camera, then those of other cameras. `case` is the calibration of
    the own camera, `known` are its used images with features and poses in metres; None: they are read.
    """

    def __init__(self, case: Case, known: KnownImages | None = None) -> None:
        self.case, self.rows, found = case, case.reconstruction.image_index[case.used], case.reconstruction
        if known is None:
            places = scale_translation(found.recon_from_camera[case.used], case.numbers.scale)
            # Before the gripper, images are localised by the board that it carries, without features.
            rows = self.rows if case.carries == "camera" else ()
            images = (read_image(case.capture.folder / case.capture.images[row]) for row in rows)
            own = tuple(features(image, found.intrinsics) for image in images)
            known = KnownImages(found.intrinsics, places, own)
        self.known = known
        self.poses = list(known.recon_from_camera)
        # Rig of each row of the capture that has one; rows without an own image get theirs with the image of another.
        self.rig_of = {int(row): k for k, row in enumerate(self.rows)}
        # Rigs, gripper poses and hand-eye fit of the camera of each further arm, by the name of the arm.
        self.arms: dict[str, tuple[Int[ndarray, " n"], Float[ndarray, "n 4 4"], Calibration]] = {}

    def add(self, seen: CameraViews) -> CameraViews | CameraPlacement:
        """Return the views with a rig (cameras that move together) for each used image; new rigs are added if needed.

        Return a rejected placement if the images cannot be assigned.
        """
        if not seen.used:
            most = int(np.argmax(seen.points))
            best, count = seen.camera.images[most], float(seen.points[most])
            kind = FindingKind.FEW_POINTS_SHARED
            return seen.refused(Finding.of(kind, "rejects", "images", best, value=count))
        if seen.camera.arm is not None:
            return self._on_other_arm(seen, seen.camera.arm)
        if seen.camera.frame is not None:
            return self._on_same_rig(seen)
        place = seen.places[int(np.trace(seen.covariances, axis1=1, axis2=2).argmin())]
        apart = np.linalg.norm(step_between(self.known.recon_from_camera, place).reshape(-1, 2, 3), axis=-1)
        seen = replace(seen, rig=np.full(len(seen.used), len(self.poses)))
        self.poses.append(place)
        if not len(near := np.flatnonzero((apart < SAME).all(1))):
            return seen
        image, own = self.case.capture.images[self.rows[near[0]]], self.case.capture.camera_name
        at_own = Finding.of(FindingKind.AT_ANOTHER_CAMERA, "warns", "mount", image, camera=own)
        return replace(seen, findings=(*seen.findings, at_own))

    def _on_same_rig(self, seen: CameraViews) -> CameraViews | CameraPlacement:
        """Return the views of a camera on the own camera's body; each image gets the rig of the own image taken with it.

        The body is the gripper or, for cameras that watch the gripper, the ground.

        Return a rejected placement if the other camera is not rigidly connected, or its images do not suffice.
        """
        assert seen.camera.frame is not None
        case, capture = self.case, self.case.capture
        frame = {k: int(seen.camera.frame[k]) for k in seen.used}
        doubtful = set(case.reconstruction.image_index.tolist()) - set(self.rows.tolist())
        seen = seen.without(
            {
                k: f"{capture.images[row]}, taken with it, is not used"
                for k, row in frame.items()
                if row in doubtful
            }
        )
        if not seen.used:
            return seen.refused(Finding.of(FindingKind.NO_COMMON_POSE, "rejects", "images"))
        for row in (frame[k] for k in seen.used if frame[k] not in self.rig_of):
            # The own image of this row shows nothing; its camera's pose is the one that the robot's pose predicts.
            (moving,) = case.of_arm(capture.base_from_gripper[[row]])
            numbers, self.rig_of[row] = case.numbers, len(self.poses)
            self.poses.append(inverse(numbers.body_from_recon.rigid) @ moving @ numbers.parent_from_camera)
        rig, moved = np.array([self.rig_of[frame[k]] for k in seen.used]), ()
        if len(seen.used) >= EXAMINED_FROM and (rig < len(self.rows)).all():
            moved = fit_views(seen, self.known.recon_from_camera[rig], EXACT_SCALE)[1]
        if any(one.severity == "rejects" for one in moved):
            return seen.refused(*moved)
        for one in moved:
            if one.kind is FindingKind.SLIP:
                first, before = seen.names.index(one.images[1]), one.details["longer"] == "before"
                part = seen.rows[first:] if before else seen.rows[:first]
                rig = rig[:first] if before else rig[first:]
                seen = seen.without(
                    dict.fromkeys(part.tolist(), f"the camera moved on the {seen.camera.mount}")
                )
        wrist = np.stack(self.poses)[rig]
        apart = np.linalg.norm(step_between(wrist[:, None], wrist).reshape(-1, 2, 3), axis=-1)
        if (apart <= SAME_PLACE).all():
            return seen.refused(Finding.of(FindingKind.ONE_GRIPPER_POSE, "rejects", "images", *seen.names))
        on_rig = inverse(wrist) @ seen.places
        between = np.asarray(motion_length(inverse(on_rig)[:, None] @ on_rig[None]))
        middle = int(np.median(between, axis=1).argmin())
        step = step_between(seen.places, wrist @ on_rig[middle])
        covariance = seen.covariances + seen.covariances[middle] + 2 * np.diag(np.repeat(MAP_STD, 3) ** 2)
        astray = (step * np.linalg.solve(covariance, step[..., None])[..., 0]).sum(-1) > APART
        if astray.mean() > 0.4:
            size = {"value": float(np.linalg.norm(step[:, :3], axis=1).max()), "camera": capture.camera_name}
            return seen.refused(Finding.of(FindingKind.NOT_RIGID, "rejects", "mount", **size))
        why = f"its place on the {seen.camera.mount} is not that of its other images"
        kept = seen.without(dict.fromkeys(seen.rows[astray].tolist(), why))
        return replace(kept, rig=rig[~astray], rig_from_camera=on_rig[middle], arm=0, findings=moved)

    def _on_other_arm(self, seen: CameraViews, arm: str) -> CameraViews | CameraPlacement:
        """Return the views of another arm's camera with a rig (camera pose) for each used image.

        Return a rejected placement if the hand-eye fit of that camera fails.
        """
        assert seen.camera.base_from_gripper is not None
        if arm in self.arms:
            return seen.refused(Finding.of(FindingKind.SECOND_ON_ARM, "rejects", arm=arm))
        if len(seen.used) < MIN_IMAGES:
            counts = {"value": float(len(seen.used)), "needed": float(MIN_IMAGES)}
            return seen.refused(Finding.of(FindingKind.FEW_LOCALISED, "rejects", "images", **counts))
        gripper = seen.camera.base_from_gripper[seen.rows]
        std = max(float(np.sqrt(self.case.numbers.covariance[6, 6])), 1e-4)
        found, effects = fit_views(seen, gripper, std)
        if not found.converged:
            explained = [replace(one, severity="rejects") for one in effects]
            return seen.refused(*(explained or found.findings))
        used = found.inliers
        kept = seen.without({int(seen.rows[k]): str(found.images[k].reason) for k in np.flatnonzero(~used)})
        rig = len(self.poses) + np.arange(used.sum())
        self.poses += list(kept.places)
        self.arms[arm] = rig, gripper[used], found
        return replace(kept, rig=rig, arm=len(self.arms))

    def arm_poses(
        self,
    ) -> tuple[list[ReportedPoses], list[tuple[Transform, Transform]], tuple[Effect, ...]]:
        """Return the reported poses and initial (gripper_from_camera, base_from_world) of each arm, own arm first.

        The third result is the effects that the calibration of the own camera found on its arm.
        """
        case = self.case
        rows = np.array(list(self.rig_of))
        poses, systematic = case.capture.base_from_gripper[rows], of_poses(case.robot.systematic, case.used)
        if len(rows) > len(self.rows):
            systematic = robot_errors(case.capture, case.options).of(rows).systematic
        own = replace(wrist_arm(poses, systematic), carries=case.carries)
        arms = [replace(own, rigs=np.array(list(self.rig_of.values())))]
        arms += [replace(wrist_arm(gripper), rigs=rigs) for rigs, gripper, _ in self.arms.values()]
        found = [case.numbers, *(one for _, _, one in self.arms.values())]
        starts = [(one.parent_from_camera, one.body_from_recon.rigid) for one in found]
        kinds = {one.kind for one in case.numbers.findings if one.kind.row.group == "strain"}
        others = 6 * sum(len(rigs) for rigs, _, _ in self.arms.values())
        effects = (
            replace(one, columns=np.pad(one.columns, ((0, others), (0, 0))))
            for one in arm_effects(poses)
            if one.kind in kinds
        )
        return arms, starts, tuple(effects)


def fit_views(
    seen: CameraViews, carrier: Float[ndarray, "k 4 4"], scale_std: float
) -> tuple[Calibration, tuple[Finding, ...]]:
    """Return the hand-eye calibration of a camera from its images and the poses of its gripper or rig.

    `carrier` are these poses (m): base_from_gripper or recon_from_rig of each used image. `scale_std` is the relative
    standard deviation of the scale between them. The second result is the findings on effects such as a slip.
    """
    found = solve_hand_eye(carrier, seen.places, scale=1.0, scale_std=scale_std, camera_errors="none")
    model = PoseModel(priors=(scale_prior(1.0, scale_std),))
    return found, effects_of_fit(carrier, seen.places, found, seen.names, model)
