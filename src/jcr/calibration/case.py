"""State of a calibration as it passes through fit, bundle adjustment and checks."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.hand_eye import judged
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import RobotErrorPrior, of_poses
from jcr.estimation.hypotheses import focal_lengths
from jcr.estimation.intrinsics_prior import (
    ESTIMATED,
    MEASURED,
    PRISM,
    CameraPrior,
    camera_about,
    camera_with_prior,
)
from jcr.estimation.point_uncertainty import scene_points, scene_uncertainty
from jcr.estimation.problem import LinearPrior
from jcr.estimation.solve import Solution
from jcr.findings import Finding, is_explained, verdict_of
from jcr.records import Capture, Reconstruction, SceneUncertainty, Tracks

MIN_OBSERVATIONS = 200
"""Fewest observations with which images are adjusted; fewer do not refine what the poses show."""
MIN_IMAGES = 3
"""Fewest images that are adjusted."""
MOST_OBSERVATIONS = 60_000
"""Most observations that are adjusted: the robot limits what more could add, and 25 images of 640x480 have as many."""

WELL_SEEN = 3
"""Images that show a point well."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A capture, its reconstruction, and their calibration so far; poses are in the reconstruction's order."""

    capture: Capture
    reconstruction: Reconstruction
    options: CalibrateOptions
    robot: RobotErrorPrior
    """Systematic errors of the registered images' poses."""
    priors: tuple[LinearPrior, ...]
    """Measurements of scale and height beside the robot's poses."""
    hand_eye: Calibration
    """The calibration as it stands; its images are the registered ones."""
    fit: Calibration | None = None
    """The fit to camera poses of which `hand_eye` was made by the images; None where `hand_eye` is that fit."""
    carries: Literal["camera", "scene"] = "camera"
    """Load of the gripper; the camera is fixed where the gripper carries the scene."""
    chosen_tracks: Tracks | None = None
    """Observations in the used images that take part, where not all do."""
    adjusted: Solution | None = None
    """Images and robot together, whether or not `hand_eye` is made of it; None where images could not be adjusted."""

    @property
    def base_from_gripper(self) -> Float[ndarray, "m 4 4"]:
        """Reported gripper poses of the registered images."""
        return self.capture.base_from_gripper[self.reconstruction.image_index]

    @property
    def recon_from_camera(self) -> Float[ndarray, "m 4 4"]:
        """Camera poses by the images alone where these are known, else those of the reconstruction."""
        evidence = self.reconstruction.evidence
        return self.reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera

    @property
    def used(self) -> Int[ndarray, " u"]:
        """Rows of the registered images that are used."""
        return np.flatnonzero(self.hand_eye.inliers)

    @property
    def pose_fit(self) -> Calibration:
        """The fit to camera poses, with which the adjustment of the images starts."""
        return self.fit or self.hand_eye

    @property
    def names(self) -> list[str]:
        """Names of the registered images."""
        return [self.capture.images[row] for row in self.reconstruction.image_index]

    @property
    def systematic(self) -> Float[ndarray, "s s"]:
        """Covariance of the systematic errors of the used poses at 1 rad."""
        return of_poses(self.robot.systematic, self.used)

    @property
    def camera(self) -> CameraPrior:
        """Camera with the prior of its intrinsics before the calibration."""
        given, found = self.capture.intrinsics, self.reconstruction.intrinsics
        if given is None and self.reconstruction.predicted_focal is not None:
            of_center = {name: ESTIMATED[name] for name in ("aspect", "cx", "cy")}
            return camera_with_prior(found, {"f": self.reconstruction.predicted_focal[1], **of_center})
        if found.model == "thin_prism" and (given is None or given.model != found.model):
            return camera_with_prior(found, {**(ESTIMATED if given is None else MEASURED), **PRISM})
        return camera_about(found, given is not None, self.capture.intrinsics_std)

    @cached_property
    def tracks(self) -> Tracks:
        """Observations in the used images, at most MOST_OBSERVATIONS."""
        if self.chosen_tracks is not None:
            return self.chosen_tracks
        found = of_images(self.reconstruction.tracks, self.hand_eye.inliers)
        return found if len(found.image) <= MOST_OBSERVATIONS else some_points(found, MOST_OBSERVATIONS)

    @property
    def free_focus(self) -> Float[ndarray, "e p"] | None:
        """Combinations that give every used image a focal length of its own; None where the user asked for none."""
        if self.options.focus == "fixed":
            return None
        return focal_lengths(self.reconstruction.intrinsics, len(self.used))

    @property
    def scene_distance_m(self) -> float | None:
        """Median distance from the camera to the scene; None where the images were not adjusted."""
        if self.adjusted is None or self.hand_eye.source == "poses":
            return None
        return float(np.median(self.adjusted.images.view.depth)) * self.adjusted.state.scale

    @property
    def scene_uncertainty(self) -> SceneUncertainty | None:
        """Uncertainty of the scene in the base frame; None where the calibration is not made of images."""
        if self.adjusted is None or self.scene_distance_m is None:
            return None
        return scene_uncertainty(scene_points(self.adjusted))

    @property
    def is_adjustable(self) -> bool:
        """Whether bundle adjustment can refine the fit to poses.

        Cameras that are not found by matches come with their covariance and have no tracks. Bundle adjustment takes
        scale and height from the robot alone.
        """
        return (
            self.reconstruction.evidence is None
            and not self.priors
            and len(self.tracks.image) >= MIN_OBSERVATIONS
            and len(self.used) >= MIN_IMAGES
        )

    @property
    def shows_camera(self) -> bool:
        """Whether effects on the camera can be tested.

        Pointmaps were made with intrinsics of their own, and degenerate motions are reported first.
        """
        return (
            self.is_adjustable and not self.tracks.from_pointmaps and self.hand_eye.observability.observable
        )

    @property
    def is_open(self) -> bool:
        """Whether the motions are observable and no cause rejects the calibration yet."""
        return self.hand_eye.observability.observable and not is_explained(self.hand_eye.findings)

    def after(
        self,
        findings: tuple[Finding, ...],
        hand_eye: Calibration | None = None,
        adjusted: Solution | None = None,
    ) -> "Case":
        """Return the case after a check: findings, and the calibration and adjustment that replace its own."""
        found = with_findings(hand_eye or self.hand_eye, findings)
        fit = self.pose_fit if found.source == "images" else self.fit
        return replace(self, hand_eye=found, fit=fit, adjusted=adjusted or self.adjusted)


