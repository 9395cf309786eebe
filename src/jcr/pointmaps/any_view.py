"""Reconstruction by an any-view model: one prediction, refined by photometric matches between the images.

A prediction is no measurement: models invent geometry where they see none, and their metre on a table is often wrong by
tens of percent. The confidences therefore weigh points within an image and nothing else. The calibration gets camera
poses with the joint covariance of the matches (refine.py). The robot gives the scale; the metre of a metric model is
only compared. Predicted or refined cameras are used, whichever have the smaller leave-one-out error.
"""

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import rays
from jcr.errors import InputError
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.geometry import apply
from jcr.hub import Weights
from jcr.pointmaps.grid import ImageGrid, PreparedImages, prepare_images, resize_and_crop
from jcr.pointmaps.interface import Predict, Predicted, Views
from jcr.pointmaps.posed import PosedPointmaps, fit_pinhole, reconstruction_from_pointmaps
from jcr.pointmaps.refine import Refined, refine
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, HandEye, Intrinsics, Pointmaps, Reconstruction

PREDICTED_STD = (0.02, np.radians(1.5))
"""Of a predicted camera that no match confirms: of its distance from the scene, and of its rotation per axis. What Depth
Anything 3's largest model has on 7-Scenes (27 % of pairs within an average threshold of 3°, its benchmark page)."""


@dataclass(frozen=True, kw_only=True)
class ViewsOptions:
    """One model and where it runs."""

    backend: str
    """Its row of the table of back ends, for the record."""
    load: Callable[[Path, str], Predict]
    """Loads the model from the folder of its weights, on the device."""
    weights: Weights
    device: str = "cpu"


@dataclass(frozen=True)
class _Candidate:
    """One account of the views, and how well images left out agree with it."""

    name: str
    predicted: Predicted
    refined: Refined | None
    hand_eye: HandEye

    @property
    def poses(self) -> Float[ndarray, "n 4 4"]:
        """Return recon_from_camera of all views."""
        return (self.refined or self.predicted).recon_from_camera

    @property
    def points(self) -> Float[ndarray, "n h w 3"]:
        factor = 1 if self.refined is None else self.refined.depth_factor[..., None]
        return self.predicted.x_in_camera * factor

    @property
    def leave_one_out_m(self) -> float:
        """The leave-one-out error as one length; infinite where there are too few to leave one out."""
        error = self.hand_eye.leave_one_out
        return float("inf") if error is None else error.length_m

    def error_in_words(self) -> str:
        error = self.hand_eye.leave_one_out
        if error is None:
            return self.name
        return f"{self.name} {error.translation_mm:.2g} mm, {error.rotation_deg:.2g}°"


