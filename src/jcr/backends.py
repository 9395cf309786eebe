"""Table of the back ends, which make a Reconstruction of a capture, and the selection of one by the options.

Another package adds a back end by an entry point of the group `jcr.backends`: its name and a `Backend` object
(examples/backend_mapanything).
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from jcr.errors import InputError
from jcr.extras import extra, install, is_installed, xfeat_is_installed
from jcr.hub import HUB_ID, Weights, cached_files
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, Reconstruction

CC_BY_NC_SA = "CC BY-NC-SA 4.0, non-commercial use only (https://creativecommons.org/licenses/by-nc-sa/4.0/)"
INSTALL_DA3 = "pip install omegaconf addict einops && pip install --no-deps depth-anything-3"
"""Command that installs Depth Anything 3 without those requirements that its network does not use, as numpy < 2."""
DECIMALS = 9
"""Number of decimals of poses that are compared to sort images, so that rounding by a file format has no effect."""
GROUP = "jcr.backends"
"""Group of the entry points of back ends from other packages."""
MARKER = "marker"
"""Name of the back end that uses only the corners of a board."""
NEEDED = {
    "board": "board, such as chessboard:9x6:0.025",
    "predictions": "predictions, the file FILE.npz (jcr docs predictions)",
    "cameras": "cameras, the folder of the COLMAP model",
}
"""Text of a message about a missing option, for each option that some back end requires."""

logger = logging.getLogger(__name__)


def _lazy(function: str, *arguments: str) -> Callable[..., Reconstruction]:
    """Return a function that imports and runs the back end `function`, given as "module:function".

    The back end is called with capture, the options named in `arguments`, and progress. The option `weights` is passed
    as the weights found on this machine, and `device` as "cpu" or "cuda".
    """

    def reconstruct(capture: Capture, options: "ReconstructOptions", progress: Progress) -> Reconstruction:
        if "device" in arguments:
            extra("torch", "networks", f"backend {options.backend}")
        chosen = {"weights": network_weights, "device": device_of}
        values = [chosen[a](options) if a in chosen else getattr(options, a) for a in arguments]
        return resolve_name(function)(capture, *values, progress)

    return reconstruct


@dataclass(frozen=True, kw_only=True)
class Backend:
    """Method of reconstruction (back end): its function, the options that it uses, packages, weights and licence."""

    name: str
    """Value of the option --backend that selects this back end."""
    reconstruct: Callable[..., Reconstruction]
    """Function of capture, ReconstructOptions and progress; slow imports should be inside the function."""
    licence: str
    """Licence of the weights; of the code for a back end without weights."""
    auto: bool = False
    """Whether --backend auto may try this back end, if its package and its weights are on this machine."""
    tests_camera: bool = True
    """Whether the calibration is tested for wrong intrinsics, which needs points from features of the images."""
    options: tuple[str, ...] = ()
    """Fields of ReconstructOptions that this back end uses, without those that all back ends use."""
    selected_by: str = ""
    """Option that makes --backend auto select this back end, one of `options`; empty: none."""
    needs: str = ""
    """Option that is required, one of `options` and a key of NEEDED; empty: none."""
    hub_id: str = ""
    """Hub id of the published weights; empty: no weights are needed."""
    package: str = ""
    """Optional package that must be installed; empty: none."""
    install: str = ""
    """Command that installs `package`."""
    keeps_order: bool = False
    """Whether the images must keep the order of the capture, because the input refers to images by number."""
    revision: str = ""
    """Commit of the weights that `jcr models get` downloads."""
    download_gb: float = 0.0
    """Size of the weights (GB)."""
    commercial: bool = True
    """Whether the licence of the weights allows commercial use."""
    sees_all_views: bool = False
    """Whether the back end is a network that processes all views at once, and not pairs of views."""

    def is_installed(self) -> bool:
        """Test whether the optional package of this back end is installed, without importing it."""
        return not self.package or is_installed(self.package)

    def has_weights(self) -> bool:
        """Test whether the published weights are on this machine, or none are needed; nothing is downloaded."""
        return not self.hub_id or bool(cached_files(self.hub_id, self.revision or None))


_DUST3R = Backend(
    name="dust3r",
    reconstruct=_lazy("jcr.pointmaps.dust3r.dust3r:reconstruct_dust3r", "weights", "device", "backend"),
    licence=CC_BY_NC_SA,
    auto=True,
    tests_camera=False,
    options=("weights",),
    selected_by="weights",
    hub_id="naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt",
    revision="61c57447d7b0adc8a1a30b2b0adec7a8935aa2a3",
    keeps_order=True,
    package="torch",
    install=install("networks"),
    download_gb=2.3,
    commercial=False,
)
_DA3 = Backend(
    name="da3",
    reconstruct=_lazy("jcr.pointmaps.da3:reconstruct_da3", "weights", "device", "backend"),
    licence="Apache-2.0",
    auto=True,
    tests_camera=False,
    options=("weights",),
    hub_id="depth-anything/DA3-BASE",
    revision="f4a6c9b3c95e41c82048423d3493a81ec3fa810e",
    package="depth_anything_3",
    install=INSTALL_DA3,
    download_gb=0.5,
    sees_all_views=True,
)
_FIRST = (
    Backend(
        name="colmap",
        reconstruct=_lazy("jcr.sfm.colmap:reconstruct_colmap", "features", "seed"),
        licence="BSD-3-Clause; XFeat and LightGlue Apache-2.0",
        auto=True,
        options=("features", "board"),
        selected_by="features",
    ),
    # MASt3R is DUSt3R with points in metres and an additional head, which is not used.
    replace(
        _DUST3R,
        name="mast3r",
        licence=f"{CC_BY_NC_SA}, and the licences of its training data (its CHECKPOINTS_NOTICE)",
        selected_by="",
        hub_id="naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric",
        revision="06e7259f34c3060f322df5cb0c7b9094f57e41fc",
        download_gb=2.8,
    ),
    _DUST3R,
    _DA3,
    replace(
        _DA3,
        name="da3-small",
        hub_id="depth-anything/DA3-SMALL",
        revision="e08cab65ca0ec38e7826075418411ab90cab4da3",
        download_gb=0.14,
    ),
)
_LAST = (
    Backend(
        name="direct",
        reconstruct=_lazy("jcr.photometric.direct:reconstruct_direct"),
        licence="Apache-2.0",
        auto=True,
        tests_camera=False,
    ),
    Backend(
        name=MARKER,
        reconstruct=_lazy("jcr.boards.marker:reconstruct_marker", "board"),
        licence="Apache-2.0",
        options=("board",),
        needs="board",
    ),
    Backend(
        name="predictions",
        reconstruct=_lazy("jcr.pointmaps.predictions:reconstruct_predictions", "predictions"),
        licence="your network's",
        tests_camera=False,
        options=("predictions",),
        selected_by="predictions",
        needs="predictions",
        keeps_order=True,
    ),
    Backend(
        name="given",
        reconstruct=_lazy("jcr.sfm.given:reconstruct_given", "cameras", "seed"),
        licence="your reconstruction's",
        options=("cameras", "board"),
        selected_by="cameras",
        needs="cameras",
    ),
)

# The names of entry points are available without importing their packages.
if TYPE_CHECKING:
    BackendName = str
else:
    BackendName = Literal[
        (
            "auto",
            *(row.name for row in _FIRST),
            *(point.name for point in entry_points(group=GROUP)),
            *(row.name for row in _LAST),
        )
    ]


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of the reconstruction."""

    backend: BackendName = "auto"
    """Method that computes the camera poses. auto tries those of this list that need no extra input and are installed
    with their weights (jcr models), in this order, until a result is not rejected."""
    board: Annotated[str | None, tyro.conf.arg(metavar="KIND:SIZE")] = None
    """The board or tags in view, in metres; write SIDE for an unknown side. It is used together with the features, and
    alone if these fail or with --backend marker. Examples: charuco:7x5:0.030:0.022:DICT_4X4_50, chessboard:9x6:0.025
    (inner corners), aruco:0.050:DICT_4X4_50, apriltag:0.050:36h11."""
    features: Literal["auto", "sift", "xfeat"] = "auto"
    """Features that are matched between images; selects the back end colmap. xfeat are learned features for little
    texture (extra match). auto tries sift and, if the result is rejected and xfeat is installed, xfeat."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result on the same machine."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device on which networks run and the map is trained."""
    weights: Annotated[str | None, tyro.conf.arg(metavar="PATH_OR_HUB_ID")] = None
    """Path or hub id of a network's weights; by default the published ones. With --backend auto they must be those of
    DUSt3R or MASt3R."""
    predictions: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File (npz) with the output of a network (jcr docs predictions); selects the back end predictions."""
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """COLMAP model with camera poses from another tool; selects the back end given."""


def reconstruct(
    capture: Capture, options: ReconstructOptions | None = None, progress: Progress = silent
) -> Reconstruction:
    """Reconstruct a capture with the back end that `options` select; for `auto`, the first candidate.

    The reconstruction does not depend on the order of the images and has them in the order of the capture. Raises
    InputError for an unknown back end or a missing package, RejectedError if the reconstruction fails.
    """
    options = options or ReconstructOptions()
    if capture.mount == "base":
        from jcr.geometry import inverse  # SciPy, which help need not wait for

        # In the frame of the carried object, a fixed camera moves as a wrist camera does.
        capture = replace(
            capture, mount="gripper", base_from_gripper=inverse(capture.base_from_gripper), joints=None
        )
    row = ready_backend(options, candidates(options)[0])
    # Matching, RANSAC and the initial pair depend on the order of the images: with other names, calibrations differed by
    # up to 1.7 standard deviations. Images are therefore sorted by their poses: position, x first, then rotation. Adding
    # zero turns -0 into 0; equal poses keep their order.
    pose = np.round(capture.base_from_gripper, DECIMALS) + 0.0
    keys = np.concatenate([pose[:, :3, 3], pose[:, :3, :3].reshape(-1, 9)], axis=1)
    order = np.arange(len(capture)) if row.keeps_order else np.lexsort(keys.T[::-1])
    in_order = capture.of_rows(order)
    made = row.reconstruct(in_order, replace(options, backend=row.name), progress)
    if options.board is not None and row.name != MARKER:
        from jcr.boards.corners import with_boards

        made = with_boards(in_order, made, options.board, progress)
    image_index = order[made.image_index]
    rows = np.argsort(image_index)
    row_of = np.argsort(rows)
    boards, evidence = made.tracks.boards, made.evidence
    if boards is not None:
        boards = replace(boards, elsewhere=tuple(sorted(row_of[list(boards.elsewhere)].tolist())))
    if evidence is not None:
        numbers = (6 * rows[:, None] + np.arange(6)).ravel()
        evidence = CameraEvidence(
            evidence.recon_from_camera[rows], evidence.covariance[np.ix_(numbers, numbers)]
        )
    return replace(
        made,
        image_index=image_index[rows],
        recon_from_camera=made.recon_from_camera[rows],
        pointmaps=None if made.pointmaps is None else made.pointmaps.of_rows(rows),
        tracks=replace(made.tracks, image=row_of[made.tracks.image], boards=boards),
        evidence=evidence,
    )


def ready_backend(options: ReconstructOptions, name: str) -> Backend:
    """Return the back end `name`; raise InputError if its package or an option that it requires is missing."""
    row = BACKENDS[name]
    if not row.is_installed():
        more = ", or choose another" if row.has_weights() else f"; then {weights_command(row)}"
        raise InputError(f"backend {name} needs {row.package}, which is not installed: {row.install}{more}")
    if row.needs and getattr(options, row.needs) is None:
        raise InputError(f"backend {name}: give the option {NEEDED[row.needs]}")
    return row


def candidates(options: ReconstructOptions) -> tuple[BackendName, ...]:
    """Return the names of the back ends to try, best first; only the named one unless the back end is `auto`.

    For `auto`, an option such as `features` selects its back end. Given weights select their network, followed by the
    best back end without weights. A board selects the back ends that use features and board, followed by `marker`,
    which uses the board alone. Raises InputError for an unknown back end, for options that select different back ends,
    and for an option that none of the returned back ends uses.
    """
    given, auto = _given_options(options), [row for row in BACKENDS.values() if row.auto]
    selecting = [row for row in BACKENDS.values() if row.selected_by in given]
    if options.backend != "auto":
        names = [options.backend]
        if options.backend not in BACKENDS:
            raise InputError(f"backend {options.backend}: no such back end; take {', '.join(BACKENDS)}")
    elif len(selecting) > 1:
        raise InputError(
            f"{' and '.join(f'--{row.selected_by}' for row in selecting)} select different back ends "
            f"({', '.join(row.name for row in selecting)}); give one of them"
        )
    elif selecting:
        without_weights = [row.name for row in auto if not row.hub_id]
        names = [selecting[0].name, *(without_weights[:1] if selecting[0].hub_id else ())]
    else:
        usable = [row for row in auto if row.is_installed() and row.has_weights()]
        names = [row.name for row in usable if "board" not in given or "board" in row.options]
    if options.backend == "auto" and "board" in given and "board" in BACKENDS[names[0]].options:
        names.append(MARKER)
    for name, value in given.items():
        if not any(name in BACKENDS[chosen].options for chosen in names):
            users = [row.name for row in BACKENDS.values() if name in row.options]
            raise InputError(
                f"--{name} {value}: the back end here ({', '.join(names)}) does not use it; leave it out, or "
                f"give --backend {' or '.join(users)}"
            )
    return tuple(names)


def tries(options: ReconstructOptions) -> list[ReconstructOptions]:
    """Return the options of all attempts to make until a result is accepted, best first.

    For `auto`: COLMAP with SIFT, then with learned features if these are installed; the best network that processes
    pairs of views, and the best that processes all views; direct alignment. Raises InputError as `candidates` does.
    """
    given, made = _given_options(options), list[ReconstructOptions]()
    defaults = {field.name: field.default for field in fields(options) if field.name in given}
    # Kinds of networks among the attempts: whether for all views or for pairs of views.
    networks = set[bool]()
    for name in candidates(options):
        row = BACKENDS[name]
        if row.hub_id and row.sees_all_views in networks:
            continue
        networks |= {row.sees_all_views} if row.hub_id else set()
        unused = {option: value for option, value in defaults.items() if option not in row.options}
        one = replace(options, backend=name, **unused)
        learned = options.backend == "auto" and name == "colmap" and one.features == "auto"
        features = ("sift", "xfeat") if learned and xfeat_is_installed() else (one.features,)
        made += [replace(one, features=kind) for kind in features]
    return made


def network_weights(options: ReconstructOptions) -> Weights:
    """Return the weights for the network of the selected back end, from a given path or from the local cache.

    Nothing is downloaded. Raises InputError that names the command to download the weights if they are missing.
    """
    row = BACKENDS[options.backend]
    name = options.weights or row.hub_id
    published = next((other for other in BACKENDS.values() if other.hub_id == name), None)
    unknown = f"unknown, ask who made the file; that of {row.hub_id} is {row.licence}"
    licence = published.licence if published else unknown
    if options.weights is not None and Path(name).exists():
        return Weights(Path(name), name, licence)
    revision = (published and published.revision) or None
    if cached := cached_files(name, revision):
        return Weights(cached[0].parent, name, licence)
    if published:
        other = cached_files(name)
        found = f"only revision {other[0].parent.name[:12]} is" if other else "not"
        raise InputError(f"{name}: {found} on this machine; {weights_command(published)}")
    remedy = "give a file, a folder or a hub id (jcr models)"
    if HUB_ID.fullmatch(name) and Path(name).suffix != ".safetensors":
        remedy = f"jcr models get {name} downloads them"
    raise InputError(f"weights {name}: no such weights on this machine; {remedy}")


def weights_command(row: Backend) -> str:
    """Return a phrase with the command that downloads the published weights of a network, and their size (GB)."""
    size = f" ({row.download_gb:g} GB)" if row.download_gb else ""
    licence = "" if row.commercial else ", non-commercial"
    return f"jcr models get {row.name} downloads {row.hub_id}{size}{licence}"


def _given_options(options: ReconstructOptions) -> dict[str, Any]:
    """Return names and values of the options that only some back ends use and that differ from their defaults."""
    own = {name for row in BACKENDS.values() for name in row.options}
    unset = {field.name: field.default for field in fields(options) if field.name in own}
    return {name: value for name in unset if (value := getattr(options, name)) != unset[name]}


def device_of(options: ReconstructOptions) -> str:
    """Return "cuda" or "cpu" for the option `device`; for `auto`, "cuda" if a CUDA device is available.

    Raises InputError if `device` is "cuda" and no CUDA device is available.
    """
    if options.device == "cpu" or (options.device == "auto" and not is_installed("torch")):
        return "cpu"
    torch = extra("torch", "networks", "device cuda")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: this machine has no CUDA device that torch sees; choose device cpu")
    if options.device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return options.device


def _third_party() -> list[Backend]:
    """Return the back ends of other packages; one that cannot be loaded is logged and skipped."""
    rows = []
    for point in entry_points(group=GROUP):
        try:
            row = point.load()
            if not isinstance(row, Backend) or row.name != point.name:
                raise TypeError(f"{point.value} is no Backend of the name {point.name}")
            rows.append(row)
        except Exception as error:
            logger.warning("back end %s (%s) cannot be loaded: %s", point.name, point.value, error)
    return rows


BACKENDS: dict[str, Backend] = {row.name: row for row in (*_FIRST, *_third_party(), *_LAST)}
"""Back ends by name, in the order in which `auto` tries them.

COLMAP is first, because it needs no weights and its points allow tests of the intrinsics. Networks follow: those for
pairs of views, whose uncertainty is known, then those for all views. Direct alignment is slowest and last.
"""
