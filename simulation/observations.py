"""Image observations of a hand-eye problem's scene, made without rendering."""

import numpy as np

from jcr.camera import project
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics, Tracks
from simulation.problem import HandEyeProblem

INTRINSICS = Intrinsics(620.0, 618.0, 322.0, 236.0, 640, 480, (-0.08, 0.05, 1e-3, -5e-4, 0.01))


def observed(
    problem: HandEyeProblem,
    rng: np.random.Generator,
    points: int,
    noise_px: float,
    camera: Intrinsics = INTRINSICS,
) -> Tracks:
    """Points scattered over the table, seen with noise (px) by every camera that has them in its image."""
    low, high = np.array([0.25, -0.25, 0.0]), np.array([0.75, 0.25, 0.12])
    x_in_base = rng.uniform(low, high, (points, 3))
    base_from_camera = problem.base_from_camera
    image, point, pixels = [], [], []
    for i, pose in enumerate(base_from_camera):
        x_in_camera = apply(inverse(pose), x_in_base)
        x_px = project(camera, x_in_camera)
        inside = (x_px > 0).all(1) & (x_px < [camera.width, camera.height]).all(1)
        seen = np.flatnonzero(inside & (x_in_camera[:, 2] > 0))
        image.append(np.full(len(seen), i))
        point.append(seen)
        pixels.append(x_px[seen] + noise_px * rng.normal(size=(len(seen), 2)))
    # The reconstruction's frame follows from its first camera.
    recon_from_base = problem.recon_from_camera[0, :3, :3] @ base_from_camera[0, :3, :3].T
    about_camera = (x_in_base - base_from_camera[0, :3, 3]) / problem.scale
    return Tracks(
        image=np.concatenate(image),
        x_px=np.concatenate(pixels),
        point=np.concatenate(point),
        points_in_recon=about_camera @ recon_from_base.T + problem.recon_from_camera[0, :3, 3],
    )
