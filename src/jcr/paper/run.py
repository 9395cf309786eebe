"""Algorithm 1 of the paper: images and end-effector poses to hand-eye transform, scale and scene representation."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Int
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import PublishedCalibration
from jcr.errors import InputError, RejectedError
from jcr.estimation.pose_equations import paper_residuals
from jcr.findings import Finding, FindingKind
from jcr.geometry import apply, inverse, scale_translation
from jcr.hub import Weights
from jcr.paper.alignment import align
from jcr.paper.hand_eye import solve
from jcr.pointmaps.dust3r.dust3r import predict_capture
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pairs import PairPredictions, complete_pairs, read_arrays
from jcr.pointmaps.predictions import predicted_pairs, reconstruct_predictions
from jcr.pointmaps.reconstruction import NO_TRACKS
from jcr.progress import Progress, silent
from jcr.reconstruct import BACKENDS, ReconstructOptions, candidates, device_of, network_weights, reconstruct
from jcr.records import (
    Capture,
    ImageVerdict,
    Intrinsics,
    PaperResiduals,
    Pointmaps,
    PosePairs,
    Reconstruction,
)
from jcr.sfm.given import shared_intrinsics
from jcr.sfm.model import poses_of, quiet_colmap, tracks_of

NETWORKS, BASELINE, FILE = ("dust3r", "mast3r"), "colmap", "predictions"
"""Names of the back ends of the published method: networks for pairs of images, the baseline, and a file of a network's
predictions."""


def reconstruct_published(
    capture: Capture, options: ReconstructOptions, progress: Progress | None = None
) -> Reconstruction:
    """Return camera poses P_i, pointmaps X̂_i and confidences C_i of a capture (line 1 of Algorithm 1).

    Nothing refines them. For `auto`, the back end is the first of `candidates` that the method has; networks are before
    COLMAP. Raises InputError for another back end, RejectedError if the reconstruction fails.
    """
    names = candidates(options)
    known = [name for name in (FILE, *NETWORKS, BASELINE) if name in names]
    if not known:
        raise InputError(
            f"--method paper: has no back end {names[0]}; choose {', '.join((*NETWORKS, FILE, BASELINE))}"
        )
    row = BACKENDS[known[0]]
    if not row.is_installed() or (row.needs and getattr(options, row.needs) is None):
        return reconstruct(capture, replace(options, backend=row.name))  # raises InputError with the remedy
    if row.name == BASELINE:
        return reconstruct_baseline(capture, options.seed, progress)
    device = device_of(options)
    if row.name == FILE:
        path = options.predictions
        assert path is not None  # tested above
        arrays = read_arrays(path)
        if "edges" not in arrays:
            return reconstruct_predictions(capture, path, progress, refining=False)
        predictions, images, rows = predicted_pairs(capture, arrays, str(path))
        notes = ()
    else:
        weights: Weights = network_weights(replace(options, backend=row.name))
        rows, edges = np.arange(len(capture)), complete_pairs(len(capture))
        # The paper gives the images to the network as they are, without known intrinsics.
        raw = replace(capture, intrinsics=None)
        predictions, images, notes = predict_capture(raw, edges, weights, device, progress)
    made = _aligned(predictions, images, rows, row.name, device, progress)
    return replace(made, notes=(*notes, *made.notes))


def _aligned(
    predictions: PairPredictions,
    images: PreparedImages,
    rows: Int[ndarray, " m"],
    backend: str,
    device: str,
    progress: Progress | None,
) -> Reconstruction:
    """Return the alignment of pairs (eq. 1) as a reconstruction of the capture's images `rows`.

    The focal length is that of the alignment, also if the capture gives intrinsics.
    """
    alignment = align(replace(predictions, intrinsics=images.intrinsics), device=device, progress=progress)
    _, height, width = alignment.depth.shape
    pinhole = Intrinsics(*alignment.focal_px, *alignment.principal_point_px, width, height)
    in_camera = alignment.x_in_camera()
    points = np.stack([apply(*one) for one in zip(alignment.recon_from_camera, in_camera, strict=True)])
    return Reconstruction(
        image_index=rows,
        recon_from_camera=alignment.recon_from_camera,
        intrinsics=images.grid.original_intrinsics(pinhole),
        tracks=NO_TRACKS,
        pointmaps=Pointmaps(
            intrinsics=pinhole,
            points_in_recon=points.astype(np.float32),
            confidence=alignment.confidence,
            colors=images.colors,
        ),
        backend=backend,
        is_metric=predictions.is_metric,
        warnings=images.warnings,
    )


def reconstruct_baseline(capture: Capture, seed: int = 0, progress: Progress | None = None) -> Reconstruction:
    """Return the largest model of COLMAP by its defaults, the baseline of Table I, without use of the gripper poses.

    All images have one camera, whose intrinsics COLMAP estimates. Raises RejectedError with fewer than two images.
    """
    report, cpu = progress or silent, pycolmap.Device.cpu
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = seed, 1
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-paper-") as folder:
        database, names = Path(folder) / "database.db", list(capture.images)
        single = pycolmap.CameraMode.SINGLE
        pycolmap.extract_features(database, capture.folder, names, camera_mode=single, device=cpu)
        report("mapping", 0.3)
        pycolmap.match_exhaustive(database, device=cpu)
        report("mapping", 0.6)
        models = pycolmap.incremental_mapping(database, capture.folder, folder, options)
        report("mapping", 1.0)
        model = max(models.values(), key=lambda one: one.num_reg_images(), default=None)
        rows = {names.index(model.image(k).name): k for k in model.reg_image_ids()} if model else {}
        if model is None or len(rows) < 2:
            raise RejectedError(
                f"COLMAP by its defaults registered {len(rows)} of {len(capture)} images",
                "overlap the views more, or use --backend dust3r",
            )
        kept = sorted(rows)
        ids = [rows[row] for row in kept]
        return Reconstruction(
            image_index=np.array(kept),
            recon_from_camera=poses_of(model, [k - 1 for k in ids]),
            intrinsics=shared_intrinsics(model, ids, capture.image_size, "COLMAP"),
            tracks=tracks_of(model, ids, capture.image_size),
            backend=BASELINE,
        )


def calibrate_published(
    capture: Capture | PosePairs, made: Reconstruction | PosePairs, options: CalibrateOptions | None = None
) -> PublishedCalibration:
    """Return gripper_from_camera, λ and residuals from a reconstruction or given poses (lines 2 to 4 of Algorithm 1).

    base_from_recon is that of line 6 (eq. 12), by the pose of the first image. Raises InputError for options, which the
    method has none of, and for a fixed camera; RejectedError if the solver fails.
    """
    if options is not None and (given := _changed(options)):
        raise InputError(f"--method paper: does not use --{given.replace('_', '-')}; leave it out")
    if isinstance(capture, Capture) and capture.mount != "gripper":
        raise InputError("--method paper: is for a camera on the gripper; leave it out")
    rows = made.image_index
    gripper, camera = capture.base_from_gripper[rows], made.recon_from_camera
    x, scale = solve(gripper, camera)
    used = set(rows.tolist())
    why = f"not registered by {made.backend}"
    return PublishedCalibration(
        method="paper",
        on_gripper=x,
        resting=gripper[0] @ x @ inverse(scale_translation(camera[:1], scale))[0],
        scale=scale,
        residuals=PaperResiduals(*paper_residuals(gripper, camera, x, scale, np.ones(len(rows), bool))),
        backend=made.backend,
        intrinsics=None if isinstance(made, PosePairs) else made.intrinsics.with_std(None),
        images=tuple(
            ImageVerdict(image=name, used=row in used, reason=None if row in used else why)
            for row, name in enumerate(capture.images)
        ),
        notes=() if isinstance(made, PosePairs) else made.notes,
        findings=(Finding.of(FindingKind.NOT_CHECKED, "warns", "none"),),
    )


def _changed(options: CalibrateOptions) -> str | None:
    """Return the name of an option that is not at its default, None if all are."""
    default = CalibrateOptions()
    return next((name for name, value in vars(options).items() if value != getattr(default, name)), None)
