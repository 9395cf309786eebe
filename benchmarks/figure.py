"""Figures, and their bytes as small PNGs."""

from io import BytesIO
from typing import TYPE_CHECKING, Literal

from PIL import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def blank(width_in: float, height_in: float, layout: Literal["constrained"] | None = None) -> "Figure":
    """A figure of that many inches without anything in it.

    Matplotlib is imported here and not with a bench: on a machine that never drew, it then lists the fonts by a process
    of its own, which takes seconds.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout=layout)


def png(figure: "Figure", dpi: int) -> bytes:
    """PNG of 256 colours: photographs and dots in it take a third of the space, and nobody sees the difference."""
    drawn, stream = BytesIO(), BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    Image.open(drawn).convert("RGB").quantize(256).save(stream, format="PNG", optimize=True)
    return stream.getvalue()
