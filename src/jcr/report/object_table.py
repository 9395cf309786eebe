"""The section that lists what stands on the table, and how large it is."""

from html import escape

from jcr.report.figures import label_colors
from jcr.report.markup import filled
from jcr.segment.measure import Measured


def objects_section(measured: Measured, label_names: tuple[str, ...]) -> str:
    """Height and box of every object with one standard deviation, beside the colour of its label."""
    colors = label_colors(len(label_names))
    rows = []
    for size in measured.objects:
        length, width, height = (
            f"<td>{1e3 * value:.1f} ±\u00a0{1e3 * std:.1f}</td>"
            for value, std in zip(size.box_size, size.box_std, strict=True)
        )
        if not size.top_seen:
            height = f"<td>at least {1e3 * size.height:.1f}</td>"
        x, y = size.base_from_box[:2, 3]
        red, green, blue = colors[size.label]
        swatch = f'<i class="swatch" style="background:rgb({red},{green},{blue})"></i>'
        rows.append(
            f"<tr><th>{swatch}{escape(size.name)}</th>{height}{length}{width}<td>{x:.3f}, {y:.3f}</td></tr>"
        )
    if not rows:
        rows = ['<tr><th colspan="5">nothing stands on it</th></tr>']
    return filled("objects.html", rows="".join(rows), noise=f"{1e3 * measured.support.noise:.1f}")
