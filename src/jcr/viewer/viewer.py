"""3D view of a run in the browser: points, cameras, robot, slices of the map, and a sphere for collision tests.

Parts that are only shown or hidden need no control here, because viser lists all parts with a switch for each.
"""

import io
import logging
import threading
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray
from skimage.measure import marching_cubes
from viser.extras import ViserUrdf
from viser.transforms import SO3

from jcr.camera import pinhole_inside, undistortion
from jcr.capture.images import read_image
from jcr.capture.urdf_chain import load_urdf
from jcr.errors import InputError, count_of
from jcr.geometry import scale_translation
from jcr.progress import Progress, silent
from jcr.records import Capture
from jcr.report.images import image_numbers
from jcr.report.render import render
from jcr.report.scene3d import BY_LABEL, point_layers, track_layer
from jcr.report.verdict import head
from jcr.result import RunResult
from jcr.scene.scene_map import SceneMap, Unknown
from jcr.segments.measure import Measurement

if TYPE_CHECKING:
    import yourdfpy

CAMERA, CHOSEN, REJECTED = (200, 110, 30), (37, 99, 235), (200, 50, 43)
"""RGB of cameras: of used images, of the selected image, and of rejected images."""
FREE, COLLIDES, OCCUPIED = (40, 160, 90), (220, 40, 40), (37, 99, 235)
"""RGB of the free and of the colliding sphere, and of occupied space in a slice."""
UNSEEN_RGB = (110, 110, 110)
"""RGB of unknown space."""
MOST_DRAWN = 150_000
"""Largest number of points that are drawn of a layer."""
UNKNOWN_CELLS = 300_000
"""Number of cells for which the map is queried to find the border of unknown space."""
IMAGE_PX = 160
"""Longer side (px) of the images that are drawn in the cameras."""
FRUSTUM_M = 0.05
"""Distance from a camera to its drawn image plane (m)."""
CLICK_RAD = 0.006
"""Largest angle (rad) between the ray of a click and a point that it selects."""
FAR_M, SLICE_PIXELS = 0.2, 240
"""Distance (m) at which the colour scale of a slice ends, and pixels along the longer side of a slice."""
HOST = "127.0.0.1"
"""Address of the server: loopback, because viser has no password and no encryption."""
Value = Float[ndarray, "3"]
"""Point (m) or direction in the base frame."""
SLICE_LEGENDS = {
    "distance": f"yellow: at a surface; violet: {100 * FAR_M:.0f} cm and more; red: solid",
    "occupancy": "white: free; blue: occupied; grey: unknown",
}
"""Legend of the colours of a slice, by its property."""


class LocalServer(viser.ViserServer):
    """Server of the viewer's page (viser) that other machines cannot reach: it opens no tunnel and prints nothing."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return None instead of a public address, because sharing is disabled."""
        return None

    def stop(self) -> None:
        """Stop the server, without viser's messages on standard output."""
        with redirect_stdout(io.StringIO()):
            super().stop()


