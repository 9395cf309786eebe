"""The back ends: each makes the same Reconstruction of a capture. One file and one row here is a new one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Literal

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.errors import InputError
from jcr.progress import Progress
from jcr.records import Capture, Reconstruction

BackendName = Literal["auto", "colmap"]


@dataclass(frozen=True)
class ReconstructOptions:
    """What turns images into camera poses and pointmaps."""

    backend: BackendName = "auto"
    """auto takes the best one whose weights are on this machine."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks and dense matching run."""
    seed: int = 0
    """Same seed, same result on the same machine."""


@dataclass(frozen=True)
class Backend:
    """A row of the table."""

    name: str
    licence: str
    metric: bool
    """Whether its scale is metres already."""
    door: str
    """module:function of (capture, ReconstructOptions, progress)."""

    def reconstruct(
        self, capture: Capture, options: ReconstructOptions, progress: Progress | None
    ) -> Reconstruction:
        """Open the door: heavy imports happen here."""
        module, function = self.door.split(":")
        entry: Callable[..., Reconstruction] = getattr(import_module(module), function)
        return entry(capture, options, progress)


BACKENDS = {
    row.name: row for row in (Backend("colmap", "BSD-3-Clause", False, "jcr.reconstruct.backends:_colmap"),)
}


def reconstruct(
    capture: Capture, options: ReconstructOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """The capture reconstructed by the back end that `options` names.

    Raises InputError for a back end that is not there, NotTrustedError when it finds too little.
    """
    options = options or ReconstructOptions()
    name = chosen(options)
    if name not in BACKENDS:
        raise InputError(f"--backend {name}: no such back end; there are {', '.join(BACKENDS)}")
    # By name, so that the order of the frames changes nothing.
    order = np.argsort(np.array(capture.images), kind="stable")
    by_name = replace(
        capture,
        images=tuple(capture.images[k] for k in order),
        base_from_gripper=capture.base_from_gripper[order],
    )
    return _of_capture(BACKENDS[name].reconstruct(by_name, options, progress), order)


def _of_capture(reconstruction: Reconstruction, order: Int[ndarray, " n"]) -> Reconstruction:
    """The reconstruction with its images in the capture's own order, of which row k was taken as order[k]."""
    image_index = order[reconstruction.image_index]
    rows = np.argsort(image_index)
    row_of = np.argsort(rows)
    tracks = reconstruction.tracks
    return replace(
        reconstruction,
        image_index=image_index[rows],
        recon_from_camera=reconstruction.recon_from_camera[rows],
        points_in_recon=reconstruction.points_in_recon[rows],
        confidence=reconstruction.confidence[rows],
        colors=reconstruction.colors[rows],
        tracks=replace(tracks, image=row_of[tracks.image]),
    )


def chosen(options: ReconstructOptions) -> str:
    """The name of the back end that `auto` stands for here, or the one that was asked for."""
    return "colmap" if options.backend == "auto" else options.backend


def device_of(options: ReconstructOptions) -> str:
    """cuda or cpu; `auto` is cuda where there is one. InputError when cuda is asked for and absent."""
    import torch

    if options.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: this machine has no CUDA device that torch sees; use --device cpu")
    if options.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return options.device


def _colmap(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.colmap import ColmapOptions, reconstruct

    return reconstruct(capture, ColmapOptions(seed=options.seed, device=device_of(options)), progress)
