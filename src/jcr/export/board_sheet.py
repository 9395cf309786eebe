"""A calibration board to print at its exact size, as PDF or SVG, with rulers that tell whether the printer kept it."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.reconstruct.board import boards

PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "a2": (594.0, 420.0), "letter": (279.4, 215.9)}
"""Width and height, the long side across."""
MARGIN_MM = 8.0
"""Printers leave a border of some millimetres white."""
RULER_MM = 100.0
BAND_MM = 14.0
"""Below and beside the board: a ruler and its words."""
POINT_MM = 25.4 / 72
"""The unit of PDF."""


@dataclass(frozen=True)
class Text:
    """Words on the sheet; `x_mm`, `y_mm` is where their baseline begins."""

    x_mm: float
    y_mm: float
    size_mm: float
    words: str
    upright: bool = True
    """Else read from the bottom up."""


@dataclass(frozen=True)
class Sheet:
    """Black rectangles and words on white paper; x to the right and y down from the top left corner."""

    paper_mm: tuple[float, float]
    rectangles_mm: Float[ndarray, "k 4"]
    """x, y, width, height."""
    texts: tuple[Text, ...]


def board_sheet(spec: str, paper: str = "a4") -> Sheet:
    """The sheet of a ChArUco board or chessboard as `--board` names it.

    Raises InputError on a name that means none, and on a board that the paper has no room for.
    """
    boards(spec)
    kind, *parts = spec.split(":")
    if kind == "charuco":
        across, down = (int(text) for text in parts[0].split("x"))
        square, marker = 1e3 * float(parts[1]), 1e3 * float(parts[2])
        dark = _charuco(across, down, square, marker, parts[3])
    elif kind == "chessboard":
        across, down = (int(text) + 1 for text in parts[0].split("x"))
        square = 1e3 * float(parts[1])
        dark = [
            (square * x, square * y, square, square)
            for y in range(down)
            for x in range(across)
            if (x + y) % 2 == 0
        ]
    else:
        raise InputError(f"jcr board {spec}: prints charuco:… and chessboard:…; choose one of these")
    width, height = square * across, square * down
    page = PAPERS_MM[paper]
    room = page[0] - 2 * MARGIN_MM - BAND_MM, page[1] - 2 * MARGIN_MM - BAND_MM
    if width > room[0] + 1e-9 or height > room[1] + 1e-9:
        raise InputError(
            f"jcr board {spec}: {width:g} x {height:g} mm, but {paper} has room for {room[0]:g} x {room[1]:g}; "
            "make the squares smaller or fewer, or choose a larger --paper"
        )
    left, top = MARGIN_MM + BAND_MM, MARGIN_MM
    placed = np.array(dark) + [left, top, 0.0, 0.0]
    below = page[1] - MARGIN_MM
    ruler = RULER_MM if height >= RULER_MM else 50.0
    rulers = _ruler(left, below - 6.0, ruler, along_x=True) + _ruler(
        MARGIN_MM + 6.0, top, ruler, along_x=False
    )
    texts = (
        Text(
            left,
            below,
            3.2,
            f"--board {spec}   Print at 100 %, not fitted to the page; glue it to something flat.",
        ),
        Text(
            left + ruler + 4.0,
            below - 5.0,
            3.2,
            f"Both rulers are {ruler:g} mm. If yours measure R mm, multiply the lengths in --board by R/{ruler:g}.",
        ),
        Text(MARGIN_MM + 2.0, top + ruler, 3.2, f"{ruler:g} mm", upright=False),
    )
    return Sheet(page, np.vstack([placed, np.array(rulers)]), texts)


def _charuco(
    across: int, down: int, square: float, marker: float, dictionary: str
) -> list[tuple[float, float, float, float]]:
    """Black squares, and the black modules of the tags in the white ones."""
    tags = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((across, down), square, marker, tags)
    if (count := len(board.getIds())) > len(tags.bytesList):
        raise InputError(
            f"jcr board: {across}x{down} squares need {count} markers, but {dictionary} has {len(tags.bytesList)}; "
            f"choose {dictionary.rpartition('_')[0]}_100 or a larger one"
        )
    free = {(x, y) for x in range(across) for y in range(down)}
    dark: list[tuple[float, float, float, float]] = []
    modules = tags.markerSize + 2
    size = marker / modules
    for number, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
        x, y = np.asarray(corners)[:, :2].min(0).tolist()
        free.discard((int(x // square), int(y // square)))
        picture = cv2.aruco.generateImageMarker(tags, int(number), modules, borderBits=1)
        for row, line in enumerate(picture < 128):
            dark += [(x + size * a, y + size * row, size * (b - a), size) for a, b in _runs(line)]
    return dark + [(square * x, square * y, square, square) for x, y in sorted(free)]


def _runs(line: Bool[ndarray, " n"]) -> list[tuple[int, int]]:
    """Where the line is true, as half-open ranges: one rectangle instead of several shows no seams."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _ruler(x: float, y: float, length: float, along_x: bool) -> list[tuple[float, float, float, float]]:
    """A line with a tick each 10 mm (long) and 1 mm; ticks are centred on their place, the line ends with them."""
    thin = 0.15
    ends = [(x, y, length, thin) if along_x else (x, y, thin, length)]
    for k in range(round(length) + 1):
        tall = 3.0 if k % 10 == 0 else 1.2
        ends.append(
            (x + k - thin / 2, y - tall, thin, tall) if along_x else (x - tall, y + k - thin / 2, tall, thin)
        )
    return ends


def as_svg(sheet: Sheet) -> str:
    """The sheet as SVG in millimetres."""
    width, height = sheet.paper_mm
    rectangles = "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in sheet.rectangles_mm)
    texts = ""
    for text in sheet.texts:
        at = f'x="{text.x_mm}" y="{text.y_mm}" font-size="{text.size_mm}"'
        turn = "" if text.upright else f' transform="rotate(-90 {text.x_mm} {text.y_mm})"'
        texts += f"<text {at}{turn}>{escape(text.words)}</text>"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}" '
        f'font-family="Helvetica, Arial, sans-serif"><rect width="{width}" height="{height}" fill="#fff"/>'
        f'<path d="{rectangles}"/>{texts}</svg>\n'
    )


def as_pdf(sheet: Sheet) -> bytes:
    """The sheet as a PDF of one page (ISO 32000-1, 7.5 and 8.5); a viewer is asked not to scale it when it prints."""
    width, height = sheet.paper_mm
    # From here on millimetres, y up from the lower left corner.
    lines = [f"{1 / POINT_MM:.10f} 0 0 {1 / POINT_MM:.10f} 0 0 cm"]
    lines += [f"{x:.4f} {height - y - h:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in sheet.rectangles_mm]
    lines.append("f")
    for text in sheet.texts:
        turn = "1 0 0 1" if text.upright else "0 1 -1 0"
        words = text.words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        lines.append(
            f"BT /F {text.size_mm:.3f} Tf {turn} {text.x_mm:.3f} {height - text.y_mm:.3f} Tm ({words}) Tj ET"
        )
    content = "\n".join(lines).encode("latin-1")
    page = f"{width / POINT_MM:.4f} {height / POINT_MM:.4f}"
    return _pdf_file(
        [
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page}] /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
    )


def _pdf_file(objects: Sequence[bytes]) -> bytes:
    """Objects numbered from 1, and where each begins."""
    out, starts = b"%PDF-1.7\n", []
    for number, body in enumerate(objects, 1):
        starts.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % start for start in starts)
    count = len(objects) + 1
    return (
        out
        + b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
        % (
            count,
            table,
            count,
            len(out),
        )
    )
