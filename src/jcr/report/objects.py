"""Section of the measured objects: height and box of each."""

from jcr.report.raster import label_colors
from jcr.report.render import Section
from jcr.segments.measure import Measurement


def objects_section(measured: Measurement, label_names: tuple[str, ...]) -> Section:
    """Return height and box of every object with one standard deviation, beside the colour of its label."""
    colors = label_colors(len(label_names)).tolist()
    rows = []
    for one in measured.objects:
        length, width, height = (
            f"{1e3 * value:.1f} ±\u00a0{1e3 * std:.1f}"
            for value, std in zip(one.box_size, one.box_std, strict=True)
        )
        if not one.top_seen:
            height = f"at least {1e3 * one.height:.1f}"
        x, y = one.base_from_box[:2, 3]
        rows.append((one.name, colors[one.label], (height, length, width, f"{x:.3f}, {y:.3f}")))
    return Section("objects", {"rows": rows, "noise": f"{1e3 * measured.support.noise:.1f}"})
