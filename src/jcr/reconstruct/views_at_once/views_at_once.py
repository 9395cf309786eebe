"""The back ends of any-view models: one pass, compared with the robot's motion, refined by the images' colours.

A prediction is no measurement: models invent geometry where they see none, and their metre on a table is often wrong by
tens of percent. So its confidences weigh points within an image and nothing else. What flows on is camera poses
with a joint covariance that the images' own matches give (refine.py), the robot gives the scale, and the model's metre
is a check of it. What is kept, of the prediction, its refinement, and a second pass that is shown the poses of the
first calibration, is what predicts images left out best.
"""

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import project, rays, unproject
from jcr.errors import InputError
from jcr.geometry import apply, inverse, rotation_angle
from jcr.handeye.solve import solve_hand_eye
from jcr.memory import ALLOWANCE, GB, announce, require, resident
from jcr.progress import Progress, silent
from jcr.reconstruct.hub import Weights
from jcr.reconstruct.pointmaps import PosedPointmaps, fit_pinhole, reconstruction_from_pointmaps
from jcr.reconstruct.preprocess import ImageGrid, PreparedImages, prepare_images, resize_and_crop
from jcr.reconstruct.views_at_once.interface import Predict, Predicted, Views
from jcr.reconstruct.views_at_once.refine import Refined, refine
from jcr.records import CameraEvidence, Capture, HandEye, Intrinsics, Pointmaps, Reconstruction, Tracks

PREDICTED_STD = (0.02, np.radians(1.5))
"""Of a predicted camera that no match confirms: of its distance from the scene, and of its rotation per axis. What Depth
Anything 3's largest model has on 7-Scenes (27 % of pairs within an average threshold of 3°, its benchmark page)."""
FAR_OFF = 4.0
"""A view whose angle or matches differ from the robot's by this many times the median of the views is named."""
FAR_OFF_DEG, FAR_OFF_PX = 2.0, 10.0
"""And by at least this."""


CLEARLY = 0.95
"""Of the first pass's error that a second one must stay below: it is another draw of the same model."""


@dataclass(frozen=True)
class Cost:
    """Linear in the number of views for memory, quadratic for time: attention over all views at once."""

    base_gb: float
    """Weights, in main memory, and what their library takes."""
    view_gb: float
    """Memory of each view."""
    view_s: float
    """Seconds for each view on one core of a desktop's processor."""
    pair_s: float
    """Seconds for each pair of views on that core."""

    def bytes(self, views: int) -> float:
        """Peak of main memory on a CPU, over what the program takes without it."""
        return GB * (self.base_gb + self.view_gb * views)

    def seconds(self, views: int) -> float:
        """On one core of a CPU."""
        return self.view_s * views + self.pair_s * views * (views - 1) / 2

    def sentence(self, views: int, device: str) -> str:
        """For the line that announces the work."""
        if device != "cpu":
            return f", and {self.bytes(views) / GB:.1f} GB of the GPU's"
        return f", and about {self.seconds(views):.0f} s on one core"


@dataclass(frozen=True, kw_only=True)
class ViewsOptions:
    """One model and where it runs."""

    backend: str
    """Its row of the table of back ends, for the record."""
    load: Callable[[Path, str], Predict]
    """Loads the model from the folder of its weights, on the device."""
    weights: Weights
    cost: Cost
    takes_poses: bool = False
    device: str = "cpu"
    memory_gb: float = 8.0