def reconstruct_views_at_once(
    capture: Capture, options: ViewsOptions, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses with their covariance, pointmaps and tracks; in the model's own unit.

    Raises InputError for weights that are missing or damaged.
    """
    report = progress or silent
    images = prepare_images(capture, lambda size: ImageGrid.uncropped(size, size))
    predict = loaded(options.load, options.weights.path, options.device)
    report("reconstruct", 0.0)
    predicted = with_known_rays(predict(Views(images.colors, images.pinhole)), images)
    report("reconstruct", 0.5)
    pinhole = images.pinhole or _own_pinhole(predicted, options.backend)
    chosen, note = _predicted_or_refined(capture.base_from_gripper, images, predicted, pinhole)
    report("reconstruct", 1.0)
    return _record(capture, images, chosen, options, note)


def loaded(load: Callable[[Path, str], Predict], weights: Path, device: str) -> Predict:
    """A model that prints nothing on stdout, which is for the command's result; packages print there."""
    with redirect_stdout(sys.stderr):
        predict = load(weights, device)

    def predict_quietly(views: Views) -> Predicted:
        with redirect_stdout(sys.stderr):
            return predict(views)

    return predict_quietly


def with_known_rays(predicted: Predicted, images: PreparedImages) -> Predicted:
    """With each point on the ray of its pixel, where the intrinsics are known: a model guesses them by a percent."""
    if images.pinhole is None:
        return predicted
    known = predicted.grid.grid_intrinsics(images.pinhole)
    points = predicted.x_in_camera[..., 2:] * rays(known).astype(np.float32)
    pinholes = np.tile([known.fx, known.fy, known.cx, known.cy], (len(points), 1))
    return replace(predicted, x_in_camera=points, pinholes=pinholes)


def _own_pinhole(predicted: Predicted, backend: str) -> Intrinsics:
    """One pinhole of the undistorted images, of all views together, as the model sees them."""
    at_origin = np.tile(np.eye(4), (len(predicted.confidence), 1, 1))
    found, misfit_px = fit_pinhole(at_origin, predicted.x_in_camera, predicted.confidence)
    if not np.isfinite(misfit_px):
        raise InputError(f"--backend {backend}: its points lie on no pinhole's rays; give the intrinsics")
    return predicted.grid.original_intrinsics(found)


def _predicted_or_refined(
    gripper: Float[ndarray, "n 4 4"], images: PreparedImages, predicted: Predicted, pinhole: Intrinsics
) -> tuple[_Candidate, str]:
    """Select the prediction or its refinement by the leave-one-out error, and return it with a note."""
    as_predicted = _candidate("as predicted", gripper, predicted, None)
    refined = refine(predicted, images, pinhole)
    if refined is None:
        return as_predicted, "too few matches by colour: the cameras are as the model has them"
    adjusted = _candidate("refined", gripper, predicted, refined)
    kept, left = (
        (adjusted, as_predicted)
        if adjusted.leave_one_out_m < as_predicted.leave_one_out_m
        else (as_predicted, adjusted)
    )
    note = (
        f"leave-one-out error of the cameras {kept.error_in_words()} ({left.error_in_words()}): the former were kept; "
        f"{len(refined.tracks.image)} matches by colour, {refined.error_px:.2f} px"
    )
    return kept, note


def _candidate(
    name: str, gripper: Float[ndarray, "n 4 4"], predicted: Predicted, refined: Refined | None
) -> _Candidate:
    """With the hand-eye transform of its camera poses."""
    poses = (refined or predicted).recon_from_camera
    covariance = None if refined is None else refined.evidence.covariance
    return _Candidate(name, predicted, refined, solve_hand_eye(gripper, poses, camera_covariance=covariance))


def _record(
    capture: Capture,
    images: PreparedImages,
    chosen: _Candidate,
    options: ViewsOptions,
    note: str,
) -> Reconstruction:
    """Return the reconstruction with the evidence of the images alone."""
    predicted, refined, poses, points = chosen.predicted, chosen.refined, chosen.poses, chosen.points
    grid, pinhole = predicted.grid, images.pinhole
    if pinhole is None and refined is not None:
        pinhole = refined.pinhole
        points = points[..., 2:] * rays(grid.grid_intrinsics(pinhole)).astype(np.float32)
    in_recon = np.stack([apply(pose, mine) for pose, mine in zip(poses, points, strict=True)])
    maps = PosedPointmaps(
        np.arange(len(capture)),
        poses,
        np.where((predicted.confidence > 0)[..., None], in_recon.astype(np.float32), 0),
        predicted.confidence,
    )
    colors = np.stack([resize_and_crop(image, grid) for image in images.colors])
    notes = (options.weights.note, note)
    if refined is None:
        made = reconstruction_from_pointmaps(
            replace(images, colors=colors, grid=grid, pinhole=pinhole),
            maps,
            source=options.backend,
            backend=options.backend,
            is_metric=predicted.is_metric,
            notes=notes,
        )
        return replace(made, evidence=predicted_evidence(predicted))
    return Reconstruction(
        image_index=maps.image_index,
        recon_from_camera=poses,
        intrinsics=images.intrinsics_of_capture or refined.pinhole,
        pointmaps=Pointmaps(
            intrinsics=grid.grid_intrinsics(pinhole or refined.pinhole),
            points_in_recon=maps.points_in_recon,
            confidence=predicted.confidence,
            colors=colors,
        ),
        tracks=refined.tracks,
        backend=options.backend,
        is_metric=predicted.is_metric,
        notes=notes,
        warnings=images.warnings,
        evidence=refined.evidence,
    )


def predicted_evidence(predicted: Predicted) -> CameraEvidence:
    """Predicted cameras with the error that such models are known for, each its own, the first one's in all others.

    Steps are relative to the first camera: its own error rotates all others about it.
    """
    poses = predicted.recon_from_camera
    there = predicted.confidence > 0
    distance = float(np.median(predicted.x_in_camera[..., 2][there]))
    single = np.repeat([(PREDICTED_STD[0] * distance) ** 2, PREDICTED_STD[1] ** 2], 3)
    count = len(poses)
    covariance = np.zeros((count, 6, count, 6))
    by_first = np.tile(np.eye(6), (count, 1, 1))
    arm = poses[:, :3, 3] - poses[0, :3, 3]
    for axis in range(3):
        by_first[:, :3, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    for n in range(count):
        for m in range(count):
            covariance[n, :, m] = by_first[n] @ np.diag(single) @ by_first[m].T
        covariance[n, :, n] += np.diag(single)
    covariance[0], covariance[:, :, 0] = 0, 0
    return CameraEvidence(poses, covariance.reshape(6 * count, 6 * count))
