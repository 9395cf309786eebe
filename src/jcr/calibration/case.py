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
from jcr.calibration.robot_errors import RobotErrorPrior
from jcr.camera import usable_intrinsics
from jcr.estimation.intrinsics_prior import (
    ESTIMATED,
    MEASURED,
    PRISM,
    CameraPrior,
    camera_about,
    camera_with_prior,
)
from jcr.estimation.problem import LinearPrior
from jcr.estimation.robot_noise import of_poses
from jcr.estimation.solve import Solution
from jcr.findings import Finding, is_explained, verdict_of
from jcr.records import Capture, Reconstruction, Tracks

MIN_OBSERVATIONS = 200
"""Fewest observations with which images are adjusted; fewer do not improve the fit to camera poses."""
MIN_IMAGES = 3
"""Fewest images that are adjusted."""
MOST_OBSERVATIONS = 60_000
"""Most observations that are adjusted, as many as 25 images of 640x480 have; more add little to the robot's errors."""

WELL_SEEN = 3
"""Number of images from which a point is preferred, where only some of the points are adjusted."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """State of a calibration between its steps; pose arrays have the m registered images in reconstruction order."""

    capture: Capture
    reconstruction: Reconstruction
    options: CalibrateOptions
    robot: RobotErrorPrior
    """Prior covariance of the systematic errors of the registered images' gripper poses."""
    priors: tuple[LinearPrior, ...] = ()
    """Known scale and known height of the camera, which complement the robot's poses; empty if none is given."""
    hand_eye: Calibration
    """Current calibration; its images are the registered ones."""
    fit: Calibration | None = None
    """Fit to camera poses that the adjustment started from; None while `hand_eye` is itself that fit."""
    carries: Literal["camera", "scene"] = "camera"
    """Object that the gripper carries: "camera", or "scene" if the camera is fixed and observes the carried object."""
    chosen_tracks: Tracks | None = None
    """Observations to adjust, a subset of those in the used images; None: the default subset (`tracks`)."""
    adjusted: Solution | None = None
    """Last bundle adjustment, even if `hand_eye` is still the fit to poses; None if the images were not adjusted."""

    @property
    def base_from_gripper(self) -> Float[ndarray, "m 4 4"]:
        """Reported gripper poses (m) of the m registered images, in the order of the reconstruction."""
        return self.capture.base_from_gripper[self.reconstruction.image_index]

    @property
    def recon_from_camera(self) -> Float[ndarray, "m 4 4"]:
        """Camera poses of the registered images in the recon frame, in units of the reconstruction.

        They are those from the images alone (`evidence`) if the reconstruction has them, else its camera poses.
        """
        evidence = self.reconstruction.evidence
        return self.reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera

    @property
    def used(self) -> Int[ndarray, " u"]:
        """Indices, among the registered images, of the images that the calibration uses."""
        return np.flatnonzero(self.hand_eye.inliers)

    @property
    def pose_fit(self) -> Calibration:
        """Fit to camera poses, the initial estimate of the bundle adjustment."""
        return self.fit or self.hand_eye

    @property
    def names(self) -> list[str]:
        """Names of the registered images."""
        return [self.capture.images[row] for row in self.reconstruction.image_index]

    @property
    def systematic(self) -> Float[ndarray, "s s"]:
        """Covariance of the used gripper poses' systematic errors for an error size of 1 rad.

        Each pose has six rows: translation (m), then rotation vector (rad), in base axes. The size is the standard
        deviation of a joint's error or, for an unknown arm, of the gripper's rotation.
        """
        return of_poses(self.robot.systematic, self.used)

    @property
    def camera(self) -> CameraPrior:
        """Prior of the intrinsics before the calibration: mean (the reconstruction's intrinsics) and covariance.

        The standard deviations depend on whether the intrinsics were given, estimated, or predicted by a network.
        """
        given, found = self.capture.intrinsics, self.reconstruction.intrinsics
        if given is None and self.reconstruction.predicted_focal is not None:
            of_center = {name: ESTIMATED[name] for name in ("aspect", "cx", "cy")}
            return camera_with_prior(found, {"f": self.reconstruction.predicted_focal[1], **of_center})
        if found.model == "thin_prism" and (given is None or given.model != found.model):
            return camera_with_prior(found, {**(ESTIMATED if given is None else MEASURED), **PRISM})
        # A distortion that folds over is not used, so that nothing is known of it.
        of_distortion = not usable_intrinsics(given)[1]
        return camera_about(found, given is not None, self.capture.intrinsics_std, of_distortion)

    @cached_property
    def tracks(self) -> Tracks:
        """Observations to adjust: `chosen_tracks`, or those in the used images, at most MOST_OBSERVATIONS.

        Their image indices count the used images, from 0.
        """
        if self.chosen_tracks is not None:
            return self.chosen_tracks
        found = of_images(self.reconstruction.tracks, self.hand_eye.inliers)
        return found if len(found.image) <= MOST_OBSERVATIONS else some_points(found, MOST_OBSERVATIONS)

    @property
    def scene_distance_m(self) -> float | None:
        """Median depth (m) of the observed points along the optical axis; None where the images were not adjusted."""
        if self.adjusted is None or self.hand_eye.source == "poses":
            return None
        return float(np.median(self.adjusted.images.view.depth)) * self.adjusted.state.scale

    @property
    def is_adjustable(self) -> bool:
        """Whether bundle adjustment can refine the fit to camera poses.

        It needs MIN_OBSERVATIONS observations and MIN_IMAGES used images. Camera poses with a covariance (`evidence`)
        are not adjusted. Cases with a known scale or height (`priors`) are not adjusted either, because the bundle
        adjustment does not model these.
        """
        return (
            self.reconstruction.evidence is None
            and not self.priors
            and len(self.tracks.image) >= MIN_OBSERVATIONS
            and len(self.used) >= MIN_IMAGES
        )

    @property
    def shows_camera(self) -> bool:
        """Whether effects on the camera, such as rolling shutter, can be tested.

        The case must be adjustable (`is_adjustable`), and its motions observable. Tracks from pointmaps are excluded,
        because the network used intrinsics of its own.
        """
        return (
            self.is_adjustable and not self.tracks.from_pointmaps and self.hand_eye.observability.observable
        )

    @property
    def is_open(self) -> bool:
        """Whether the motions are observable and no known cause, such as static images, rejects the calibration.

        A known cause is a finding that explains others (`is_explained`).
        """
        return self.hand_eye.observability.observable and not is_explained(self.hand_eye.findings)

    def after(
        self,
        findings: tuple[Finding, ...],
        hand_eye: Calibration | None = None,
        adjusted: Solution | None = None,
    ) -> "Case":
        """Return the case with the findings of a check added, and with a new calibration or adjustment if given.

        A finding's shift is also added to the covariance (`with_findings`). None for `hand_eye` or `adjusted` keeps the
        case's own.
        """
        found = with_findings(hand_eye or self.hand_eye, findings)
        fit = self.pose_fit if found.source == "images" else self.fit
        return replace(self, hand_eye=found, fit=fit, adjusted=adjusted or self.adjusted)