def with_findings(hand_eye: Calibration, findings: tuple[Finding, ...]) -> Calibration:
    """Return a calibration with findings, and with their shifts in its covariance.

    A finding rejects the calibration where its shift makes it too uncertain, or where it explains a rejection.
    """
    named: list[Finding] = []
    for finding in findings:
        if finding.shift is None:
            named.append(finding)
            continue
        accepted = hand_eye.converged and verdict_of([*named, finding]) != "rejected"
        hand_eye = hand_eye.with_finding(finding)
        # More images, the remedy for a large covariance, do not help against a fault: that finding is left out.
        if not accepted or not judged(hand_eye).converged:
            finding = replace(finding, severity="rejects")
        named.append(finding)
    return hand_eye.with_findings(*named)


def of_images(tracks: Tracks, used: Bool[ndarray, " m"]) -> Tracks:
    """Return the observations of the used images, whose rows are counted again."""
    kept = tracks.only(used[tracks.image])
    row = np.cumsum(used) - 1
    return replace(kept, image=row[kept.image])


def some_points(tracks: Tracks, most: int, most_points: int | None = None) -> Tracks:
    """Return the observations of all board corners and of randomly chosen points, at most `most`.

    Of at most `most_points` those that WELL_SEEN or more images show are chosen first.
    """
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    order = np.random.default_rng(0).permutation(len(count))
    if most_points is not None:
        order = order[np.argsort(count[order] < WELL_SEEN, kind="stable")]
        order = order[count[order] >= 2][:most_points]
    chosen = tracks.on_board
    chosen[order[np.cumsum(count[order]) <= most]] = True
    return tracks.only(chosen[tracks.point])
