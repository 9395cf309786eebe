"""Draws explanation/published-map.png: `python docs/published_map.py OUT_DEFAULT OUT_PAPER`, runs of one capture.

Above, the surface of each map in the colour that it predicts, seen from one place; below, its occupancy on a horizontal
plane: white free, blue solid, grey unknown.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import jcr

OUT = Path(__file__).parent / "explanation" / "published-map.png"
SIZE = (440, 330)
"""Width and height of each picture, pixels."""
FOCAL_PX, AWAY_M, ABOVE_M = 420.0, (0.0, -0.62, 0.5), 0.03
"""Focal length; place of the viewer from the middle of the scene; height of the plane above the table."""
STEPS = 60
"""Steps along each ray, each as long as the distance from the nearest surface."""


def seen(scene: jcr.SceneMap, middle: np.ndarray) -> np.ndarray:
    """Return the picture of the map's surface by sphere tracing."""
    z = -np.array(AWAY_M) / np.linalg.norm(AWAY_M)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    u, v = np.meshgrid(np.arange(SIZE[0]) - SIZE[0] / 2, np.arange(SIZE[1]) - SIZE[1] / 2)
    ray = (u[..., None] * x + v[..., None] * np.cross(z, x) + FOCAL_PX * z).reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    at, distance = middle + np.array(AWAY_M) + np.zeros_like(ray), np.zeros(len(ray))
    for _ in range(STEPS):
        distance = scene.query(at, unknown="free").distance
        at = at + np.where(np.isfinite(distance), np.maximum(distance, 0.0), 0.02)[:, None] * ray
    hit = np.abs(distance) < 0.004
    picture = np.full((len(ray), 3), 255, np.uint8)
    picture[hit] = (255 * np.nan_to_num(scene.query(at[hit]).color).clip(0, 1)).astype(np.uint8)
    return picture.reshape(SIZE[1], SIZE[0], 3)


def slice_at(scene: jcr.SceneMap, middle: np.ndarray) -> np.ndarray:
    """Return the picture of the occupancy on a horizontal plane."""
    pitch = 0.9 / SIZE[0]
    u, v = np.meshgrid(np.arange(SIZE[0]) - SIZE[0] / 2, SIZE[1] / 2 - np.arange(SIZE[1]))
    x = middle + np.stack([pitch * u, pitch * v, np.full(u.shape, ABOVE_M)], -1)
    sample = scene.query(x.reshape(-1, 3))
    picture = 255 - sample.occupancy[:, None].clip(0, 1) * (255 - np.array([37, 99, 235]))
    if scene.history["preset"] == "default":
        picture[sample.unknown] = 190
    return picture.astype(np.uint8).reshape(SIZE[1], SIZE[0], 3)


def main(default: str, paper: str) -> None:
    """Draw both maps."""
    scenes = {"default": jcr.load_map(default), "--method paper": jcr.load_map(paper)}
    cloud = jcr.load_run(default).cloud
    assert cloud is not None
    middle = np.median(cloud.points_in_base, axis=0)
    columns = [np.concatenate([seen(one, middle), slice_at(one, middle)]) for one in scenes.values()]
    picture = Image.fromarray(np.concatenate(columns, axis=1))
    draw = ImageDraw.Draw(picture)
    for k, name in enumerate(scenes):
        draw.text((k * SIZE[0] + 8, 6), name, (0, 0, 0), font_size=18)
    picture.quantize(128).save(OUT, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
