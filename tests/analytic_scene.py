"""Table with a box and a ball, whose distances are known, and a ring of cameras around it."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

import scenes
from jcr.camera import rays
from jcr.records import Intrinsics, PointCloud

TABLE_HALF = np.array([0.4, 0.35, 0.02])
"""Half of the table's sides (m); its top is z = 0."""
BOX_CENTER, BOX_HALF = np.array([0.12, 0.05, 0.05]), np.array([0.06, 0.04, 0.05])
BALL_CENTER, BALL_RADIUS = np.array([-0.12, -0.05, 0.06]), 0.06
LABELS = ("none", "table", "box", "ball")
WORKSPACE = (-0.45, -0.4, -0.1, 0.45, 0.4, 0.6)
FOCAL_PX, WIDTH, HEIGHT = 250.0, 240, 200


def signed_distance(
    x: Float[ndarray, "n 3"], without_box: bool = False, without_ball: bool = False
) -> Float[ndarray, " n"]:
    """Return metres to the nearest true surface, negative inside."""

    def to_box(center: ndarray, half: ndarray) -> ndarray:
        q = np.abs(x - center) - half
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    distances = [to_box(np.array([0, 0, -TABLE_HALF[2]]), TABLE_HALF)]
    if not without_box:
        distances.append(to_box(BOX_CENTER, BOX_HALF))
    if not without_ball:
        distances.append(np.linalg.norm(x - BALL_CENTER, axis=1) - BALL_RADIUS)
    return np.min(distances, axis=0)


def camera_centers(cameras: int) -> Float[ndarray, "m 3"]:
    """Return places on a ring, alternately high and low."""
    rotation = 2 * np.pi * np.arange(cameras) / cameras
    up = np.radians(np.where(np.arange(cameras) % 2, 35, 65))
    return 0.7 * np.stack([np.cos(up) * np.cos(rotation), np.cos(up) * np.sin(rotation), np.sin(up)], -1)


def true_color(x: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Return a smooth pattern in [0, 1]."""
    return 0.5 + 0.45 * np.sin(x * [30, 40, 50] + [0, 1, 2])


def cloud(points: int = 60_000, cameras: int = 10, noise: float = 0.0, seed: int = 0) -> PointCloud:
    """Return the points that the cameras see, with Gaussian noise (m) along the rays."""
    draw = np.random.default_rng(seed)
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    parts = []
    centers = camera_centers(cameras)
    for k, center in enumerate(centers):
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z])
        ray = np.stack(
            [column.ravel() - WIDTH / 2, row.ravel() - HEIGHT / 2, np.full(column.size, FOCAL_PX)], 1
        )
        ray = ray @ axes
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        reach, label = _cast(center, ray)
        hit = np.isfinite(reach)
        reach = reach[hit] + noise * draw.normal(size=hit.sum())
        parts.append((center + reach[:, None] * ray[hit], label[hit], np.full(hit.sum(), k)))
    x_in_base, label, image = map(np.concatenate, zip(*parts, strict=True))
    chosen = draw.choice(len(image), min(points, len(image)), replace=False)
    x_in_base = x_in_base[chosen]
    color = (255 * true_color(x_in_base)).astype(np.uint8)
    seen = {"label": label[chosen], "image": image[chosen], "camera_centers_in_base": centers}
    return scenes.cloud_of(x_in_base, color=color, label_names=LABELS, **seen)


def looking_at_table(cameras: int) -> Float[ndarray, "m 4 4"]:
    """Return base_from_camera of the ring, at different distances and rotated about their axes."""
    poses = np.tile(np.eye(4), (cameras, 1, 1))
    for k, center in enumerate(camera_centers(cameras)):
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        x = np.cos(0.5 * k) * x + np.sin(0.5 * k) * np.cross(z, x)
        poses[k, :3, :3] = np.stack([x, np.cross(z, x), z], 1)
        poses[k, :3, 3] = center * (0.7 + 0.05 * (k % 5)) / 0.7
    return poses


def cast_depth(base_from_camera: Float[ndarray, "4 4"], intrinsics: Intrinsics) -> Float[ndarray, "h w"]:
    """Return depth along the optical axis (m) at every pixel; 0 where nothing is hit."""
    ray = rays(intrinsics).reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    reach, _ = _cast(base_from_camera[:3, 3], ray @ base_from_camera[:3, :3].T)
    return np.where(np.isfinite(reach), reach * ray[:, 2], 0.0).reshape(intrinsics.height, intrinsics.width)


def _cast(origin: ndarray, ray: ndarray) -> tuple[ndarray, ndarray]:
    reach, label = np.full(len(ray), np.inf), np.zeros(len(ray), int)
    ray = np.where(ray == 0, 1e-12, ray)
    boxes = [(np.array([0, 0, -TABLE_HALF[2]]), TABLE_HALF), (BOX_CENTER, BOX_HALF)]
    for k, (center, half) in enumerate(boxes, start=1):
        low, high = (center - half - origin) / ray, (center + half - origin) / ray
        near, far = np.minimum(low, high).max(1), np.maximum(low, high).min(1)
        first = (near < far) & (near < reach)
        reach[first], label[first] = near[first], k
    toward = ray @ (BALL_CENTER - origin)
    inside = toward**2 - ((BALL_CENTER - origin) ** 2).sum() + BALL_RADIUS**2
    near = toward - np.sqrt(np.maximum(inside, 0))
    first = (inside > 0) & (near < reach)
    reach[first], label[first] = near[first], 3
    return reach, label
