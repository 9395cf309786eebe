"""State of a calibration as it passes through fit, bundle adjustment and checks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.arm_of_capture import RobotErrorPrior
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import appended, findings_of, judged
from jcr.camera import usable_intrinsics, with_thin_prism
from jcr.estimation.intrinsics_prior import (
    ESTIMATED,
    MEASURED,
    PRISM,
    CameraPrior,
    camera_about,
    camera_with_prior,
)
from jcr.estimation.observability import observability
from jcr.estimation.problem import Effect, LinearPrior, PoseModel
from jcr.estimation.solve import Solution
from jcr.findings import Finding, FindingKind, is_explained
from jcr.geometry import Poses, inverse
from jcr.records import Capture, Reconstruction, Tracks

MIN_IMAGES = 3
"""Fewest images that are adjusted, or that form a piece of a reconstruction: two agree by chance."""
MOST_OBSERVATIONS = 60_000
"""Most observations that are adjusted, as many as 25 images of 640x480 have; more add little to the robot's errors."""
MATERIAL = 0.5
"""Smallest change of the camera, in standard deviations on at least one axis, that is reported: of an effect, and as the
last step of an adjustment that did not converge."""
WELL_SEEN = 3
"""Number of images from which a point is preferred, where only some of the points are adjusted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """Assumptions of a bundle adjustment: the images and observations that are used, the camera, and effects."""

    tracks: Tracks
    """Observations in the m registered images, and the boards among the points."""
    used: Bool[ndarray, " m"]
    """Mask of the registered images that are used."""
    camera: CameraPrior
    """Prior of the intrinsics."""
    effects: tuple[Effect, ...] = ()
    """Confirmed effects on camera and arm, which are estimated."""
    lengths: tuple[LinearPrior, ...] = ()
    """Known lengths, as priors of the scale."""
    most: int = MOST_OBSERVATIONS
    """Most observations that are adjusted."""
    most_points: int | None = None
    """Most points that are adjusted, besides board corners; None: no limit."""

    @property
    def is_determined(self) -> bool:
        """Whether the observations have more coordinates than the camera poses and points have unknowns."""
        found = self.observations
        return 2 * len(found.image) > 6 * int(self.used.sum()) + 3 * len(np.unique(found.point))

    @cached_property
    def observations(self) -> Tracks:
        """Observations to adjust, at most `most` of those in the used images; their image indices count these images."""
        found = of_images(self.tracks, self.used)
        is_few = len(found.image) <= self.most and self.most_points is None
        return found if is_few else some_points(found, self.most, self.most_points)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """Calibration as it passes through fit, adjustment and checks: inputs, model, solution and findings.

    Checks return another case by `found` (more findings) or `solved` (another model). The calibration follows from
    these (`calibration`), and nothing is read back from it. Pose arrays have the m registered images in the order of
    the reconstruction.
    """

    capture: Capture
    reconstruction: Reconstruction
    options: CalibrateOptions
    robot: RobotErrorPrior
    """Prior covariance of the systematic errors of the registered images' gripper poses."""
    pose_model: PoseModel = PoseModel()
    """Assumptions of a fit to the poses of the registered images, with priors on known scale and camera height."""
    fit: Calibration
    """Fit to camera poses, the initial estimate of the bundle adjustment, with the findings of its motions."""
    model: Model
    solution: Solution | None = None
    """Solution of the model; None if the images are not adjusted."""
    numbers: Calibration
    """Numbers of the result, without findings and without their errors: those of the solution, or of the fit."""
    findings: tuple[Finding, ...] = ()
    """Findings of the checks, in their order."""

    @property
    def carries(self) -> Literal["camera", "scene"]:
        """Object that the gripper carries: "scene" if the camera is fixed and observes what the gripper carries."""
        return "scene" if self.capture.mount == "base" else "camera"

    @property
    def base_from_gripper(self) -> Float[ndarray, "m 4 4"]:
        """Reported gripper poses (m) of the m registered images, in the order of the reconstruction."""
        return self.capture.base_from_gripper[self.reconstruction.image_index]

    @property
    def moving(self) -> Float[ndarray, "m 4 4"]:
        """Poses (m) of the body that moves with the camera, in the frame of the scene, up to constant transforms.

        They are base_from_gripper, or gripper_from_base for a fixed camera.
        """
        return self.of_arm(self.base_from_gripper)

    def of_arm(self, poses: Poses) -> Poses:
        """Return the poses of `moving` as base_from_gripper, or the other way round."""
        return inverse(poses) if self.carries == "scene" else poses

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
        return np.flatnonzero(self.model.used)

    @property
    def names(self) -> list[str]:
        """Names of the registered images."""
        return [self.capture.images[row] for row in self.reconstruction.image_index]

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the case: its numbers, all findings, and the errors that the findings state."""
        return judged(self.numbers, self.motions, self._with_settled())

    @cached_property
    def motions(self) -> tuple[Finding, ...]:
        """Findings on the directions that the motions of the used images do not determine, and on too few used images.

        If only the motions of all images, not those of the used ones, are observable, the remedy is a better
        reconstruction. If the poses of all registered images would be observable but few of them agree, the used images
        agree by chance, and nothing is found. Nothing is concluded from gripper poses that contradict the images.
        """
        unseen, capture = self.fit.findings, self.capture
        if (
            len(self.used) == len(capture)
            or not unseen
            or observability(self.of_arm(capture.base_from_gripper)).findings
        ):
            return unseen
        of_numbers = findings_of(self.numbers, unseen)
        kinds = {one.kind for one in of_numbers}
        if FindingKind.FEW_AGREE in kinds and not observability(self.moving).findings:
            return ()
        if FindingKind.POSES_CONTRADICT_IMAGES in kinds:
            return unseen
        rejected = any(one.severity == "rejects" for one in (*unseen, *of_numbers))
        counts = {"value": float(len(self.used)), "of": float(len(capture))}
        few = Finding.of(FindingKind.FEW_USED, "rejects" if rejected else "warns", "reconstruction", **counts)
        return (*(replace(one, concerns="reconstruction") for one in unseen), few)

    def _with_settled(self) -> tuple[Finding, ...]:
        """Return the findings, after one that states that the rounds of the solution did not converge, if so."""
        found = self.solution
        if found is None or found.settled or self.numbers.source == "poses":
            return self.findings
        # The iterations ended before the steps and the estimated sizes of the errors converged.
        severity = "warns" if found.last_step > MATERIAL else "informs"
        size = {"value": found.last_step, "rounds": float(found.iterations)}
        return (Finding.of(FindingKind.NOT_SETTLED, severity, "reconstruction", **size), *self.findings)

    @property
    def scene_distance_m(self) -> float | None:
        """Median depth (m) of the observed points along the optical axis; None where the images were not adjusted."""
        if self.solution is None or self.numbers.source == "poses":
            return None
        return float(np.median(self.solution.images.view.depth)) * self.solution.state.scale

    @property
    def observable(self) -> bool:
        """Whether the motions of the used images determine every direction, if only weakly."""
        return self.calibration.observability.observable

    @property
    def is_open(self) -> bool:
        """Whether the motions are observable and no known cause, such as static images, rejects the calibration.

        A known cause is a finding that explains others (`is_explained`).
        """
        return self.observable and not is_explained(self.calibration.findings)

    def found(self, *findings: Finding) -> "Case":
        """Return the case with more findings; those that explain a rejection reject (verdict.appended)."""

        def calibration(these: Sequence[Finding]) -> Calibration:
            return replace(self, findings=tuple(these)).calibration

        return replace(self, findings=appended(self.findings, findings, calibration)) if findings else self


def camera_of(capture: Capture, reconstruction: Reconstruction) -> CameraPrior:
    """Return the prior of the intrinsics before the calibration: mean (those of the reconstruction) and covariance.

    The standard deviations depend on whether the intrinsics were given, estimated, or predicted by a network.
    """
    given, found = capture.intrinsics, reconstruction.intrinsics
    if given is None and reconstruction.predicted_focal is not None:
        of_center = {name: ESTIMATED[name] for name in ("aspect", "cx", "cy")}
        return camera_with_prior(found, {"f": reconstruction.predicted_focal[1], **of_center})
    # A distortion that folds over is not used, so that nothing is known of it.
    of_distortion = not usable_intrinsics(given)[1]
    return camera_about(found, given is not None, capture.intrinsics_std, of_distortion)


def with_prism(case: Case) -> CameraPrior:
    """Return the prior of the case's camera with the coefficients of a thin prism in addition."""
    given, lens = case.capture.intrinsics, with_thin_prism(case.reconstruction.intrinsics)
    if given is not None and given.model == lens.model:
        return case.model.camera
    return camera_with_prior(lens, {**(ESTIMATED if given is None else MEASURED), **PRISM})


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
