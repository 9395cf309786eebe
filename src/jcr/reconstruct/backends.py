"""The back ends: each makes the same Reconstruction of a capture. One file and one row here is a new one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.errors import InputError
from jcr.extras import extra, is_installed
from jcr.progress import Progress
from jcr.reconstruct.checkpoints import CHECKPOINTS
from jcr.records import CameraEvidence, Capture, Reconstruction

BackendName = Literal[
    "auto", "colmap", "compact", "direct", "dust3r", "mast3r", "mapanything", "marker", "predictions", "given"
]


@dataclass(frozen=True)
class ReconstructOptions:
    """What turns images into camera poses and pointmaps."""

    backend: BackendName = "auto"
    """auto takes the best one whose weights are on this machine (without downloaded ones: colmap), and the next,
    colmap or compact, where that is not to be trusted."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where networks and dense matching run."""
    seed: int = 0
    """Same seed, same result on the same machine."""
    weights: str | None = None
    """Path or hub id of a network's weights, unset: the published ones; for predictions the npz file, for given
    the COLMAP model or transforms.json."""
    pair_graph: Literal["auto", "complete", "window", "robot"] = "auto"
    """Pairs of images that dust3r and mast3r see; robot leaves out those without a common view."""
    board: str | None = None
    """The board or tags that marker looks for, lengths in metres: charuco:7x5:0.030:0.022:DICT_4X4_50,
    chessboard:9x6:0.025 (inner corners), circles:4x11:0.020, aruco:0.050:DICT_4X4_50, apriltag:0.050:36h11."""
    dense: bool = True
    """Estimate the dense depth that the map needs; without, a calibration alone comes sooner (networks predict it
    anyway)."""
    memory_gb: float = 8.0
    """Most that the process may take of main memory (peak resident set, the program included), and a network of a
    GPU's. What it will take is said beforehand; what does not fit is done in smaller parts, or refused."""


@dataclass(frozen=True)
class Backend:
    """A row of the table."""

    name: str
    licence: str
    metric: bool
    """Whether its scale is metres already."""
    door: str
    """module:function of (capture, ReconstructOptions, progress)."""
    keeps_order: bool = False
    """Whether its input counts images in the capture's own order."""
    package: str = ""
    """That must be installed beside this one."""

    def is_installed(self) -> bool:
        """Whether the package it needs is there, without importing it."""
        return not self.package or is_installed(self.package)

    def reconstruct(
        self, capture: Capture, options: ReconstructOptions, progress: Progress | None
    ) -> Reconstruction:
        """Open the door: heavy imports happen here."""
        module, function = self.door.split(":")
        entry: Callable[..., Reconstruction] = getattr(import_module(module), function)
        return entry(capture, options, progress)


BACKENDS = {
    row.name: row
    for row in (
        Backend("colmap", "BSD-3-Clause", False, "jcr.reconstruct.backends:_colmap"),
        Backend("direct", "Apache-2.0", False, "jcr.reconstruct.backends:_direct"),
        Backend("compact", CHECKPOINTS["compact"].licence, False, "jcr.reconstruct.backends:_compact"),
        Backend(
            "dust3r",
            CHECKPOINTS["dust3r"].licence,
            False,
            "jcr.reconstruct.backends:_dust3r",
            package="torch",
        ),
        Backend(
            "mast3r", CHECKPOINTS["mast3r"].licence, True, "jcr.reconstruct.backends:_dust3r", package="torch"
        ),
        Backend(
            "mapanything",
            CHECKPOINTS["mapanything"].licence,
            True,
            "jcr.reconstruct.backends:_mapanything",
            package="mapanything",
        ),
        Backend("marker", "Apache-2.0", True, "jcr.reconstruct.backends:_marker"),
        Backend("predictions", "your network's", False, "jcr.reconstruct.backends:_predictions", True),
        Backend("given", "your reconstruction's", False, "jcr.reconstruct.backends:_given"),
    )
}


