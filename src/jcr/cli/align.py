"""`jcr align`: global alignment alone, from pairwise pointmaps to cameras, focal lengths and depth."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from jcr.cli.output import Output, warn
from jcr.reconstruct.global_alignment.alignment import AlignOptions


@dataclass(frozen=True)
class Arguments:
    """Align pairwise pointmaps into one reconstruction.

    PAIRS.npz is what `jcr predict` writes: edges (E,2), pts3d and pts3d_in_other_view (E,H,W,3), conf and
    conf2 (E,H,W). RESULT.npz gets poses (N,4,4), camera to recon; focals (N,); depth and confidence (N,H,W);
    principal_point (2,); pair_scale and pair_residual (E,).

    examples:
      jcr align out/pairs.npz out/aligned.npz
      jcr align out/pairs.npz out/published.npz --method adam
      jcr align out/pairs.npz out/aligned.npz --focal own --principal-point-px 255.5 191.5
    """

    pairs: Annotated[Path, tyro.conf.Positional]
    """Pairwise pointmaps to read."""
    result: Annotated[Path, tyro.conf.Positional]
    """Alignment to write."""
    options: AlignOptions = field(default_factory=AlignOptions)
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Read, align, write."""
    import numpy as np

    from jcr.files import written_whole
    from jcr.progress import progress_bars
    from jcr.reconstruct.global_alignment.align import align
    from jcr.reconstruct.global_alignment.pairs import read_pairs

    predictions = read_pairs(arguments.pairs)
    with progress_bars() as progress:
        alignment = align(predictions, arguments.options, progress)
    with written_whole(arguments.result) as temporary, open(temporary, "wb") as stream:
        np.savez(
            stream,
            poses=alignment.recon_from_camera,
            focals=alignment.focal_px[:, 0],
            depth=alignment.depth,
            confidence=alignment.confidence,
            principal_point=np.array(alignment.principal_point_px),
            pair_scale=alignment.pair_scale,
            pair_residual=alignment.pair_residual,
        )
    for warning in alignment.warnings:
        warn(warning)
    for note in alignment.notes:
        sys.stderr.write(f"note: {note}\n")
    residual = float(np.median(alignment.pair_residual))
    arguments.output.result(
        f"{arguments.result}: {len(alignment.depth)} images from {len(alignment.pair_scale)} pairs in "
        f"{alignment.seconds:.2f} s, residual of the middle pair {100 * residual:.2g} % of the distance\n",
        {
            "result": str(arguments.result),
            "method": alignment.method,
            "seconds": alignment.seconds,
            "images": len(alignment.depth),
            "pairs": len(alignment.pair_scale),
            "pair_residual": residual,
            "warnings": list(alignment.warnings),
            "notes": list(alignment.notes),
        },
    )
    return 0
