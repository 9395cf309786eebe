"""The viewer: a run in 3D in the browser, with switches, a sphere to drag and values to click for."""

import threading
from typing import Any, get_args

import numpy as np
import viser
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation
from viser.extras import ViserUrdf

from jcr.geometry import apply
from jcr.progress import Progress, silent
from jcr.records import verdict_of
from jcr.records.words import reached_in_words, sentence
from jcr.report.raster import TRACK_COLOR, label_colors
from jcr.report.render import render
from jcr.scene.scene_map import Unknown
from jcr.viewer.layers import (
    LEAST,
    PACKAGE,
    SLICE_LEGENDS,
    MapPoints,
    SliceOf,
    colour_bar,
    level_slice,
    map_points,
    unknown_edge,
)
from jcr.viewer.run import ViewedRun

CAMERA, CHOSEN, REJECTED = (200, 110, 30), (37, 99, 235), (200, 50, 43)
FREE, COLLIDES = (40, 160, 90), (220, 40, 40)
CLOUD, MAP = "points as measured", "map"
REACH = 0.05
"""Metres from a drawn camera to its image plane."""
BEFORE = 0.1
"""Metres from a camera to the photograph that is laid over the map."""
CLICK = 0.006
"""Radians about a click's ray within which a point is meant."""
Value = Float[ndarray, "3"]