@dataclass(frozen=True)
class _Candidate:
    """One account of the views, and how well images left out agree with it."""

    name: str
    predicted: Predicted
    refined: Refined | None
    hand_eye: HandEye

    @property
    def poses(self) -> Float[ndarray, "n 4 4"]:
        poses = self.predicted.recon_from_camera if self.refined is None else self.refined.recon_from_camera
        assert poses is not None
        return poses

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

    Raises InputError for weights that are missing or damaged, or where the memory does not suffice.
    """
    report = progress or silent
    _require_memory(capture, options)
    images = prepare_images(capture, lambda size: ImageGrid.uncropped(size, size))
    predict = loaded(options.load, options.weights.path, options.device)
    report("reconstruct", 0.0)
    predicted = with_known_rays(predict(Views(images.colors, images.pinhole)), images)
    report("reconstruct", 0.5)
    if predicted.recon_from_camera is None:
        raise InputError(
            f"--backend {options.backend} sees one view at a time and gives no cameras; choose another"
        )
    pinhole = images.pinhole or _own_pinhole(predicted, options.backend)
    chosen, notes, warnings = _predicted_or_refined(capture, images, predicted, pinhole)
    if options.takes_poses and chosen.hand_eye.converged:
        chosen, note = _second_pass(capture, images, chosen, pinhole, predict)
        notes = (*notes, note)
    report("reconstruct", 1.0)
    return _record(capture, images, chosen, options, notes, warnings)


def loaded(load: Callable[[Path, str], Predict], weights: Path, device: str) -> Predict:
    """A model that prints nothing on stdout, which is for the command's result; packages print there."""
    with redirect_stdout(sys.stderr):
        predict = load(weights, device)

    def predict_quietly(views: Views) -> Predicted:
        with redirect_stdout(sys.stderr):
            return predict(views)

    return predict_quietly


def _require_memory(capture: Capture, options: ViewsOptions) -> None:
    """Say what it will take, before it is begun."""
    width, height = capture.image_size
    colors = len(capture) * width * height * (3 + 4)
    needed = (
        resident() + ALLOWANCE + colors + (options.cost.bytes(len(capture)) if options.device == "cpu" else 0)
    )
    require(int(needed), options.memory_gb * GB, f"--backend {options.backend} with {len(capture)} images")
    announce(int(needed), options.memory_gb * GB, options.cost.sentence(len(capture), options.device))


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
    assert predicted.recon_from_camera is not None
    at_origin = np.tile(np.eye(4), (len(predicted.confidence), 1, 1))
    found, misfit_px = fit_pinhole(at_origin, predicted.x_in_camera, predicted.confidence)
    if not np.isfinite(misfit_px):
        raise InputError(f"--backend {backend}: its points lie on no pinhole's rays; give the intrinsics")
    return predicted.grid.original_intrinsics(found)


def _predicted_or_refined(
    capture: Capture, images: PreparedImages, predicted: Predicted, pinhole: Intrinsics
) -> tuple[_Candidate, tuple[str, ...], tuple[str, ...]]:
    """The prediction or its refinement, whichever predicts images left out better; notes; and warnings."""
    gripper = capture.base_from_gripper
    as_predicted = _candidate("as predicted", gripper, predicted, None)
    refined = refine(predicted, images, pinhole)
    if refined is None:
        note = "too few matches by colour: the cameras are as the model has them"
        return as_predicted, (note,), _contradicted(capture, as_predicted, pinhole)
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
    return kept, (note,), _contradicted(capture, kept, pinhole)


def _candidate(
    name: str, gripper: Float[ndarray, "n 4 4"], predicted: Predicted, refined: Refined | None
) -> _Candidate:
    """With the hand-eye transform of its camera poses."""
    poses = predicted.recon_from_camera if refined is None else refined.recon_from_camera
    assert poses is not None
    covariance = None if refined is None else refined.evidence.covariance
    return _Candidate(name, predicted, refined, solve_hand_eye(gripper, poses, camera_covariance=covariance))


