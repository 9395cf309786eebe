"""`jcr measure`: the sizes of what stands on the table."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jcr.cli.output import Output, plain

if TYPE_CHECKING:
    from jcr.segments.measure import Measurement


@dataclass(frozen=True)
class Arguments:
    """Measure the support plane, and the height, footprint and box of each object on it, with 1 sigma.

    OUT is the folder of a run. `jcr map --segments` selects how the scene is divided into objects.

    examples:
      jcr measure out/tabletop
      jcr measure out/tabletop --json > sizes.json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Print the sizes; 3 when the calibration they rest on is rejected."""
    from jcr.errors import RejectedError
    from jcr.pipeline.run import measure
    from jcr.run_folder import load_run

    measured = measure(arguments.out)
    arguments.output.result(table(measured), content(measured))
    if (doubt := load_run(arguments.out).doubt) is not None:
        raise RejectedError(f"sizes rejected: {doubt}")
    return 0


def content(measured: "Measurement") -> dict[str, object]:
    """Return the result for JSON: metres, base frame, standard deviations of one sigma."""
    support = plain(measured.support)
    del support["on_plane"]  # a flag for each point of the cloud
    return {"support": support, "objects": [plain(size) for size in measured.objects]}


def table(measured: "Measurement") -> str:
    """Return a line for the plane and a line for each object, in millimetres."""
    support = measured.support
    x, y, z = support.base_from_support[:3, 2]
    lines = [
        f"support plane through z = {support.base_from_support[2, 3]:.4f} m, normal {x:.4f} {y:.4f} {z:.4f}, "
        f"its points within {1e3 * support.noise:.1f} mm (1 σ)"
    ]
    if not measured.objects:
        return lines[0] + "\nnothing stands on it\n"
    width = max(6, *(len(size.name) for size in measured.objects))
    head = (
        f"{'object':<{width}}  {'height (mm)':>14}  {'length (mm)':>14}  {'width (mm)':>14}  centre x, y (m)"
    )
    lines.append(head + ", ± 1 σ")
    for size in measured.objects:
        length, across, height = (
            f"{1e3 * value:.1f} ± {1e3 * std:.1f}"
            for value, std in zip(size.box_size, size.box_std, strict=True)
        )
        height = height if size.top_seen else f"≥ {1e3 * size.height:.1f}"
        x, y = size.base_from_box[:2, 3]
        lines.append(f"{size.name:<{width}}  {height:>14}  {length:>14}  {across:>14}  {x:.3f}, {y:.3f}")
    return "\n".join(lines) + "\n"
