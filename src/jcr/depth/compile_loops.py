"""The loops of dense depth compiled, or loaded, ahead of their first use."""

import numpy as np

from jcr.depth.dense import dense_pointmaps
from jcr.geometry import transform
from jcr.progress import silent
from jcr.records import Intrinsics


def compile_loops() -> None:
    """Estimate the depth of a wall of noise before three cameras side by side, small, but by every loop."""
    pinhole = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    wall = np.random.default_rng(0).integers(0, 256, (30, 60, 3)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    shift_px = 10
    images = np.stack([wall[:, shift_px * k : shift_px * k + pinhole.width] for k in range(3)])
    centres = np.array([[0.1 * k, 0.0, 0.0] for k in range(3)])
    planes = np.tile([[[0.0, 0.0, 0.3], [0.0, 0.0, 2.5]]], (3, 1, 1))
    neighbours = [np.array([1, 2]), np.array([0, 2]), np.array([1, 0])]
    dense_pointmaps(images, transform(np.eye(3), centres), pinhole, neighbours, planes, silent)