class Viewer:
    """A run shown by a viser server; its methods answer what the reader does, and may be called directly."""

    def __init__(
        self,
        server: viser.ViserServer,
        run: ViewedRun,
        robot: Any = None,
        joint_values: Float[ndarray, "n dof"] | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Fill the server; `robot` is a yourdfpy.URDF and `joint_values` a row for each of the run's grippers."""
        report = progress or silent
        self.server, self.run, self.scene, self._lock = server, run, run.scene, threading.Lock()
        self.joint_values = joint_values
        server.scene.set_up_direction("+z")
        server.gui.add_markdown(self._verdict())
        report("view", 0.1)
        self._add_capture()
        self.robot = None
        if robot is not None and joint_values is not None:
            server.scene.add_frame("/robot", show_axes=False)
            self.robot = ViserUrdf(server, robot, root_node_name="/robot")
        report("view", 0.3)
        self._add_points()
        if run.scene is not None:
            self._points = map_points(run.scene)
            self._palette = label_colors(len(run.scene.label_names))
            report("view", 0.6)
            self._add_map()
            report("view", 0.8)
            self._add_sphere()
            self.move_sphere()
        self._add_click()
        self.choose_image()
        self._place_eye()
        report("view", 1.0)

    def _verdict(self) -> str:
        calibration, held_out = self.run.calibration, self.run.calibration.held_out
        verdict, lines = verdict_of(calibration.findings).capitalize(), []
        if not calibration.converged:
            lines.append(f"**{verdict}:** {calibration.doubt}")
        elif (short := calibration.short) is not None:
            lines.append(f"**{verdict}:** {sentence(short)}")
        elif calibration.requirement is not None:
            lines.append(f"**{verdict}:** {reached_in_words(calibration.requirement)}")
        if calibration.converged and held_out is not None:
            lines.append(
                f"Leave-one-out error {held_out.translation_mm:.2f} mm, {held_out.rotation_deg:.3f}°; "
                f"{len(self.run.image)} cameras."
            )
        return "\n\n".join([*lines, *self.run.notes])

    def _add_capture(self) -> None:
        server, run, intrinsics = self.server, self.run, self.run.intrinsics
        server.scene.add_frame("/base", axes_length=0.1, axes_radius=0.003)
        server.scene.add_label("/base/name", "base")
        self._grid = server.scene.add_grid(
            "/grid",
            infinite_grid=True,
            cell_size=0.1,
            section_size=0.5,
            fade_distance=6.0,
            fade_from="origin",
        )
        self.frusta, self.grippers = [], []
        fov, aspect = (
            2 * float(np.arctan2(intrinsics.height / 2, intrinsics.fy)),
            intrinsics.width / intrinsics.height,
        )
        step = max(1, intrinsics.width // 160)
        for k, pose in enumerate(run.base_from_camera):
            frustum = server.scene.add_camera_frustum(
                f"/cameras/{k}",
                fov,
                aspect,
                scale=REACH,
                thickness=2.0,
                thickness_units="screen",
                image=run.pixels[k, ::step, ::step],
                wxyz=_wxyz(pose),
                position=pose[:3, 3],
            )
            frustum.on_click(lambda event, k=k: self.look_from(k, event.client))
            self.frusta.append(frustum)
        for k, pose in enumerate(run.base_from_gripper):
            at = {"wxyz": _wxyz(pose), "position": pose[:3, 3]}
            self.grippers.append(
                server.scene.add_frame(f"/grippers/{k}", axes_length=0.03, axes_radius=0.001, **at)
            )
        self._photo = server.scene.add_image("/photo", np.zeros((2, 2, 4), np.uint8), 0.1, 0.1, visible=False)
        with server.gui.add_folder("Capture"):
            self.image = server.gui.add_slider("image", 0, len(run.calibration.images) - 1, 1, 0)
            self._about_image = server.gui.add_markdown("")
            look = server.gui.add_button("look from this camera")
            self.photo = server.gui.add_slider("photograph", 0, 100, 5, 0, hint="laid over the map, %")
            self.show_cameras = server.gui.add_checkbox("cameras", True)
            self.show_grippers = server.gui.add_checkbox("grippers", True)
            self.show_grid = server.gui.add_checkbox("grid", True, hint="0.1 m, base z = 0")
            self.show_robot = server.gui.add_checkbox("robot", True, visible=self.joint_values is not None)
        self.image.on_update(lambda _: self.choose_image())
        for switch in (self.show_cameras, self.show_grippers, self.show_robot, self.show_grid, self.photo):
            switch.on_update(lambda _: self.choose_image())
        look.on_click(lambda event: self.look_from(self._camera_of_image(), event.client))

    def _add_points(self) -> None:
        names = (MAP, CLOUD, "none") if self.scene is not None else (CLOUD, "none")
        with self.server.gui.add_folder("Points"):
            self.shown = self.server.gui.add_dropdown("show", names, initial_value=names[0])
            self.show_tracks = self.server.gui.add_checkbox(
                "features", self.scene is None, hint="tracked, red"
            )
            self.size = self.server.gui.add_slider("size (mm)", 1.0, 15.0, 0.5, 5.0)
        for control in (self.shown, self.show_tracks, self.size):
            control.on_update(lambda _: self.show_points())
        if self.scene is None:
            self.show_points()

    def _add_map(self) -> None:
        assert self.scene is not None
        gui, (low, high) = self.server.gui, self.scene.box
        colors = ("color", "occupancy", "label")[: 3 if len(self.scene.label_names) > 1 else 2]
        with gui.add_folder("Map"):
            self.threshold = gui.add_slider("occupancy over", LEAST, 0.98, 0.02, 0.5)
            self.colored = gui.add_dropdown("coloured by", colors, initial_value="color")
            self._legend = gui.add_html("")
            self.show_unknown = gui.add_checkbox("unknown", False, hint="where sight ended")
            self.unknown = gui.add_dropdown("unknown is", ("occupied", "free"), initial_value="occupied")
            self.slice_of = gui.add_dropdown("slice", ("none", *get_args(SliceOf)), initial_value="none")
            self._slice_legend = gui.add_html("")
            bottom, top = float(low[2].round(3)), float(high[2].round(3))
            self.slice_at = gui.add_slider(
                "slice at z (m)", bottom, top, 0.005, round(self._support() + 0.02, 3)
            )
        vertices, faces = unknown_edge(self.scene)
        self._unknown = None
        if len(faces):
            self._unknown = self.server.scene.add_mesh_simple(
                "/unknown", vertices, faces, color=(130, 130, 130), opacity=0.3, side="double", visible=False
            )
        for control in (self.threshold, self.colored):
            control.on_update(lambda _: self.show_points())
        # Shown once somebody asks for it.
        self._slice = self.server.scene.add_image(
            "/slice",
            np.zeros((2, 2, 4), np.uint8),
            float(high[0] - low[0]),
            float(high[1] - low[1]),
            # viser's images have y downwards, as the base seen from above has it upwards.
            wxyz=(0.0, 1.0, 0.0, 0.0),
            visible=False,
        )
        for control in (self.slice_of, self.slice_at, self.show_unknown, self.unknown):
            control.on_update(lambda _: self.show_slice())
        self.show_points()

    def _add_sphere(self) -> None:
        assert self.scene is not None
        gui = self.server.gui
        with gui.add_folder("Sphere to drag"):
            self.show_sphere = gui.add_checkbox("sphere", True)
            self.radius = gui.add_slider("radius (mm)", 5.0, 150.0, 5.0, 30.0)
            self.answer = gui.add_markdown("")
        start = [*np.median(self._solid(), axis=0)[:2], self._support() + 0.15]
        self.gizmo = self.server.scene.add_transform_controls(
            "/sphere", scale=0.12, disable_rotations=True, position=np.array(start)
        )
        self.gizmo.on_update(lambda _: self.move_sphere())
        for control in (self.show_sphere, self.radius, self.unknown):
            control.on_update(lambda _: self.move_sphere())
        self.ball = self.server.scene.add_icosphere("/sphere/ball", 0.03, FREE, opacity=0.75)

    def _add_click(self) -> None:
        with self.server.gui.add_folder("Click a point"):
            self.clicked = self.server.gui.add_markdown("Click a point to see its values.")
        self._mark = self.server.scene.add_icosphere("/clicked", 0.004, (255, 220, 0), visible=False)

        @self.server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            self.click(np.array(event.ray_origin), np.array(event.ray_direction))

    def choose_image(self) -> None:
        """Tell about the chosen image, mark its camera and put the robot at its pose."""
        with self._lock:
            row = self.image.value
            image, camera = self.run.calibration.images[row], self._camera_of_image()
            parts = [f"**{image.image}**", "used" if image.used else f"rejected: {image.reason}"]
            if image.translation_residual_mm is not None and image.rotation_residual_deg is not None:
                residual = f"{image.translation_residual_mm:.2f} mm, {image.rotation_residual_deg:.3f}°"
                parts.append(f"residual {residual}")
            self._about_image.content = " · ".join(parts)
            for k, frustum in enumerate(self.frusta):
                used = self.run.calibration.images[int(self.run.image[k])].used
                frustum.color = CHOSEN if k == camera else CAMERA if used else REJECTED
                frustum.visible = self.show_cameras.value
            for gripper in self.grippers:
                gripper.visible = self.show_grippers.value
            self._grid.visible = self.show_grid.value
            self._show_photo(camera)
            if self.robot is not None and self.joint_values is not None:
                self.robot.show_visual = self.show_robot.value
                pose = np.flatnonzero(self.run.gripper_image == row)
                if len(pose):
                    self.robot.update_cfg(self.joint_values[pose[0]])

    def _show_photo(self, camera: int | None) -> None:
        """The chosen camera's photograph before it, so that from there it lies over the map."""
        share = self.photo.value / 100
        self._photo.visible = camera is not None and share > 0
        if camera is None or share == 0:
            return
        intrinsics, pose = self.run.intrinsics, self.run.base_from_camera[camera]
        for frustum in self.frusta:  # theirs would lie before it
            frustum.visible = False
        opaque = np.full((*self.run.pixels.shape[1:3], 1), round(255 * share), np.uint8)
        self._photo.image = np.concatenate([self.run.pixels[camera], opaque], axis=-1)
        size, focal = (
            np.array([intrinsics.width, intrinsics.height]),
            np.array([intrinsics.fx, intrinsics.fy]),
        )
        middle = ((size - 1) / 2 - [intrinsics.cx, intrinsics.cy]) / focal
        self._photo.render_width, self._photo.render_height = (BEFORE * size / focal).tolist()
        self._photo.wxyz = _wxyz(pose)
        self._photo.position = apply(pose, BEFORE * np.array([*middle, 1.0]))

    def look_from(self, camera: int | None, client: viser.ClientHandle | None) -> None:
        """Bring a reader's eye to a registered camera and choose its image; None does nothing."""
        if camera is None:
            return
        self.image.value = int(self.run.image[camera])
        if client is None:
            return
        pose = self.run.base_from_camera[camera]
        with client.atomic():
            client.camera.wxyz, client.camera.position = _wxyz(pose), pose[:3, 3]
            client.camera.fov = 2 * float(np.arctan2(self.run.intrinsics.height / 2, self.run.intrinsics.fy))

    def show_points(self) -> None:
        """Draw the points that are asked for: the cloud, or those of the map over the threshold."""
        with self._lock:
            x, color = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
            if self.shown.value == CLOUD:
                x, color = self.run.cloud.points_in_base, self.run.cloud.color
            elif self.shown.value == MAP:
                chosen = self._points.occupancy >= self.threshold.value
                x, color = self._points.points_in_base[chosen], self._map_colors(self._points)[chosen]
                self._legend.content = self._labels()
            self.points = x
            self._draw("/points", x, color, self.size.value / 1e3)
            tracks = self.run.tracks_in_base if self.show_tracks.value else np.zeros((0, 3))
            self._draw("/tracks", tracks, np.tile(np.array(TRACK_COLOR, np.uint8), (len(tracks), 1)), 0.004)

    def _draw(self, name: str, x: Float[ndarray, "n 3"], color: UInt8[ndarray, "n 3"], size: float) -> None:
        if len(x) == 0:
            self.server.scene.remove_by_name(name)
            return
        self.server.scene.add_point_cloud(
            name, x, color, point_size=size, point_shape="circle", point_shading="flat", precision="float32"
        )

    def _map_colors(self, points: MapPoints) -> UInt8[ndarray, "n 3"]:
        if self.colored.value == "label":
            return self._palette[points.label]
        if self.colored.value == "occupancy":
            return _by_occupancy(points.occupancy[:, None])
        return points.color

    def _labels(self) -> str:
        if self.scene is None or self.colored.value == "color":
            return ""
        if self.colored.value == "occupancy":
            return colour_bar(
                [_by_occupancy(np.array([share])).tolist() for share in (0.0, 0.5, 1.0)], "occupancy 0", "1"
            )
        labels = zip(self.scene.label_names, self._palette.tolist(), strict=True)
        return render("labels.html", {"labels": list(labels)}, PACKAGE)

    def show_slice(self) -> None:
        """Draw the slice that is asked for, and the edge of the unknown."""
        assert self.scene is not None  # or there would be no such control
        with self._lock:
            if self._unknown is not None:
                self._unknown.visible = self.show_unknown.value
            of, height = self.slice_of.value, self.slice_at.value
            self._slice.visible = of != "none"
            self._slice_legend.content = SLICE_LEGENDS.get(of, "")
            if of == "none":
                return
            self._slice.image = level_slice(self.scene, height, of, self.unknown.value)
            self._slice.position = np.array([*self.scene.box[:, :2].mean(0), height])

    def move_sphere(self) -> None:
        """Query the map whether the sphere touches something; it becomes red where it does."""
        assert self.scene is not None  # or there would be no sphere
        with self._lock:
            center, radius = np.asarray(self.gizmo.position, float)[None], self.radius.value / 1e3
            unknown: Unknown = self.unknown.value
            hit = bool(self.scene.check_spheres(center, radius, unknown)[0])
            at = self.scene.query(center, unknown)
            self.ball.radius, self.ball.color = radius, COLLIDES if hit else FREE
            self.ball.visible = self.gizmo.visible = self.show_sphere.value
            x, y, z = center[0]
            distance = float(at.distance[0])
            beyond = (
                "outside of the workspace" if np.isnan(distance) else f"surface {1e3 * distance:.0f} mm away"
            )
            seen = "nobody has looked here" if at.unknown[0] else "seen"
            verdict = "collides" if hit else "free"
            self.answer.content = f"**{verdict}** at ({x:.3f}, {y:.3f}, {z:.3f}) m: centre {beyond}, {seen}"

    def click(self, origin_in_base: Value, direction: Value) -> str:
        """Tell what is known of the first drawn point along a ray from the eye; the text that is shown."""
        with self._lock:
            x = self.points
            along = (x - origin_in_base) @ direction
            aside = np.linalg.norm(x - origin_in_base - along[:, None] * direction, axis=1)
            near = np.flatnonzero((along > 0.02) & (aside < np.maximum(CLICK * along, self.size.value / 2e3)))
            self._mark.visible = len(near) > 0
            if len(near) == 0:
                self.clicked.content = "No point there."
                return self.clicked.content
            point = x[near[along[near].argmin()]]
            self._mark.position = point
            self.clicked.content = self._values(point)
            return self.clicked.content

    def _values(self, point: Value) -> str:
        rows = [("x, y, z (m)", ", ".join(f"{value:.4f}" for value in point))]
        cloud = self.run.cloud
        if self.scene is not None:
            at = self.scene.query(point[None])
            rows.append(("occupancy", f"{at.occupancy[0]:.2f}" + ", unknown" * bool(at.unknown[0])))
            rows.append(("distance", f"{1e3 * at.distance[0]:.1f} mm"))
            rgb = np.nan_to_num(255 * at.color[0]).round().astype(int)
            rows.append(("colour", f"rgb({', '.join(map(str, rgb))})"))
            rows.append(("label", self.scene.label_names[int(at.label[0])]))
        if len(cloud.points_in_base):
            nearest = int(np.linalg.norm(cloud.points_in_base - point, axis=1).argmin())
            image = self.run.calibration.images[int(self.run.image[cloud.image[nearest]])].image
            rows.append(
                ("nearest measured point", f"from {image}, confidence {cloud.confidence[nearest]:.2g}")
            )
            if np.isfinite(cloud.margin[nearest]):
                rows.append(("its margin (1 σ)", f"{1e3 * cloud.margin[nearest]:.2f} mm"))
        return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)

    def _camera_of_image(self) -> int | None:
        """Row of the chosen image among the registered cameras; None where it is none of them."""
        rows = np.flatnonzero(self.run.image == self.image.value)
        return int(rows[0]) if len(rows) else None

    def _solid(self) -> Float[ndarray, "n 3"]:
        """Points of the map's surfaces, or of the cloud; the origin where there are none."""
        points = self.run.cloud.points_in_base
        if self.scene is not None:
            points = self._points.points_in_base[self._points.occupancy >= 0.5]
        return points if len(points) else np.zeros((1, 3))

    def _support(self) -> float:
        """Height (m) at which the map has most surface, kept inside the workspace."""
        assert self.scene is not None
        counts, edges = np.histogram(self._solid()[:, 2], bins=100)
        low, high = self.scene.box[:, 2]
        return float(np.clip(edges[counts.argmax()], low, high - 0.02))

    def _place_eye(self) -> None:
        """Where a reader starts: obliquely above, with points and cameras in the image."""
        target = np.median(self._solid(), axis=0)
        cameras = self.run.base_from_camera[:, :3, 3]
        reach = max(0.3, float(np.linalg.norm(cameras - target, axis=1).max(initial=0.0)))
        eye = target + 1.6 * reach * np.array([0.62, -0.62, 0.6])
        self.server.initial_camera.position, self.server.initial_camera.look_at = eye, target


def _by_occupancy(share: Float[ndarray, "*n 1"]) -> UInt8[ndarray, "*n 3"]:
    return (share * np.array([37, 99, 235]) + (1 - share) * np.array([215, 220, 230])).astype(np.uint8)


def _wxyz(a_from_b: Float[ndarray, "4 4"]) -> Float[ndarray, "4"]:
    return Rotation.from_matrix(a_from_b[:3, :3]).as_quat()[[3, 0, 1, 2]]