def open_server(port: int, title: str) -> LocalServer:
    """Start a server at a port of 127.0.0.1 (0: any free one) and return it; `title` is the title of its page.

    Raises InputError if the port is invalid or in use.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: no such port; take one from 1024 to 65535, or 0 for any free one")
    # A browser that closes its connection early is no error of the viewer.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with redirect_stdout(io.StringIO()):
        server = LocalServer(host=HOST, port=port, label=title, verbose=False)
    if port not in (0, server.get_port()):  # viser uses the next free port without an error
        server.stop()
        raise InputError(f"cannot listen on port {port} of {HOST}; choose another --port (0: any free one)")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def read_robot(urdf: Path, capture: Capture) -> "tuple[yourdfpy.URDF, Float[ndarray, 'n dof']]":
    """Return the robot of a URDF with its visual meshes, and its joint values (n,dof) at the n images (rad or m).

    The joint values of the capture are those of the first movable joints in the URDF; other joints, such as fingers,
    are at 0. Raises InputError if the URDF cannot be read or has fewer movable joints, or the capture has no joint
    values.
    """
    import yourdfpy

    moving = load_urdf(urdf).actuated_joint_names
    if (joints := capture.joints) is None:
        raise InputError(
            f"{capture.folder}: has no joint values, so the robot's pose is unknown; add `joints` (rad) to each frame "
            "of its capture.json, or leave out --urdf"
        )
    if len(moving) < joints.shape[1]:
        raise InputError(
            f"{urdf}: moves {count_of(len(moving), 'joint')}, the capture has {joints.shape[1]} values for each image; "
            "give the URDF of the whole arm"
        )
    try:
        robot = yourdfpy.URDF.load(str(urdf))
    except Exception as error:  # the readers of meshes raise errors of many types
        raise InputError(f"{urdf}: a mesh cannot be read ({error})") from error
    return robot, np.pad(joints, ((0, 0), (0, len(moving) - joints.shape[1])))


class Viewer:
    """3D view of a run: fills a viser server with the scene and its controls, and handles their events."""

    def __init__(
        self,
        server: viser.ViserServer,
        run: RunResult,
        urdf: Path | None = None,
        report: Progress = silent,
    ) -> None:
        """Fill the server with the scene and controls of a run; `urdf` replaces the robot of the capture.

        There is no robot if `urdf` is None and the capture has no URDF or no joint values.
        """
        self.server, self._lock = server, threading.Lock()
        self.calibration, self.capture, self.reconstruction = run.of_wrist_camera()
        self.cloud, self.scene = run.cloud, run.scene
        base_from_recon, self.image_index = self.calibration.base_from_recon, self.reconstruction.image_index
        recon_from_camera = scale_translation(self.reconstruction.recon_from_camera, base_from_recon.scale)
        self.base_from_camera = base_from_recon.rigid @ recon_from_camera
        self.tracks_in_base = base_from_recon(self.reconstruction.tracks.points_in_recon)
        server.scene.set_up_direction("+z")
        headline = head(self.calibration)["verdict"]
        lines = [(f"{headline['verdict']}:", f"{headline['reason']}.")]
        lines += [("", f"No map yet: make one with jcr map {run.out}")] * (self.scene is None)
        server.gui.add_html(render("headline.html", {"lines": lines}, "jcr.viewer"))
        report("view", 0.1)
        self._add_capture()
        self.robot = None
        if (urdf := urdf or (self.capture.urdf if self.capture.joints is not None else None)) is not None:
            robot, self._configurations = read_robot(urdf, self.capture)
            server.scene.add_frame("/robot", show_axes=False)
            self.robot = ViserUrdf(server, robot, root_node_name="/robot")
        report("view", 0.3)
        layers, self._labels = point_layers(self.scene, self.cloud, MOST_DRAWN)
        self._layers = {layer[0]: layer for layer in layers}
        self._solid = layers[0][1] if layers else self.tracks_in_base
        self._add_points()
        if self.scene is not None:
            report("view", 0.6)
            self._add_map(self.scene, run.measured)
        self.show_points()
        self.choose_image()
        # The initial view is obliquely from above, and far enough to show the points and the cameras.
        target, cameras = _middle(self._solid), self.base_from_camera[:, :3, 3]
        reach = max(0.3, float(np.linalg.norm(cameras - target, axis=1).max(initial=0.0)))
        server.initial_camera.position = target + 1.6 * reach * np.array([0.62, -0.62, 0.6])
        server.initial_camera.look_at = target
        report("view", 1.0)

    def _add_capture(self) -> None:
        """Add base frame, cameras with their images, gripper frames, and the controls of the selected image."""
        server, gui, intrinsics = self.server, self.server.gui, self.reconstruction.intrinsics
        server.scene.add_frame("/base", axes_length=0.1, axes_radius=0.003)
        server.scene.add_label("/base/name", "base")
        server.scene.add_grid(
            "/grid",
            infinite_grid=True,
            cell_size=0.1,
            section_size=0.5,
            fade_distance=6.0,
            fade_from="origin",
        )
        pinhole = pinhole_inside(intrinsics, IMAGE_PX)
        undistort = undistortion(intrinsics, pinhole)
        self._fov = 2 * float(np.arctan2(pinhole.height / 2, pinhole.fy))
        self.frusta = []
        for k, pose in enumerate(self.base_from_camera):
            frustum = server.scene.add_camera_frustum(
                f"/cameras/{k}",
                self._fov,
                pinhole.width / pinhole.height,
                scale=FRUSTUM_M,
                thickness=2.0,
                thickness_units="screen",
                image=undistort(read_image(self.capture.folder / self.capture.images[self.image_index[k]])),
                wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
            )
            frustum.on_click(lambda event, k=k: self.look_from(k, event.client))
            self.frusta.append(frustum)
        for k, pose in enumerate(self.capture.base_from_gripper):
            place = {"wxyz": SO3.from_matrix(pose[:3, :3]).wxyz, "position": pose[:3, 3]}
            server.scene.add_frame(f"/grippers/{k}", axes_length=0.03, axes_radius=0.001, **place)
        with gui.add_folder("Capture", expand_by_default=False):
            self.image = gui.add_slider("image", 0, len(self.calibration.images) - 1, 1, 0)
            self._about_image = gui.add_html("")
        self.image.on_update(lambda _: self.choose_image())

    def _add_points(self) -> None:
        """Add the controls that select the drawn points and their colours, and the values at a clicked point."""
        gui, names = self.server.gui, [*self._layers, "none"]
        with gui.add_folder("Points"):
            self.shown = gui.add_dropdown("show", names, initial_value=names[0])
            self._legend = gui.add_html("")
            self.show_tracks = gui.add_checkbox("features", len(names) == 1, hint="tracked, red")
        for control in (self.shown, self.show_tracks):
            control.on_update(lambda _: self.show_points())
        with gui.add_folder("Click a point"):
            self.clicked = gui.add_html(_lines(("", "Click a point to see its values.")))
        self._mark = self.server.scene.add_icosphere("/clicked", 0.004, (255, 220, 0), visible=False)

        @self.server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            self.click(np.array(event.ray_origin), np.array(event.ray_direction))

    def _add_map(self, map: SceneMap, measured: Measurement | None) -> None:
        """Add a slice of the map, the border of unknown space (hidden), and a sphere to move, with their controls.

        The slice is horizontal. The sphere begins 0.15 m above the support plane of `measured`. If `measured` is None,
        the sphere begins 0.15 m above the lower border of the map.
        """
        gui, scene, (low, high) = self.server.gui, self.server.scene, map.box
        height = low[2] if measured is None else measured.support.base_from_support[2, 3]
        table_m = float(np.clip(height, low[2], high[2] - 0.02))
        with gui.add_folder("Map", expand_by_default=False):
            self.unknown = gui.add_dropdown("unknown is", ("occupied", "free"), initial_value="occupied")
            self.slice_of = gui.add_dropdown("slice", ("none", *SLICE_LEGENDS), initial_value="none")
            bottom, top = float(low[2].round(3)), float(high[2].round(3))
            self.slice_at = gui.add_slider("height (m)", bottom, top, 0.005, round(table_m + 0.02, 3))
            self._slice_legend = gui.add_html("")
        pitch = float(np.prod(high - low) / UNKNOWN_CELLS) ** (1 / 3)
        axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
        x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        unknown = map.query(x.reshape(-1, 3)).unknown.reshape(x.shape[:3])
        if unknown.any() and not unknown.all():
            vertices, faces, _, _ = marching_cubes(unknown.astype(np.float32), 0.5)
            in_base, style = low + pitch * (vertices + 0.5), {"opacity": 0.25, "side": "double"}
            scene.add_mesh_simple("/unknown", in_base, faces, visible=False, color=UNSEEN_RGB, **style)
        size, turned = (high - low)[:2].tolist(), (0.0, 1.0, 0.0, 0.0)
        empty = np.zeros((2, 2, 4), np.uint8)
        self._slice = scene.add_image("/slice", empty, *size, wxyz=turned, visible=False)
        with gui.add_folder("Sphere to drag", expand_by_default=False):
            self.radius = gui.add_slider("radius (mm)", 5.0, 150.0, 5.0, 30.0)
            self.answer = gui.add_html("")
        at = np.array([*_middle(self._solid)[:2], table_m + 0.15])
        self.gizmo = scene.add_transform_controls("/sphere", scale=0.12, disable_rotations=True, position=at)
        self.ball = scene.add_icosphere("/sphere/ball", 0.03, FREE, opacity=0.75)
        for control in (self.slice_of, self.slice_at, self.unknown):
            control.on_update(lambda _: self.show_slice())
        for control in (self.gizmo, self.radius, self.unknown):
            control.on_update(lambda _: self.move_sphere())
        self.move_sphere()

    def choose_image(self) -> None:
        """Show the residuals of the selected image, mark its camera, and move the robot to its joint values."""
        with self._lock:
            row = self.image.value
            image = self.calibration.images[row]
            state = "used" if image.used else f"rejected: {image.reason}"
            numbers = image_numbers(image)
            about = f"{state}, residuals {numbers}" if numbers else state
            self._about_image.content = _lines((image.image, about))
            for own, frustum in zip(self.image_index.tolist(), self.frusta, strict=True):
                used = self.calibration.images[own].used
                frustum.color = CHOSEN if own == row else CAMERA if used else REJECTED
            if self.robot is not None:
                self.robot.update_cfg(self._configurations[row])

    def look_from(self, camera: int, client: viser.ClientHandle | None) -> None:
        """Select the image of a registered camera, and move the view of a client (browser) to the pose of this camera.

        `camera` is its index among the registered images. If `client` is None, the image is only selected.
        """
        self.image.value = int(self.image_index[camera])
        if client is None:
            return
        pose = self.base_from_camera[camera]
        with client.atomic():
            client.camera.wxyz, client.camera.position = SO3.from_matrix(pose[:3, :3]).wxyz, pose[:3, 3]
            client.camera.fov = self._fov

    def show_points(self) -> None:
        """Draw the selected points (surface of the map, measured cloud, or none) and, if switched on, the features."""
        with self._lock:
            name, nothing = self.shown.value, track_layer("", np.zeros((0, 3)))
            layer = self._layers.get(name, nothing)
            legend = render("labels.html", {"labels": self._labels}, "jcr.viewer") if name == BY_LABEL else ""
            self.points, self._legend.content = layer[1], legend
            tracks = track_layer("", self.tracks_in_base) if self.show_tracks.value else nothing
            draw = partial(self.server.scene.add_point_cloud, point_shape="circle", precision="float32")
            for path, (_, x, color, size) in {"/points": layer, "/tracks": tracks}.items():
                if len(x):
                    draw(path, x, color, point_size=size, point_shading="flat")
                else:
                    self.server.scene.remove_by_name(path)

    def show_slice(self) -> None:
        """Draw the horizontal slice of the map with the selected property and height (base z), or hide it.

        Columns of the image follow the x axis of the base; rows follow y from the largest value to the smallest.
        """
        assert self.scene is not None  # the control exists only with a map
        with self._lock:
            of, height = self.slice_of.value, self.slice_at.value
            self._slice.visible = of != "none"
            self._slice_legend.content = _lines(("", SLICE_LEGENDS.get(of, "")))
            if of == "none":
                return
            low, high = self.scene.box
            pitch = float((high - low)[:2].max() / SLICE_PIXELS)
            a, b = (np.arange(low[k] + pitch / 2, high[k], pitch) for k in (0, 1))
            x = np.stack([*np.meshgrid(a, b[::-1]), np.full((len(b), len(a)), height)], -1).reshape(-1, 3)
            at, rgba = self.scene.query(x, self.unknown.value), np.zeros((len(x), 4), np.uint8)
            if of == "occupancy":
                rgba[:, :3], rgba[:, 3] = OCCUPIED, 255 * (0.1 + 0.9 * at.occupancy.clip(0, 1))
                rgba[at.unknown] = (*UNSEEN_RGB, 160)
            else:
                known = np.isfinite(at.distance)
                share = (255 * (1 - (at.distance[known] / FAR_M).clip(0, 1))).astype(np.uint8)
                rgba[known, :3] = cv2.applyColorMap(share[:, None], cv2.COLORMAP_PLASMA)[:, 0, ::-1]
                rgba[known, 3] = 217
                rgba[known & (at.distance <= 0)] = (200, 30, 30, 230)
            self._slice.image = rgba.reshape(len(b), len(a), 4)
            self._slice.position = np.array([*self.scene.box[:, :2].mean(0), height])

    def move_sphere(self) -> None:
        """Test the sphere for a collision with the map; colour it red if there is one, and show distance and verdict."""
        assert self.scene is not None  # the sphere exists only with a map
        with self._lock:
            center, radius = np.asarray(self.gizmo.position, float)[None], self.radius.value / 1e3
            unknown: Unknown = self.unknown.value
            hit = bool(self.scene.check_spheres(center, radius, unknown)[0])
            at = self.scene.query(center, unknown)
            self.ball.radius, self.ball.color = radius, COLLIDES if hit else FREE
            distance, (x, y, z) = float(at.distance[0]), center[0]
            where = f"the nearest surface is {1e3 * distance:.0f} mm from its centre"
            where = "it is outside of the workspace" if np.isnan(distance) else where
            seen = "unseen space" if at.unknown[0] else "seen space"
            verdict = "collides" if hit else "free"
            self.answer.content = _lines(
                (verdict, f"with its centre at ({x:.3f}, {y:.3f}, {z:.3f}) m, in {seen}: {where}")
            )

    def click(self, origin_in_base: Value, direction: Value) -> str:
        """Show the values of the map and the nearest measured point where a click hits a drawn point; return the HTML.

        `origin_in_base` (m) is the origin of the click's ray, `direction` its unit vector in the base frame. The point
        nearest to the origin within CLICK_RAD of the ray is hit. Without such a point, the text says so.
        """
        with self._lock:
            along = (self.points - origin_in_base) @ direction
            aside = np.linalg.norm(self.points - origin_in_base - along[:, None] * direction, axis=1)
            near = np.flatnonzero((along > 0.02) & (aside < CLICK_RAD * along))
            self._mark.visible = len(near) > 0
            if len(near) == 0:
                self.clicked.content = _lines(("", "No point there."))
                return self.clicked.content
            self._mark.position = point = self.points[near[along[near].argmin()]]
            rows = [("x, y, z (m)", ", ".join(f"{value:.4f}" for value in point))]
            if self.scene is not None:
                at = self.scene.query(point[None])
                rgb = np.nan_to_num(255 * at.color[0]).round().astype(int)
                rows.append(("occupancy", f"{at.occupancy[0]:.2f}" + ", unknown" * bool(at.unknown[0])))
                rows.append(("distance", f"{1e3 * at.distance[0]:.1f} mm"))
                rows.append(("colour", f"rgb({', '.join(map(str, rgb))})"))
                rows.append(("label", self.scene.label_names[int(at.label[0])]))
            if (cloud := self.cloud) is not None and len(cloud.points_in_base):
                nearest = int(np.linalg.norm(cloud.points_in_base - point, axis=1).argmin())
                image = self.calibration.images[int(self.image_index[cloud.image[nearest]])].image
                rows.append(("measured point", f"from {image}, confidence {cloud.confidence[nearest]:.2g}"))
                if cloud.margin is not None and np.isfinite(cloud.margin[nearest]):
                    rows.append(("its margin (1 σ)", f"{1e3 * cloud.margin[nearest]:.2f} mm"))
            self.clicked.content = render("values.html", {"rows": rows}, "jcr.viewer")
            return self.clicked.content


def _lines(*lines: tuple[str, str]) -> str:
    """Return the HTML of lines of text, each with its strong beginning (may be empty) and the rest.

    viser shows HTML in the texts that it is given, also in Markdown; names of files and labels must stay text.
    """
    return render("lines.html", {"lines": lines}, "jcr.viewer")


def _middle(points: Float[ndarray, "n 3"]) -> Value:
    """Return the median of the n points along each axis, shape (3,); zeros if there are no points."""
    return np.median(points, axis=0) if len(points) else np.zeros(3)
