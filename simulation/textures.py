"""Textures made with NumPy from a seed: wood, laminate, print for packages and labels, glaze."""

import colorsys

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

Image = UInt8[ndarray, "_ _ 3"]
"""RGB."""
Color = tuple[float, float, float]
"""Red, green, blue, 0 to 1."""
Ink = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

_WORDS = ("COFFEE", "RICE", "TEA", "OATS", "CORN", "SOUP", "PASTA", "SALT", "COCOA", "BEANS", "PLUM", "MINT")
_FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX)


def wood(rng: np.random.Generator, height: int, width: int, light: Color, dark: Color) -> Image:
    """Draw planks along the rows with year rings, fibres and pores between two colours (h,w,3)."""
    planks = []
    for plank in np.array_split(np.arange(height), 8):
        rows = len(plank)
        bend = 30 * _smooth_noise(rng, rows, width, (140.0, 500.0))
        bend += 6 * _smooth_noise(rng, rows, width, (50.0, 150.0))
        across = np.arange(rows, dtype=np.float32)[:, None] + bend
        spacing = np.float32(rng.uniform(26, 44))
        ring = 0.5 + 0.5 * np.sin(2 * np.pi * across / spacing + 2 * np.sin(across / (1.3 * spacing)))
        fibre = _smooth_noise(rng, rows, width, (2.0, 60.0)) + _smooth_noise(rng, rows, width, (4.0, 14.0))
        pores = np.clip(_smooth_noise(rng, rows, width, (3.0, 10.0)) - 0.7, 0, 1)
        shade = 0.22 * ring**3 + 0.1 * fibre + 1.5 * pores + np.float32(0.12 + rng.uniform(-0.09, 0.09))
        # The gap to the next plank.
        shade[:2] = 0.8
        planks.append(shade)
    shade = np.concatenate(planks)[..., None]
    return _to_image(_rgb(light) * (1 - shade) + _rgb(dark) * shade)


def laminate(rng: np.random.Generator, height: int, width: int, color: Color, contrast: float) -> Image:
    """Draw a plain table top with faint specks and clouds of that contrast (h,w,3)."""
    specks, clouds = (_smooth_noise(rng, height, width, (cell, cell)) for cell in (4.0, 150.0))
    return _to_image(_rgb(color) * (1 + np.float32(contrast) * (0.5 * specks + 0.5 * clouds)[..., None]))


def printed(rng: np.random.Generator, height: int, width: int, color: Color) -> Image:
    """Draw a printed package: a ground colour, a name, an image of overlapping shapes, small print (h,w,3)."""
    image = np.full((height, width, 3), _ink(color), np.uint8)
    inks = [_ink(colorsys.hsv_to_rgb(*rng.uniform((0, 0.25, 0.35), (1, 0.85, 0.95)))) for _ in range(4)]
    bright = np.mean(color) > 0.45
    lettering = _ink((0.10, 0.10, 0.16) if bright else (0.95, 0.93, 0.86))
    band = int(rng.uniform(0.25, 0.35) * height)
    for _ in range(16):
        center = int(rng.uniform(0, width)), int(rng.uniform(band, height))
        axes = tuple(int(v) for v in rng.uniform(0.04, 0.2, 2) * min(height, width))
        ink, angle_deg = inks[rng.integers(len(inks))], float(rng.uniform(0, 180))
        if rng.random() < 0.5:
            cv2.ellipse(image, center, axes, angle_deg, 0, 360, ink, -1, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((center, (2.0 * axes[0], 2.0 * axes[1]), angle_deg))
            cv2.fillConvexPoly(image, corners.round().astype(np.int32), ink, cv2.LINE_AA)
    font = _FONTS[rng.integers(len(_FONTS))]
    _write(image, str(rng.choice(_WORDS)), (0.08, 0.12, 0.84, 0.7 * band / height), lettering, font)
    for line in range(4):
        words = " ".join(str(word).lower() for word in rng.choice(_WORDS, 4))
        _write(image, words, (0.08, 0.72 + 0.06 * line, 0.84, 0.035), lettering, cv2.FONT_HERSHEY_SIMPLEX)
    grain = 0.03 * _smooth_noise(rng, height, width, (2.0, 2.0))
    return _to_image(np.float32(image) / 255 + grain[..., None])


def glaze(rng: np.random.Generator, height: int, width: int, color: Color) -> Image:
    """Draw painted ceramics or fruit: a ground colour with soft clouds and small dark flecks (h,w,3).

    Its right half mirrors the left, so that it closes around a round thing.
    """
    half = width // 2
    clouds = _smooth_noise(rng, height, half, (height / 5, half / 4))
    flecks = np.clip(_smooth_noise(rng, height, half, (4.0, 4.0)) - 0.55, 0, 1)
    left = _to_image(_rgb(color) * (1 + 0.12 * clouds[..., None] - 0.7 * flecks[..., None]))
    return np.concatenate([left, left[:, ::-1]], axis=1)


def _smooth_noise(
    rng: np.random.Generator, height: int, width: int, cell: tuple[float, float]
) -> Float[ndarray, "h w"]:
    """Draw noise in about [-1, 1] whose blobs are `cell` (rows, columns) pixels large: a coarse grid, enlarged."""
    grid = rng.uniform(-1, 1, (max(2, round(height / cell[0])), max(2, round(width / cell[1]))))
    return cv2.resize(grid.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)


def _write(image: Image, words: str, within: tuple[float, float, float, float], ink: Ink, font: int) -> None:
    """Draw one line of text into `image`, as large as fits the box (left, top, width, height; fractions)."""
    rows, columns = image.shape[:2]
    (width, height), _ = cv2.getTextSize(words, font, 1.0, 2)
    scale = min(within[2] * columns / width, within[3] * rows / height)
    at = round(within[0] * columns), round(within[1] * rows + scale * height)
    cv2.putText(image, words, at, font, scale, ink, max(1, round(2 * scale)), cv2.LINE_AA)


def _rgb(color: Color) -> Float[ndarray, "3"]:
    return np.array(color, np.float32)


def _ink(color: Color) -> Ink:
    r, g, b = (round(255 * channel) for channel in color)
    return r, g, b


def _to_image(rgb: Float[ndarray, "h w 3"]) -> Image:
    return (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
