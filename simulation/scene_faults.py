"""Faults of a scene while a capture is taken: objects that move, displays, repeated patterns, wrong boards."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import rotation_exp, transform
from simulation import textures
from simulation.meshes import Mesh, box, grid
from simulation.objects import Part, TableObject
from simulation.scenes import Scene

SceneChange = Callable[[Scene, int, Float[ndarray, "4 4"]], Scene]
"""Scene at the time of an image, from the scene, the row of the image and base_from_camera."""
MIDWAY = 4
"""Row of the first image after a motion of the scene."""
BOARD = "charuco:7x5:0.030:0.022:DICT_4X4_50"
"""Board as its user states it."""
BOARD_SHAPE, SQUARE_M, MARKER_M, SQUARE_PX = (7, 5), 0.030, 0.022, 60
THICK_M = 0.002


def _shifted(scene: Scene, offset: tuple[float, float, float], count: int) -> Scene:
    """Return the scene with its first objects moved by an offset (m)."""
    by = transform(np.eye(3), np.array(offset))
    moved = [replace(one, base_from_object=by @ one.base_from_object) for one in scene.objects[:count]]
    return replace(scene, objects=(*moved, *scene.objects[count:]))


def _with_object(scene: Scene, name: str, parts: tuple[Part, ...], center_from_object: ndarray) -> Scene:
    """Return the scene with another object, placed relative to the middle of the table top."""
    place = transform(np.eye(3), scene.table_center_in_base) @ center_from_object
    return replace(scene, objects=(*scene.objects, TableObject(name, parts, place)))


def pushed(scene: Scene, row: int, base_from_camera: ndarray) -> Scene:
    """Push three objects by 6 cm midway."""
    return _shifted(scene, (0.04, 0.045, 0.0), 3) if row >= MIDWAY else scene


def belt(scene: Scene, row: int, base_from_camera: ndarray) -> Scene:
    """Move a printed belt and all but two of the objects by 5 cm midway."""
    texture = textures.printed(np.random.default_rng(7), 900, 1200, (0.75, 0.74, 0.70))
    strip = (Part(box((0.40, 0.55, THICK_M), ("+z",)), (0.75, 0.74, 0.70), texture, shine=0.0),)
    laid = _with_object(scene, "belt", strip, np.eye(4))
    laid = replace(laid, objects=(laid.objects[-1], *laid.objects[:-1]))
    return _shifted(laid, (0.0, 0.05, 0.0), len(laid.objects) - 2) if row >= MIDWAY else laid


def display(scene: Scene, row: int, base_from_camera: ndarray) -> Scene:
    """Stand a display behind the objects that scrolls by a tenth of its height from image to image."""
    texture = textures.printed(np.random.default_rng(8), 800, 1200, (0.85, 0.86, 0.88))
    texture = np.roll(texture, 80 * row, axis=0)
    panel = (Part(box((0.02, 0.60, 0.40), ("-x",)), (0.9, 0.9, 0.9), texture, shine=0.0),)
    return _with_object(scene, "display", panel, transform(np.eye(3), np.array([0.17, 0.0, 0.0])))


def moving_link(scene: Scene, row: int, base_from_camera: ndarray) -> Scene:
    """Hold another arm's printed link over the table, at another place in each image."""
    rng = np.random.default_rng([9, row])
    texture = textures.printed(np.random.default_rng(9), 600, 600, (0.85, 0.55, 0.2))
    link = (Part(box((0.14, 0.14, 0.34)), (0.85, 0.55, 0.2), texture),)
    at = np.array([rng.uniform(-0.12, 0.12), rng.uniform(-0.12, 0.12), 0.02])
    turned = transform(rotation_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])), at)
    return _with_object(scene, "link", link, turned)


def tiled(scene: Scene, row: int, base_from_camera: ndarray) -> Scene:
    """Cover the table with equal tiles of 3 cm, and leave two objects on it."""
    tile = textures.printed(np.random.default_rng(10), 60, 60, (0.80, 0.78, 0.72))
    tile[:3], tile[:, :3] = 90, 90
    top = scene.table[0]
    size = np.ptp(top.mesh.vertices[:, :2], axis=0)
    counts = np.round(size / 0.03).astype(int)
    table = replace(top, texture=np.tile(tile, (counts[1], counts[0], 1)))
    return replace(scene, table=(table, *scene.table[1:]), objects=scene.objects[:2])


@dataclass(frozen=True, kw_only=True)
class PrintedBoard:
    """ChArUco board on the table that differs from BOARD, as a change of the scene."""

    stretch: float = 0.0
    """Relative excess of its length along x."""
    size: float = 0.0
    """Relative excess of its size."""
    bend_m: float = 0.0
    """Height of its short edges over its middle."""
    moved_m: float = 0.0
    """Distance along x by which it is moved midway."""
    held: bool = False
    """Whether the robot holds it before the camera."""

    def __call__(self, scene: Scene, row: int, base_from_camera: Float[ndarray, "4 4"]) -> Scene:
        """Return the scene with the board in place of the objects that stand there."""
        # The corner of the image is the board's first corner, and v grows upwards.
        texture = _board_texture()
        length, width = SQUARE_M * (1 + self.size) * np.array(BOARD_SHAPE)
        parts = (
            Part(_sheet(length * (1 + self.stretch), width, self.bend_m), (1.0, 1.0, 1.0), texture, 0.0),
        )
        if self.held:
            # Its printed side faces the camera, half a metre away.
            facing = transform(rotation_exp(np.array([np.pi, 0.0, 0.0])), np.array([0.03, 0.05, 0.36]))
            return replace(
                scene, objects=(*scene.objects, TableObject("board", parts, base_from_camera @ facing))
            )
        reach = 0.5 * float(np.hypot(length, width))
        center = scene.table_center_in_base[:2]
        beside = tuple(
            one
            for one in scene.objects
            if np.linalg.norm(one.base_from_object[:2, 3] - center) > reach + 0.5 * one.radius
        )
        at = np.array([self.moved_m if row >= MIDWAY else 0.0, 0.0, 0.0])
        return _with_object(replace(scene, objects=beside), "board", parts, transform(np.eye(3), at))


def _board_texture() -> ndarray:
    """Return the print of BOARD, RGB."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(BOARD_SHAPE, SQUARE_M, MARKER_M, dictionary)
    across, down = BOARD_SHAPE
    return np.repeat(board.generateImage((SQUARE_PX * across, SQUARE_PX * down))[..., None], 3, axis=2)


def _sheet(length_m: float, width_m: float, bend_m: float) -> Mesh:
    """Return a sheet THICK_M above the table whose short edges are raised by `bend_m`."""
    u, v = np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 1, 2))
    z = THICK_M + bend_m * (2 * u - 1) ** 2
    vertices = np.stack([length_m * (u - 0.5), width_m * (v - 0.5), z], axis=-1)
    return grid(vertices, np.stack([u, v], axis=-1))


WRONG_BOARDS: dict[str, SceneChange] = {
    "right": PrintedBoard(),
    "1 % longer in x": PrintedBoard(stretch=0.01),
    "3 % longer in x": PrintedBoard(stretch=0.03),
    "2 % larger": PrintedBoard(size=0.02),
    "bent by 3 mm": PrintedBoard(bend_m=3e-3),
    "moved by 3 mm midway": PrintedBoard(moved_m=3e-3),
    "moved by 1 mm midway": PrintedBoard(moved_m=1e-3),
    "held by the robot": PrintedBoard(held=True),
}
