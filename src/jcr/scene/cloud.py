"""Metric point cloud in the base frame from pointmaps and a calibration (JCR, section IV-C)."""

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import apply, apply_similarity, by_similarity, inverse, scale_translation
from jcr.records import MATCHED, PRIOR, Capture, HandEye, PointCloud, Reconstruction
from jcr.scene.options import CloudOptions

LEAST_SURE = 40.0
"""Percent of the points that rest on matching alone, the least confident, to which the way counts as seen by no one:
few images agree on them, and a depth that ends too deep is one of theirs. It takes a third of what is free and wrong."""


def point_cloud(
    capture: Capture,
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    labels: Integer[ndarray, "m h w"] | None = None,
    options: CloudOptions | None = None,
    label_names: tuple[str, ...] = ("none",),
) -> PointCloud:
    """Return the confident points in the base frame, with colour, label, margin and the image of each.

    `labels` (m,h,w) are segments at the pointmaps' pixels, 0 = none; `label_names` names them.
    Raises InputError when no point passes the threshold.
    """
    options = options or CloudOptions()
    dense = reconstruction.dense
    confidence = dense.confidence
    keep = confidence > 0
    # Depths on a plane have passed tests of their own, and hardly any is wrong.
    alone = keep if dense.reason is None else keep & (dense.reason == MATCHED)
    if options.confidence_threshold is not None:
        keep &= confidence >= options.confidence_threshold
    elif alone.any():
        keep &= ~alone | (confidence >= np.percentile(confidence[alone], options.confidence_percentile))
    pixel = np.flatnonzero(keep)
    if len(pixel) == 0:
        best = float(confidence.max()) if confidence.size else 0.0
        raise InputError(
            f"{capture.folder}: no point is confident enough for a map (the best confidence is {best:.3g}); "
            "lower --confidence-threshold or add images with more overlap"
        )
    if len(pixel) > options.max_points:
        draw = np.random.default_rng(options.cloud_seed)
        pixel = np.sort(draw.choice(pixel, options.max_points, replace=False))

    image = pixel // confidence[0].size
    confident = confidence.reshape(-1)[pixel].astype(np.float64)
    reason = None if dense.reason is None else dense.reason.reshape(-1)[pixel]
    x_in_recon = dense.points_in_recon.reshape(-1, 3)[pixel].astype(np.float64)
    recon_from_camera = scale_translation(reconstruction.recon_from_camera, hand_eye.scale)
    return PointCloud(
        points_in_base=apply_similarity(hand_eye.base_from_recon, hand_eye.scale, x_in_recon),
        color=dense.colors.reshape(-1, 3)[pixel],
        confidence=confident,
        margin=position_std(hand_eye, recon_from_camera, image, hand_eye.scale * x_in_recon),
        label=np.zeros(len(pixel), int) if labels is None else labels.reshape(-1)[pixel].astype(int),
        image=image,
        camera_centers_in_base=apply(hand_eye.base_from_recon, recon_from_camera[:, :3, 3]),
        label_names=label_names,
        reason=reason,
        depth_std=None
        if dense.depth_std is None
        else hand_eye.scale * dense.depth_std.reshape(-1)[pixel].astype(np.float64),
        clears=None
        if reason is None
        else _clears(reason, confident, reconstruction.image_index[image] >= len(capture)),
    )


def _clears(
    reason: UInt8[ndarray, " n"], confidence: Float[ndarray, " n"], added: Bool[ndarray, " n"]
) -> Bool[ndarray, " n"]:
    """Test which points show that the space before them is free: no priors, no doubtful matches.

    Images that were `added` to a run show what has changed, where the others contradict them: there no match is too
    doubtful to say that a thing was taken away.
    """
    alone = (reason == MATCHED) & ~added
    least = np.percentile(confidence[alone], LEAST_SURE) if alone.any() else 0.0
    return (reason != PRIOR) & ~(alone & (confidence < least))


def position_std(
    hand_eye: HandEye,
    recon_from_camera: Float[ndarray, "m 4 4"],
    image: Integer[ndarray, " n"],
    x_in_recon: Float[ndarray, "n 3"],
) -> Float[ndarray, " n"]:
    """Return the standard deviation (m) of each point in the worst direction, as far as the calibration causes it.

    `recon_from_camera` and `x_in_recon` are metric. Where images were adjusted it is that of the scene in the base
    frame. Of camera poses alone, a point that image i sees at x in its camera lies in the base frame at
    base_from_gripper[i] · gripper_from_camera · x, and errs as X and the scale do.
    """
    placed = None if hand_eye.in_use is None else hand_eye.in_use.scene
    if placed is not None:
        covariance = placed.covariance_at(apply(hand_eye.base_from_recon, x_in_recon))
    else:
        recon_to_camera = inverse(recon_from_camera)
        x_in_camera = np.einsum("nij,nj->ni", recon_to_camera[image, :3, :3], x_in_recon)
        x_in_camera += recon_to_camera[image, :3, 3]
        by = by_similarity(x_in_camera @ hand_eye.gripper_from_camera[:3, :3].T)
        covariance = by @ hand_eye.covariance @ np.swapaxes(by, -1, -2)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))
