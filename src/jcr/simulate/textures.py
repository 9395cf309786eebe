"""Textures made with NumPy from a seed: wood, speckled laminate, and print for packages and labels."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

Image = UInt8[ndarray, "h w 3"]
Color = tuple[float, float, float]

_WORDS = ("COFFEE", "RICE", "TEA", "OATS", "CORN", "SOUP", "PASTA", "SALT", "COCOA", "BEANS", "PLUM", "MINT")
_FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX_SMALL)


def _smooth_noise(
    rng: np.random.Generator, height: int, width: int, cell: tuple[float, float]
) -> Float[ndarray, "h w"]:
    """Noise in about [-1, 1] whose blobs are `cell` (rows, columns) pixels large: a coarse grid, enlarged."""
    grid = rng.uniform(-1, 1, (max(2, round(height / cell[0])), max(2, round(width / cell[1]))))
    return cv2.resize(grid.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)


def _to_image(rgb: Float[ndarray, "h w 3"]) -> Image:
    return (np.clip(rgb, 0, 1) * 255).round().astype(np.uint8)


def wood(rng: np.random.Generator, height: int, width: int, light: Color, dark: Color) -> Image:
    """Planks along the columns with year rings, fibres and pores between two colours (h,w,3)."""
    planks = []
    edges = np.linspace(0, height, 9).round().astype(int)
    for rows in np.diff(edges):
        bend = 30 * _smooth_noise(rng, rows, width, (140, 500)) + 6 * _smooth_noise(rng, rows, width, (50, 150))
        across = np.arange(rows, dtype=np.float32)[:, None] + bend
        spacing = rng.uniform(26, 44)
        ring = 0.5 + 0.5 * np.sin(2 * np.pi * across / spacing + 2 * np.sin(across / (1.3 * spacing)))
        fibre = _smooth_noise(rng, rows, width, (2, 60)) + _smooth_noise(rng, rows, width, (4, 14))
        pores = np.clip(_smooth_noise(rng, rows, width, (3, 10)) - 0.7, 0, 1)
        shade = 0.22 * ring**3 + 0.1 * fibre + 1.5 * pores + 0.12 + rng.uniform(-0.09, 0.09)
        shade[:2] = 0.8
        planks.append(shade)
    shade = np.concatenate(planks)[..., None]
    return _to_image(np.array(light) * (1 - shade) + np.array(dark) * shade)


def laminate(rng: np.random.Generator, height: int, width: int, color: Color, contrast: float) -> Image:
    """A plain table top with faint specks and clouds of the given contrast (h,w,3)."""
    shade = 0.6 * _smooth_noise(rng, height, width, (3, 3)) + 0.4 * _smooth_noise(
        rng, height, width, (150, 150)
    )
    return _to_image(np.array(color) * (1 + contrast * shade[..., None]))


def printed(rng: np.random.Generator, height: int, width: int, color: Color) -> Image:
    """A printed package: a ground colour, a picture of overlapping shapes, a name and small print (h,w,3)."""
    ground = np.array(color)
    image = np.ascontiguousarray(_to_image(np.broadcast_to(ground, (height, width, 3))))
    ink = tuple(int(v) for v in (255 * (ground < 0.5)))
    band = int(rng.uniform(0.28, 0.4) * height)
    for _ in range(14):
        center = (int(rng.uniform(0, width)), int(rng.uniform(band, height)))
        axes = tuple(int(v) for v in rng.uniform(0.04, 0.2, 2) * min(height, width))
        shade = tuple(int(v) for v in rng.integers(20, 236, 3))
        if rng.random() < 0.5:
            cv2.ellipse(image, center, axes, rng.uniform(0, 180), 0, 360, shade, -1, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((center, (2.0 * axes[0], 2.0 * axes[1]), float(rng.uniform(0, 90))))
            cv2.fillConvexPoly(image, corners.round().astype(np.int32), shade, cv2.LINE_AA)
    _text(image, str(rng.choice(_WORDS)), (0.06, 0.8 * band / height), 0.88, ink, _FONTS[rng.integers(3)])
    for line in range(5):
        words = " ".join(str(word).lower() for word in rng.choice(_WORDS, 4))
        _text(image, words, (0.08, 0.97 - 0.05 * line), rng.uniform(0.5, 0.8), ink, cv2.FONT_HERSHEY_SIMPLEX)
    grain = 0.03 * _smooth_noise(rng, height, width, (2, 2))
    return _to_image(image / 255 + grain[..., None])


def _text(
    image: Image, words: str, at: tuple[float, float], width: float, ink: tuple[int, ...], font: int
) -> None:
    """Write `words` into `image`, its lower left corner and width as fractions of the image."""
    (natural, _), _ = cv2.getTextSize(words, font, 1.0, 1)
    scale = width * image.shape[1] / natural
    origin = (int(at[0] * image.shape[1]), int(at[1] * image.shape[0]))
    cv2.putText(image, words, origin, font, scale, ink, max(1, round(1.7 * scale)), cv2.LINE_AA)


def glaze(rng: np.random.Generator, height: int, width: int, color: Color) -> Image:
    """Painted ceramics or fruit: a ground colour with soft clouds and small dark flecks (h,w,3)."""
    clouds = _smooth_noise(rng, height, width, (height / 5, width / 7))
    flecks = np.clip(_smooth_noise(rng, height, width, (5, 5)) - 0.45, 0, 1)
    return _to_image(np.array(color) * (1 + 0.12 * clouds[..., None] - 0.9 * flecks[..., None]))
