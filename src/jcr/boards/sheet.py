"""PDF page of a calibration board at its exact size, with rulers to check the printer's scale."""

import io

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jcr.boards.detection import boards
from jcr.errors import InputError

PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "a2": (594.0, 420.0), "letter": (279.4, 215.9)}
"""Width and height of landscape paper."""
MARGIN_MM = 8.0
"""Blank border, because printers leave some millimetres white."""
RULER_MM = 100.0
BAND_MM = 14.0
"""Width of the bands below and left of the board, each with a ruler and its text."""
TEXT_MM = 3.2
LEAST_PX_PER_MM = 600 / 25.4
MM_PER_INCH = 25.4


def as_pdf(page: Image.Image, px_per_mm: float) -> bytes:
    """Return a page of `px_per_mm` pixels per millimetre as a PDF file of its true size, without lossy compression."""
    file = io.BytesIO()
    page.save(file, "PDF", resolution=MM_PER_INCH * px_per_mm)
    return file.getvalue()


def board_sheet(spec: str, paper: str = "a4") -> tuple[Image.Image, float]:
    """Return the black-and-white page of the ChArUco board or chessboard that `spec` names, and its resolution, px/mm.

    `spec` is a value of --board, `paper` a key of PAPERS_MM. A square is a whole number of pixels wide. Raises
    InputError for a name that means no such board, and for a board that does not fit on the paper.
    """
    boards(spec)
    kind, *parts = spec.split(":")
    if kind not in ("charuco", "chessboard"):
        raise InputError(f"jcr board {spec}: prints charuco:… and chessboard:…; choose one of these")
    inner = int(kind == "chessboard")  # a chessboard is named by its inner corners
    across, down = (int(text) + inner for text in parts[0].split("x"))
    square_mm = 1e3 * float(parts[1])
    width, height, page = square_mm * across, square_mm * down, PAPERS_MM[paper]
    free = page[0] - 2 * MARGIN_MM - BAND_MM, page[1] - 2 * MARGIN_MM - BAND_MM
    if width > free[0] + 1e-9 or height > free[1] + 1e-9:
        raise InputError(
            f"jcr board {spec}: {width:g} x {height:g} mm, but {paper} has room for {free[0]:g} x {free[1]:g}; "
            "make the squares smaller or fewer, or choose a larger --paper"
        )
    square_px = int(np.ceil(LEAST_PX_PER_MM * square_mm))
    if kind == "charuco":
        tags = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, parts[3]))
        printed = cv2.aruco.CharucoBoard((across, down), 1.0, float(parts[2]) / float(parts[1]), tags)
        if (count := len(printed.getIds())) > len(tags.bytesList):
            raise InputError(
                f"jcr board: {across}x{down} squares need {count} markers, but {parts[3]} has {len(tags.bytesList)}; "
                f"choose {parts[3].rpartition('_')[0]}_100 or a larger one"
            )
        board = np.asarray(printed.generateImage((square_px * across, square_px * down)), np.uint8)
    else:
        white = np.add.outer(np.arange(down), np.arange(across)) % 2 == 1
        board = np.kron(255 * white, np.ones((square_px, square_px))).astype(np.uint8)
    px_per_mm = square_px / square_mm
    pixels = Image.new("1", (round(px_per_mm * page[0]), round(px_per_mm * page[1])), 1)
    left, top = MARGIN_MM + BAND_MM, MARGIN_MM
    pixels.paste(Image.fromarray(board), (round(px_per_mm * left), round(px_per_mm * top)))
    below, ruler = page[1] - MARGIN_MM, RULER_MM if height >= RULER_MM else 50.0
    _ruler(pixels, px_per_mm, (left, below - 6.0), ruler, along_x=True)
    _ruler(pixels, px_per_mm, (MARGIN_MM + 6.0, top), ruler, along_x=False)
    rulers = f"Both rulers are {ruler:g} mm. If yours measure R mm, multiply the lengths in --board by R/{ruler:g}."
    use = f"--board {spec}   Print at 100 %, not fitted to the page; glue it to something flat."
    font, draw = ImageFont.load_default(TEXT_MM * px_per_mm), ImageDraw.Draw(pixels)
    for x_mm, y_mm, text in (
        (left, below, use),
        (left + ruler + 4.0, below - 5.0, rulers),
        (MARGIN_MM, top + ruler + TEXT_MM + 1.0, f"{ruler:g} mm"),
    ):
        draw.text((x_mm * px_per_mm, y_mm * px_per_mm), text, 0, font, anchor="ls")
    return pixels, px_per_mm


def _ruler(
    pixels: Image.Image, px_per_mm: float, start_mm: tuple[float, float], length_mm: float, along_x: bool
) -> None:
    """Draw a ruler of `length_mm` into the page `pixels`, with long ticks every 10 mm and short ticks every 1 mm.

    The ruler begins at `start_mm` (x, y from the top-left corner of the page) and goes right or, unless `along_x`,
    down. The ticks are above a horizontal line and left of a vertical one.
    """
    draw, width = ImageDraw.Draw(pixels), round(0.15 * px_per_mm)
    x, y = start_mm
    ends = [((0.0, 0.0), (length_mm, 0.0))]
    ends += [((k, 0.0), (k, -3.0 if k % 10 == 0 else -1.2)) for k in range(round(length_mm) + 1)]
    for one in ends:
        places = [(x + a, y + b) if along_x else (x + b, y + a) for a, b in one]
        draw.line([(px_per_mm * a, px_per_mm * b) for a, b in places], 0, width)