def reconstruct(
    capture: Capture, options: ReconstructOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """The capture reconstructed by the back end that `options` names.

    Raises InputError for a back end that is not there, NotTrustedError when it finds too little.
    """
    options = options or ReconstructOptions()
    name = candidates(options)[0]
    options = replace(options, backend=name)
    if name not in BACKENDS:
        raise InputError(f"--backend {name}: no such back end; there are {', '.join(BACKENDS)}")
    # By name, so that the order of the frames changes nothing.
    order = np.argsort(np.array(capture.images), kind="stable")
    if BACKENDS[name].keeps_order:
        order = np.arange(len(capture))
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
    tracks, evidence = reconstruction.tracks, reconstruction.evidence
    if evidence is not None:
        numbers = (6 * rows[:, None] + np.arange(6)).ravel()
        evidence = CameraEvidence(
            evidence.recon_from_camera[rows], evidence.covariance[np.ix_(numbers, numbers)]
        )
    return replace(
        reconstruction,
        image_index=image_index[rows],
        recon_from_camera=reconstruction.recon_from_camera[rows],
        points_in_recon=reconstruction.points_in_recon[rows],
        confidence=reconstruction.confidence[rows],
        colors=reconstruction.colors[rows],
        tracks=replace(tracks, image=row_of[tracks.image]),
        evidence=evidence,
    )


def candidates(options: ReconstructOptions) -> tuple[BackendName, ...]:
    """What `auto` stands for here, the best first, or the one back end that was asked for.

    Networks whose uncertainty is known come before the one whose is not, metric ones before others; only those
    whose weights (and package) are on this machine count. COLMAP needs none, and sees what networks do not. Direct
    alignment comes last, started by the compact network where its weights are here: COLMAP matches what is printed
    on things, it the colours of plain ones.
    """
    if options.backend != "auto":
        return (options.backend,)
    if options.board is not None:
        return ("marker",)
    if options.weights is not None:
        return ("predictions",) if options.weights.endswith(".npz") else ("dust3r", "colmap")
    ranking: tuple[BackendName, ...] = ("mast3r", "dust3r", "mapanything")
    return (
        *(name for name in ranking if CHECKPOINTS[name].is_cached() and BACKENDS[name].is_installed()),
        "colmap",
        "compact" if CHECKPOINTS["compact"].is_cached() else "direct",
    )


def device_of(options: ReconstructOptions) -> str:
    """cuda or cpu; `auto` is cuda where there is one. InputError when cuda is asked for and absent."""
    if options.device == "cpu" or (options.device == "auto" and not is_installed("torch")):
        return "cpu"
    torch = extra("torch", "networks", "--device cuda")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: this machine has no CUDA device that torch sees; use --device cpu")
    if options.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return options.device


def _dense(options: ReconstructOptions) -> dict[str, Any]:
    """What the options say of dense depth, for the back ends that estimate it without a network."""
    device = device_of(options) if options.dense else "cpu"
    return {"dense": options.dense, "device": device, "memory_gb": options.memory_gb}


def _colmap(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.colmap import ColmapOptions, reconstruct

    return reconstruct(capture, ColmapOptions(seed=options.seed, **_dense(options)), progress)


def _dust3r(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    extra("torch", "networks", f"--backend {options.backend}")
    from jcr.reconstruct.dust3r.backend import Dust3rOptions, reconstruct
    from jcr.reconstruct.global_alignment.pairs import PairOptions

    pairs = PairOptions(pair_graph=options.pair_graph, memory_gb=options.memory_gb)
    model = "mast3r" if options.backend == "mast3r" else "dust3r"
    return reconstruct(capture, Dust3rOptions(model, options.weights, device_of(options), pairs), progress)


def _direct(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.direct.direct import DirectOptions, reconstruct

    return reconstruct(capture, DirectOptions(**_dense(options)), progress)


def _compact(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.compact import CompactOptions, reconstruct
    from jcr.reconstruct.direct.direct import DirectOptions
    from jcr.reconstruct.epipolar import EpipolarOptions

    device = device_of(options)
    made = DirectOptions(device=device, memory_gb=options.memory_gb)
    epipolar = EpipolarOptions(seed=options.seed)
    return reconstruct(capture, CompactOptions(options.weights, device, epipolar, made), progress)


def _mapanything(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    extra("torch", "networks", "--backend mapanything")
    from jcr.reconstruct.mapanything import MapAnythingOptions, reconstruct

    weights = options.weights or CHECKPOINTS["mapanything"].hub_id
    return reconstruct(capture, MapAnythingOptions(weights, device_of(options)), progress)


def _marker(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.marker import MarkerOptions, reconstruct

    if options.board is None:
        raise InputError("--backend marker: name the board with --board, such as chessboard:9x6:0.025")
    return reconstruct(capture, MarkerOptions(options.board, **_dense(options)), progress)


def _predictions(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.predictions import PredictionsOptions, reconstruct

    if options.weights is None:
        raise InputError("--backend predictions: name the npz file with --weights FILE (docs/predictions.md)")
    return reconstruct(capture, PredictionsOptions(Path(options.weights), options.memory_gb), progress)


def _given(capture: Capture, options: ReconstructOptions, progress: Progress | None) -> Reconstruction:
    from jcr.reconstruct.colmap import ColmapOptions
    from jcr.reconstruct.given import reconstruct

    if options.weights is None:
        raise InputError("--backend given: name the COLMAP model or transforms.json with --weights PATH")
    made = ColmapOptions(seed=options.seed, **_dense(options))
    return reconstruct(capture, Path(options.weights), made, progress)