def _contradicted(capture: Capture, candidate: _Candidate, pinhole: Intrinsics) -> tuple[str, ...]:
    """Views whose rotations, or whose matches by epipolar geometry with the hand-eye transform, contradict the robot."""
    camera, gripper = candidate.poses, capture.base_from_gripper
    apart = _angle_differences_deg(camera, gripper)
    named = {}
    for k in np.flatnonzero(apart > max(FAR_OFF_DEG, FAR_OFF * float(np.median(apart)))):
        named[k] = f"its angles to the other views differ from the robot's by {apart[k]:.1f}°"
    refined = candidate.refined
    if refined is not None and candidate.hand_eye.observability.observable:
        base_from_camera = gripper @ candidate.hand_eye.gripper_from_camera
        distance = epipolar_px(base_from_camera, refined.tracks, capture, pinhole, candidate.hand_eye.inliers)
        for k in np.flatnonzero(distance > max(FAR_OFF_PX, FAR_OFF * float(np.median(distance)))):
            named.setdefault(k, f"its matches lie {distance[k]:.0f} px from the robot's epipolar lines")
    return tuple(f"{capture.images[k]}: {why} (median); check its pose" for k, why in sorted(named.items()))


def _angle_differences_deg(
    camera: Float[ndarray, "n 4 4"], gripper: Float[ndarray, "n 4 4"]
) -> Float[ndarray, " n"]:
    """Per view the median, over the others, of how far camera and gripper disagree on the angle between two views.

    It is the same for both, wherever the camera is mounted.
    """
    angles = [
        np.degrees(rotation_angle((inverse(poses)[:, None] @ poses[None])[..., :3, :3]))
        for poses in (camera, gripper)
    ]
    difference = np.abs(angles[0] - angles[1])
    np.fill_diagonal(difference, np.nan)
    return np.nanmedian(difference, axis=1)


def epipolar_px(
    base_from_camera: Float[ndarray, "n 4 4"],
    tracks: Tracks,
    capture: Capture,
    pinhole: Intrinsics,
    inliers: Bool[ndarray, " n"],
) -> Float[ndarray, " n"]:
    """Per view the median distance, in pixels, of matches with inlier views from the epipolar lines of their keypoints.

    Lines are drawn by cameras that the robot and a hand-eye transform give, without distortion. Zero where a view has
    no match.
    """
    intrinsics = capture.intrinsics or pinhole
    direction = unproject(intrinsics, tracks.x_px)
    start, others = _keypoints_and_matches(tracks)
    between = inverse(base_from_camera[tracks.image[others]]) @ base_from_camera[tracks.image[start]]
    normal = np.cross(between[:, :3, 3], np.einsum("kij,kj->ki", between[:, :3, :3], direction[start]))
    line = normal / np.maximum(np.linalg.norm(normal[:, :2], axis=1, keepdims=True), 1e-12)
    distance = pinhole.fx * np.abs((line * direction[others]).sum(1))
    views = tracks.image[start], tracks.image[others]
    medians = []
    for k in range(len(base_from_camera)):
        mine = ((views[0] == k) & inliers[views[1]]) | ((views[1] == k) & inliers[views[0]])
        medians.append(float(np.median(distance[mine])) if mine.any() else 0.0)
    return np.array(medians)


def _keypoints_and_matches(tracks: Tracks) -> tuple[Int[ndarray, " k"], Int[ndarray, " k"]]:
    """Rows of `tracks`: of each match the keypoint, which its point has as its first row, and the match itself."""
    _, first = np.unique(tracks.point, return_index=True)
    first_of = np.full(len(tracks.points_in_recon), -1)
    first_of[tracks.point[first]] = first
    start = first_of[tracks.point]
    others = np.flatnonzero(start != np.arange(len(start)))
    return start[others], others


def _second_pass(
    capture: Capture, images: PreparedImages, first: _Candidate, pinhole: Intrinsics, predict: Predict
) -> tuple[_Candidate, str]:
    """The model once more, shown where the robot and the first pass's hand-eye transform put the cameras.

    Its pointmaps are kept where they predict views left out better; its cameras only repeat what it was shown, so that
    those of the first pass stay, for the robot's poses must not count twice.
    """
    base_from_camera = capture.base_from_gripper @ first.hand_eye.gripper_from_camera
    again = with_known_rays(
        predict(Views(images.colors, images.pinhole or pinhole, base_from_camera)), images
    )
    if first.refined is None or again.recon_from_camera is None:
        return first, "a second pass was not judged: too few matches by colour"
    tracks = first.refined.tracks
    aligned = _in_unit_of(first, again)
    before, after = (
        transfer_px(capture, first.poses, points, first.predicted, tracks, images, pinhole, first.hand_eye)
        for points in (first.points, aligned)
    )
    words = (
        f"second pass, shown the robot's cameras: leave-one-out error of matches {after:.2f} px, before "
        f"{before:.2f} px"
    )
    if not after < CLEARLY * before:
        return first, f"{words}: not kept"
    factor = np.ones(again.confidence.shape, np.float32)
    second = replace(again, x_in_camera=aligned.astype(np.float32), recon_from_camera=first.poses)
    return replace(
        first, predicted=second, refined=replace(first.refined, depth_factor=factor)
    ), f"{words}: kept"


