"""Draws tabletop.png of the manual: `python docs/tabletop.py RUN`, where RUN is a run of examples/tabletop.

Left a photo; right the map in the base frame, sampled where predicted occupancy is high, in
predicted colours, with the camera on the gripper at that photo and its other places.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import jcr
from jcr.capture.images import read_image
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics
from jcr.report.map_samples import sample_surface
from jcr.run_folder import RunFolder

HERE = Path(__file__).parent
WIDTH, HEIGHT, FOCAL, FINER = 1500, 1160, 1950.0, 2
"""Of the view, drawn twice as large as it is written."""
GROUND = (250, 247, 244)
ORANGE, DARK = (18, 110, 224), (70, 70, 70)
PHOTO = 0
"""The image whose camera is drawn with the gripper."""


def view(target: np.ndarray, azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """camera_from_base (4,4) of a look at `target` (m) from angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    back = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.cross(-back, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-back, right), -back], axis=1)
    pose[:3, 3] = target + distance * back
    return inverse(pose)


class Canvas:
    """Points, lines and faces of the base frame on one picture, nearer ones over farther ones."""

    def __init__(self, camera_from_base: np.ndarray):
        self.camera_from_base = camera_from_base
        self.pixels = np.full((HEIGHT, WIDTH, 3), GROUND, np.uint8)
        self.depth = np.full((HEIGHT, WIDTH), np.inf)

    def project(self, x_in_base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n,2) and depths (n,)."""
        x = apply(self.camera_from_base, np.atleast_2d(x_in_base))
        return FOCAL * x[:, :2] / x[:, 2:] + (WIDTH / 2, HEIGHT / 2), x[:, 2]

    def points(self, x_in_base: np.ndarray, rgb: np.ndarray, size_m: float) -> None:
        """Squares of a size."""
        where, depth = self.project(x_in_base)
        half = np.ceil(FOCAL * size_m / depth / 2).astype(int)
        for k in np.argsort(-depth):
            (x, y), r = where[k].round().astype(int), half[k]
            if r <= x < WIDTH - r and r <= y < HEIGHT - r:
                self.pixels[y - r : y + r + 1, x - r : x + r + 1] = rgb[k, ::-1]

    def line(self, ends: np.ndarray, color: tuple[int, int, int], width: int) -> None:
        """A line through places."""
        where = self.project(ends)[0].round().astype(np.int32)
        cv2.polylines(self.pixels, [where], False, color, width, cv2.LINE_AA)

    def face(self, corners: np.ndarray, color: tuple[int, int, int]) -> None:
        """A filled polygon."""
        cv2.fillConvexPoly(self.pixels, self.project(corners)[0].round().astype(np.int32), color, cv2.LINE_AA)

    def box(self, base_from_box: np.ndarray, low: tuple, high: tuple, color: tuple[int, int, int]) -> None:
        """A box, faces nearer to the eye brighter."""
        low, high = np.array(low), np.array(high)
        faces = []
        for axis in range(3):
            for side in (0, 1):
                others = [other for other in range(3) if other != axis]
                corners = np.empty((4, 3))
                corners[:, axis] = (low, high)[side][axis]
                for corner, (i, j) in enumerate(((0, 0), (0, 1), (1, 1), (1, 0))):
                    corners[corner, others[0]] = (low, high)[i][others[0]]
                    corners[corner, others[1]] = (low, high)[j][others[1]]
                faces.append((apply(base_from_box, corners), axis))
        for corners, axis in sorted(faces, key=lambda face: -self.project(face[0])[1].mean()):
            self.face(corners, tuple(int(part * (0.7, 0.85, 1.0)[axis]) for part in color))

    def photo(self, image: np.ndarray, corners: np.ndarray) -> None:
        """An image on a rectangle."""
        height, width = image.shape[:2]
        source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
        onto = self.project(corners)[0].astype(np.float32)
        moved = cv2.getPerspectiveTransform(source, onto)
        warped = cv2.warpPerspective(image, moved, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full((height, width), 255, np.uint8), moved, (WIDTH, HEIGHT))
        self.pixels[mask > 127] = warped[mask > 127]


def corners_at(intrinsics: Intrinsics, depth: float) -> np.ndarray:
    """Corners of the image at a depth (m), camera frame."""
    x = np.array([0, intrinsics.width, intrinsics.width, 0]) - intrinsics.cx
    y = np.array([0, 0, intrinsics.height, intrinsics.height]) - intrinsics.cy
    return np.stack([depth * x / intrinsics.fx, depth * y / intrinsics.fy, np.full(4, depth)], axis=1)


def drawn(run: Path) -> np.ndarray:
    """The whole picture, BGR."""
    capture, calibration = RunFolder(run).capture(), RunFolder(run).calibration()
    intrinsics = calibration.intrinsics.record()
    gripper_from_camera = np.array(calibration.gripper_from_camera)
    base_from_camera = capture.base_from_gripper @ gripper_from_camera
    surface = sample_surface(jcr.load_map(run), 400_000)
    middle = np.median(surface.points_in_base, axis=0)
    canvas = Canvas(view(middle + [-0.03, 0.03, 0.21], *VIEW))
    canvas.points(surface.points_in_base, surface.color, 0.004)
    for k, pose in enumerate(base_from_camera):
        if k != PHOTO:
            corners = apply(pose, corners_at(intrinsics, 0.05))
            canvas.line(corners[[0, 1, 2, 3, 0]], ORANGE, 2)
            for corner in corners:
                canvas.line(np.stack([pose[:3, 3], corner]), ORANGE, 2)
    pose, gripper = base_from_camera[PHOTO], capture.base_from_gripper[PHOTO]
    image = read_image(capture.folder / capture.images[PHOTO])[:, :, ::-1]
    at = apply(pose, corners_at(intrinsics, 0.14))
    canvas.box(gripper, (-0.035, -0.035, -0.14), (0.035, 0.035, -0.005), (215, 215, 215))
    canvas.line(np.stack([apply(gripper, np.zeros((1, 3)))[0], pose[:3, 3]]), DARK, 22)
    canvas.box(gripper, (-0.02, -0.045, -0.005), (0.02, 0.045, 0.03), (150, 150, 150))
    canvas.box(gripper, (-0.012, -0.045, 0.03), (0.012, -0.03, 0.085), (120, 120, 120))
    canvas.box(gripper, (-0.012, 0.03, 0.03), (0.012, 0.045, 0.085), (120, 120, 120))
    canvas.box(pose, (-0.03, -0.02, -0.035), (0.03, 0.02, 0.0), (60, 60, 60))
    canvas.photo(image, at)
    canvas.line(at[[0, 1, 2, 3, 0]], ORANGE, 5)
    for corner in at:
        canvas.line(np.stack([pose[:3, 3], corner]), ORANGE, 3)
    for axis, color in enumerate(((40, 40, 220), (60, 160, 60), (220, 90, 40))):
        canvas.line(np.stack([np.zeros(3), 0.1 * np.eye(3)[axis]]), color, 5)
    return beside(image, canvas)


VIEW = (-122.0, 26.0, 1.62)
"""Azimuth, elevation (°), distance (m)."""


def beside(photo: np.ndarray, canvas: Canvas) -> np.ndarray:
    """The photo left of the view."""
    right = cv2.resize(canvas.pixels, (WIDTH // FINER, HEIGHT // FINER), interpolation=cv2.INTER_AREA)
    height = right.shape[0]
    width = round(photo.shape[1] * 0.76 * height / photo.shape[0])
    left = np.full((height, width + 40, 3), GROUND, np.uint8)
    small = cv2.resize(
        photo, (width, round(width * photo.shape[0] / photo.shape[1])), interpolation=cv2.INTER_AREA
    )
    top = (height - small.shape[0]) // 2
    left[top : top + small.shape[0], 20 : 20 + width] = small
    return np.hstack([left, right])


if __name__ == "__main__":
    picture = Image.fromarray(drawn(Path(sys.argv[1]))[:, :, ::-1]).quantize(
        256, method=Image.Quantize.MEDIANCUT
    )
    picture.save(HERE / "tabletop.png", optimize=True)
