"""Alignment of one file of pairwise pointmaps, by the method of this package or the published one."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from jcr.files import written_whole
from jcr.paper.alignment import align
from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.pair_predictions import read_pairs


@dataclass(frozen=True)
class Arguments:
    """Align pairwise pointmaps into one reconstruction.

    PAIRS.npz holds edges (E,2), pts3d and pts3d_in_other_view (E,H,W,3), conf and conf2 (E,H,W). OUT.npz gets
    poses (N,4,4), camera to recon; focals (N,); depth and confidence (N,H,W); principal_point (2,); pair_scale and
    pair_residual (E,).

    examples:
      python -m benchmarks align pairs.npz aligned.npz
      python -m benchmarks align pairs.npz published.npz --method adam
    """

    pairs: Annotated[Path, tyro.conf.Positional]
    """Pairwise pointmaps to read."""
    result: Annotated[Path, tyro.conf.Positional]
    """Alignment to write."""
    method: Literal["fast", "adam"] = "fast"
    """fast: Gauss-Newton on chosen pixels (jcr.global_align); adam: gradient descent on every pixel, as published."""


def main(words: Sequence[str]) -> int:
    """Read the pairs, align them, write the result, and print the seconds of the alignment as JSON."""
    arguments = tyro.cli(Arguments, prog="python -m benchmarks align", args=words)
    predictions = read_pairs(arguments.pairs)
    begin = time.perf_counter()
    alignment = align(predictions) if arguments.method == "adam" else global_align(predictions)
    seconds = time.perf_counter() - begin
    with written_whole(arguments.result) as temporary, open(temporary, "wb") as stream:
        np.savez(
            stream,
            poses=alignment.recon_from_camera,
            focals=np.full(len(alignment.depth), alignment.focal_px[0]),
            depth=alignment.depth,
            confidence=alignment.confidence,
            principal_point=np.array(alignment.principal_point_px),
            pair_scale=alignment.pair_scale,
            pair_residual=alignment.pair_residual,
        )
    for text in (*alignment.warnings, *alignment.notes):
        sys.stderr.write(f"{text}\n")
    sys.stdout.write(json.dumps({"method": arguments.method, "seconds": seconds}) + "\n")
    return 0