def _in_unit_of(first: _Candidate, again: Predicted) -> Float[ndarray, "n h w 3"]:
    """The points of a second pass, each view by the factor that fits it to the first's: its unit is its own."""
    both = (first.predicted.confidence > 0) & (again.confidence > 0)
    factors = [
        float(np.median(one[mask] / other[mask])) if mask.any() else 1.0
        for one, other, mask in zip(first.points[..., 2], again.x_in_camera[..., 2], both, strict=True)
    ]
    return again.x_in_camera * np.array(factors)[:, None, None, None]


def transfer_px(
    capture: Capture,
    recon_from_camera: Float[ndarray, "n 4 4"],
    x_in_camera: Float[ndarray, "n h w 3"],
    predicted: Predicted,
    tracks: Tracks,
    images: PreparedImages,
    pinhole: Intrinsics,
    hand_eye: HandEye,
) -> float:
    """How far pointmaps put keypoints from where views left out show them: the median, in pixels.

    A view left out has the camera that the robot's motion from the keypoint's view gives, with the hand-eye transform;
    neither its depth nor its predicted camera is used.
    """
    grid, intrinsics = predicted.grid, capture.intrinsics or pinhole
    start, others = _keypoints_and_matches(tracks)
    undistorted = project(images.pinhole or pinhole, unproject(intrinsics, tracks.x_px[start]))
    column, row = np.rint(grid.grid_from_original(undistorted)).astype(int).T
    column, row = np.clip(column, 0, grid.size[0] - 1), np.clip(row, 0, grid.size[1] - 1)
    view = tracks.image[start]
    z = hand_eye.scale * x_in_camera[view, row, column, 2]
    base_from_camera = capture.base_from_gripper @ hand_eye.gripper_from_camera
    between = inverse(base_from_camera[tracks.image[others]]) @ base_from_camera[view]
    x = z[:, None] * unproject(intrinsics, tracks.x_px[start])
    there = np.einsum("kij,kj->ki", between[:, :3, :3], x) + between[:, :3, 3]
    good = (z > 0) & (there[:, 2] > 0)
    if not good.any():
        return float("inf")
    off = project(intrinsics, there[good]) - tracks.x_px[others][good]
    return float(np.median(np.linalg.norm(off, axis=1)))


def _record(
    capture: Capture,
    images: PreparedImages,
    chosen: _Candidate,
    options: ViewsOptions,
    notes: tuple[str, ...],
    warnings: tuple[str, ...],
) -> Reconstruction:
    """As a reconstruction, with the evidence of the images alone."""
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
    notes = (options.weights.note, *notes)
    if refined is None:
        made = reconstruction_from_pointmaps(
            replace(images, colors=colors, grid=grid, pinhole=pinhole),
            maps,
            source=options.backend,
            backend=options.backend,
            is_metric=predicted.is_metric,
            notes=notes,
            warnings=warnings,
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
        warnings=(*images.warnings, *warnings),
        evidence=refined.evidence,
    )


def predicted_evidence(predicted: Predicted) -> CameraEvidence:
    """Predicted cameras with the error that such models are known for, each its own, the first one's in all others.

    Steps are relative to the first camera: its own error rotates all others about it.
    """
    poses = predicted.recon_from_camera
    assert poses is not None
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
