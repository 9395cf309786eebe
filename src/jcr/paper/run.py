"""Algorithm 1 of the paper: images and end-effector poses to hand-eye transform, scale and scene representation."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from jcr.backends import ReconstructOptions, candidates, device_of, network_weights, ready_backend
from jcr.calibration.record import PublishedCalibration
from jcr.capture.options import MIN_FRAMES
from jcr.errors import InputError, RejectedError
from jcr.estimation.pose_equations import paper_residuals
from jcr.findings import Finding, FindingKind
from jcr.geometry import inverse, scale_translation
from jcr.paper.alignment import align
from jcr.paper.hand_eye import solve
from jcr.pointmaps.dust3r.dust3r import predict_capture
from jcr.pointmaps.pair_predictions import complete_pairs, read_arrays
from jcr.pointmaps.posed_pointmaps import PosedPointmaps
from jcr.pointmaps.predictions import predicted_pairs, reconstruct_predictions
from jcr.pointmaps.reconstruction import reconstruct_pointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, ImageVerdict, PaperResiduals, PosePairs, Reconstruction
from jcr.sfm.given import reconstruct_given
from jcr.sfm.model import quiet_colmap

NETWORKS, BASELINE, FILE = ("dust3r", "mast3r"), "colmap", "predictions"
"""Names of the back ends of the published method: networks for pairs of images, the baseline, and a file of a network's
predictions."""


def reconstruct_published(
    capture: Capture, options: ReconstructOptions, progress: Progress = silent
) -> Reconstruction:
    """Return camera poses P_i, pointmaps X̂_i and confidences C_i of a capture (line 1 of Algorithm 1).

    Nothing refines them. For `auto`, the back end is the first of `candidates` that the method has; networks are before
    COLMAP. Raises InputError for another back end, RejectedError if the reconstruction fails.
    """
    names = candidates(options)
    known = [name for name in (FILE, *NETWORKS, BASELINE) if name in names]
    if not known:
        others = ", ".join((*NETWORKS, FILE, BASELINE))
        raise InputError(f"method paper: has no back end {names[0]}; choose {others}")
    name, device, notes = ready_backend(options, known[0]).name, device_of(options), ()
    if name == BASELINE:
        return reconstruct_baseline(capture, options.seed)
    if (path := options.predictions) is not None:
        if "edges" not in (arrays := read_arrays(path)):
            return reconstruct_predictions(capture, path, progress, refining=False)
        predictions, images, rows = predicted_pairs(capture, arrays, str(path))
    else:
        weights = network_weights(replace(options, backend=name))
        rows, edges = np.arange(len(capture)), complete_pairs(len(capture))
        # The paper gives the images to the network as they are, without known intrinsics.
        raw = replace(capture, intrinsics=None)
        predictions, images, notes = predict_capture(raw, edges, weights, device, progress)
    alignment = align(replace(predictions, intrinsics=images.intrinsics), device=device, progress=progress)
    maps = PosedPointmaps(
        grid=images.grid,
        recon_from_camera=alignment.recon_from_camera,
        x_in_camera=alignment.x_in_camera(),
        confidence=alignment.confidence,
        is_metric=predictions.is_metric,
        notes=notes,
    )
    # The focal length is that of the alignment, also if the capture gives intrinsics.
    images = replace(images, intrinsics_of_capture=None, pinhole=None)
    return reconstruct_pointmaps(capture, images, maps, name, progress, rows, refining=False)


def reconstruct_baseline(capture: Capture, seed: int = 0) -> Reconstruction:
    """Return the largest model of COLMAP by its defaults, the baseline of Table I, without use of the gripper poses.

    All images have one camera, whose intrinsics COLMAP estimates. Raises RejectedError with fewer than three images.
    """
    options, single = pycolmap.IncrementalPipelineOptions(), pycolmap.CameraMode.SINGLE
    options.random_seed, options.num_threads = seed, 1
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-paper-") as folder:
        database, names, cpu = Path(folder) / "database.db", list(capture.images), pycolmap.Device.cpu
        pycolmap.extract_features(database, capture.folder, names, camera_mode=single, device=cpu)
        pycolmap.match_exhaustive(database, device=cpu)
        models = pycolmap.incremental_mapping(database, capture.folder, folder, options).values()
        most = max((model.num_reg_images() for model in models), default=0)
        if most < MIN_FRAMES:
            words = f"COLMAP by its defaults registered {most} of {len(capture)} images"
            raise RejectedError(words, "overlap the views more, or use --backend dust3r")
        next(model for model in models if model.num_reg_images() == most).write(folder)
        made = reconstruct_given(replace(capture, intrinsics=None), Path(folder), seed)
        return replace(made, backend=BASELINE)


def calibrate_published(
    capture: Capture | PosePairs, made: Reconstruction | PosePairs
) -> PublishedCalibration:
    """Return gripper_from_camera, λ and residuals from a reconstruction or given poses (lines 2 to 4 of Algorithm 1).

    base_from_recon is that of line 6 (eq. 12), by the pose of the first image. Raises RejectedError if the solver fails.
    """
    rows = made.image_index
    gripper, camera = capture.base_from_gripper[rows], made.recon_from_camera
    x, scale = solve(gripper, camera)
    used, why = set(rows.tolist()), f"not registered by {made.backend}"
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
