"""`jcr predict`: pairwise pointmaps of a network, as a file."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jcr.cli.output import Output
from jcr.reconstruct.backends import PairBackendName
from jcr.reconstruct.dust3r.pair_graph import PairOptions


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Predict the pointmaps of a capture's pairs of images, for `jcr align` or `--backend predictions`.

    examples:
      jcr predict captures/table pairs.npz --backend mast3r
      jcr predict captures/table pairs.npz --weights DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth --device cuda
      jcr predict captures/long pairs.npz --pair-graph window --window 4 --memory-gb 6
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture."""
    out: Annotated[Path, tyro.conf.Positional]
    """npz file to write (jcr docs predictions)."""
    backend: PairBackendName = "dust3r"
    """Whose weights, where --weights names none."""
    weights: str | None = None
    """Path or hub id."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs."""
    pairs: PairOptions = field(default_factory=PairOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Predict and write the file."""
    from jcr.capture.read import read_capture
    from jcr.errors import InputError
    from jcr.extras import extra
    from jcr.progress import progress_bars
    from jcr.reconstruct.backends import ReconstructOptions, device_of, weights_of
    from jcr.reconstruct.global_alignment.pairs import write_pairs

    extra("torch", "networks", "jcr predict")
    from jcr.reconstruct.dust3r.dust3r import Dust3rOptions, predict

    if arguments.out.suffix != ".npz":
        raise InputError(f"{arguments.out}: predictions are written as npz; give a name that ends in .npz")
    capture = read_capture(arguments.capture)
    asked = ReconstructOptions(backend=arguments.backend, device=arguments.device, weights=arguments.weights)
    options = Dust3rOptions(weights=weights_of(asked), device=device_of(asked), pairs=arguments.pairs)
    with progress_bars() as progress:
        _, predictions, notes = predict(capture, options, progress)
    write_pairs(arguments.out, predictions)
    count, height, width = predictions.conf.shape
    for note in notes:
        sys.stderr.write(f"{note}\n")
    result = {"file": str(arguments.out), "pairs": count, "width": width, "height": height}
    arguments.output.result(
        f"{arguments.out}: {count} pairs of {width}x{height} pixels\n",
        result | {"metric": predictions.is_metric, "notes": notes},
    )
    return 0
