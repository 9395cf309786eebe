"""The compact network's back end: its matches find the camera roughly, and the pictures' colours exactly.

The network is too small for its pointmaps to be of use, but where it looks in the other picture is right often enough
for the robot's motion to make out the hand-eye transform. Direct alignment goes on from there, with other starts
beside this one, and has the last word: a rough answer that the colours contradict is not kept.
"""

from dataclasses import dataclass, field, replace

import torch

from jcr.errors import InputError, NotTrustedError
from jcr.progress import Progress, silent
from jcr.reconstruct import direct
from jcr.reconstruct.checkpoints import CHECKPOINTS
from jcr.reconstruct.direct import DirectOptions
from jcr.reconstruct.dust3r.attended import attended_matches
from jcr.reconstruct.dust3r.preprocess import cover_grid, prepare_images
from jcr.reconstruct.dust3r.weights import load_weights
from jcr.reconstruct.epipolar import EpipolarHandEye, EpipolarOptions, hand_eye_from_matches
from jcr.records import Capture, Reconstruction


@dataclass(frozen=True)
class CompactOptions:
    """A small network, then direct alignment."""

    weights: str | None = None
    """Folder of weights by python -m jcr.train; unset: those in this package."""
    device: str = "cpu"
    """Where the network runs: cpu or cuda."""
    epipolar: EpipolarOptions = field(default_factory=EpipolarOptions)
    direct: DirectOptions = field(default_factory=DirectOptions)


def reconstruct(
    capture: Capture, options: CompactOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses and pointmaps of a capture, up to a similarity.

    Raises InputError for weights that cannot match or images that cannot be read, and as `direct.reconstruct` does.
    """
    options = options or CompactOptions()
    found, licence = rough_hand_eye(capture, options, progress)
    if isinstance(found, EpipolarHandEye):
        start = found.gripper_from_camera
        note = f"the network's matches, {100 * found.share:.0f} % of which fit the robot's motion, gave a first start"
    else:
        start, note = None, f"the network's matches gave no start: {found}"
    try:
        made = direct.reconstruct(capture, options.direct, progress, start)
    except NotTrustedError as error:  # what was used, and its licence, are worth knowing all the same
        raise NotTrustedError("; ".join([str(error), note, licence])) from None
    return replace(made, backend="compact", notes=(note, licence, *made.notes))


def rough_hand_eye(
    capture: Capture, options: CompactOptions, progress: Progress | None = None
) -> tuple[EpipolarHandEye | NotTrustedError, str]:
    """What the network's matches alone say of the camera, or why nothing; and the licence of its weights."""
    report = progress or silent
    loaded = load_weights(options.weights or CHECKPOINTS["compact"].hub_id, options.device)
    size, block = loaded.size, loaded.matching_block
    if size is None or block is None:
        raise InputError(
            f"{loaded.source}: these weights do not match pictures (no matching_block in config.json); "
            "use --backend dust3r for pointmaps, or weights by python -m jcr.train"
        )
    report("match pictures", 0.0)
    images = prepare_images(capture, lambda original: cover_grid(original, size))
    colors = torch.from_numpy(images.colors).to(loaded.network.device).permute(0, 3, 1, 2) / 127.5 - 1
    matches = attended_matches(loaded.network, colors, block)
    report("match pictures", 1.0)
    licence = f"weights {loaded.source}: licence {loaded.licence}"
    try:
        return hand_eye_from_matches(
            matches, capture.base_from_gripper, images.intrinsics, options.epipolar
        ), licence
    except NotTrustedError as error:
        return error, licence