def with_findings(hand_eye: Calibration, findings: tuple[Finding, ...]) -> Calibration:
    """Return the calibration with `findings` added; the shift s of each finding adds s·sᵀ to the covariance.

    The shift (`Finding.shift`, in COVARIANCE_ORDER) is the change of the calibration that the finding states. A finding
    with a shift gets the severity "rejects" if the calibration is rejected, or too uncertain with the shift (MAX_STD).
    """
    named: list[Finding] = []
    for finding in findings:
        if finding.shift is None:
            named.append(finding)
            continue
        accepted = hand_eye.converged and verdict_of([*named, finding]) != "rejected"
        hand_eye = hand_eye.with_finding(finding)
        # The finding "too uncertain" is not added, because its remedy, more images, does not help against a fault.
        if not accepted or not judged(hand_eye).converged:
            finding = replace(finding, severity="rejects")
        named.append(finding)
    return hand_eye.with_findings(*named)


def of_images(tracks: Tracks, used: Bool[ndarray, " m"]) -> Tracks:
    """Return the observations in the used images; their image indices count the used images only, from 0.

    `used` is a mask of the m registered images. All points are kept.
    """
    kept = tracks.only(used[tracks.image])
    row = np.cumsum(used) - 1
    return replace(kept, image=row[kept.image])


def some_points(tracks: Tracks, most: int, most_points: int | None = None) -> Tracks:
    """Return the observations of all board corners, and of randomly chosen points up to `most` observations.

    `most_points` limits the number of chosen points. Points in WELL_SEEN or more images are then preferred, and points
    in one image are not chosen. None: no limit. Equal tracks give the same choice in every call.
    """
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    order = np.random.default_rng(0).permutation(len(count))
    if most_points is not None:
        order = order[np.argsort(count[order] < WELL_SEEN, kind="stable")]
        order = order[count[order] >= 2][:most_points]
    chosen = tracks.on_board
    chosen[order[np.cumsum(count[order]) <= most]] = True
    return tracks.only(chosen[tracks.point])
