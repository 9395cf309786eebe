"""Commands that use a run: map, export, query, measure and view."""

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import numpy as np
import tyro
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.options import ReadOptions
from jcr.cli.output import Output, numbers, warn
from jcr.errors import InputError, RejectedError, count_of
from jcr.export.options import ExportName, ExportOptions
from jcr.extras import extra
from jcr.files import write_text
from jcr.number_format import decimals_of
from jcr.progress import progress_bars
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.cell.cameras_json import CamerasFile

_CSV_COLUMNS = "x,y,z,occupancy,unknown,distance,gradient_x,gradient_y,gradient_z,red,green,blue,label,std"
PRINTED_POINTS = 10
"""Number of points whose answers are printed; those of all are in the file."""
_FORMATS = "%.6f,%.6f,%.6f,%.4f,%d,%.5f,%.4f,%.4f,%.4f,%d,%d,%d,%d,%.5f"


@dataclass(frozen=True, kw_only=True)
class MapCommand:
    """Build cloud, map and report of a run again, with other options or further images.

    for example:
      jcr map out/tabletop --preset paper
      jcr map out/tabletop --segments labels
      jcr map out/tabletop --workspace 0.2 -0.4 -0.05 0.9 0.4 0.6
      jcr map out/tabletop --add captures/later
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    add: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="CAPTURE")] = ()
    """A capture of new images, in any format; repeat the option for more, oldest first. The calibration does not change.
    Parts of the map that a new image sees through are removed. A new object needs two new images. Every later map of the
    run uses the images (OUT/added)."""
    read: ReadOptions = field(default_factory=ReadOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Build cloud, map and report of a run, and print what the map covers; raise RejectedError as `query` does."""
        from jcr.pipeline.run import build_map

        options = self.cloud, self.map, self.segment
        with progress_bars() as progress:
            result = build_map(self.out, *options, add=self.add, read=self.read, progress=progress)
        files = {"map": str(self.out / "map.safetensors"), "report": str(self.out / "report.html")}
        lines = [f"{name}: {file}" for name, file in files.items()]
        if (scene := result.scene) is not None:
            lower, upper = (numbers(corner, 2) for corner in scene.box)
            unseen = 100 * float((scene.seen.state == 0).double().mean())
            lines[0] += (
                f": from {lower} to {upper} m, {unseen:.0f} % of it unseen, cells of {1e3 * scene.cell:.1f} mm"
            )
        if len(result.added):
            lines.append(f"added: {count_of(len(result.added), 'image')} in this and earlier commands")
        self.output.result(lines, files)
        if (doubt := result.calibration.doubt) is not None:
            raise RejectedError(f"map rejected: {doubt}")
        return 0


@dataclass(frozen=True, kw_only=True)
class ExportCommand:
    """Write a run's calibration or map in another tool's format; without FORMAT, list the formats.

    Every file names its frames and units. Map, images and cameras are in the robot's base frame, in metres. A rejected
    calibration is exported only with --force; without it the exit status is 3.

    for example:
      jcr export out/table ros2 --parent-frame tool0 --child-frame camera_color_optical_frame
      jcr export out/scan urdf --to-root camera_link
      jcr export out/table octomap table.bt --voxel-size 0.02
      jcr export out/table nerfstudio splat/ --undistort
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    format: Annotated[
        ExportName | None,
        tyro.conf.Positional,
        tyro.conf.arg(help=f"{', '.join(get_args(ExportName))}; without it, all formats are listed."),
    ] = None
    path: Annotated[Path | None, tyro.conf.Positional] = None
    """File to write, or new folder for nerfstudio, colmap and depth; by default in OUT/export."""
    export: ExportOptions = field(default_factory=ExportOptions)
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Export the run and print the path of the file, or list the formats; raise RejectedError for a rejected run."""
        from jcr.export.formats import FORMATS, write_run
        from jcr.export.ros import static_transform_publisher

        if self.format is None:
            formats = {row.name: row.about for row in FORMATS}
            lines = [f"{name:<14} {about}" for name, about in formats.items()]
            self.output.result([*lines, f"choose one: jcr export {self.out} FORMAT"], {"formats": formats})
            return 0
        run, row, path = write_run(self.out, self.format, self.path, self.export)
        sys.stderr.write(f"wrote {path}: {row.about}\n")
        lines, facts = list[str](), {"file": str(path), "format": row.name, "about": row.about}
        if row.name == "ros2":
            facts["line"] = static_transform_publisher(run.mount)
            lines = [facts["line"]]
        pair = run.pair_in_words(row.contents)
        self.output.result(lines, facts | {"intrinsics": pair})
        for words in (pair, run.root_in_words()):
            if words is not None:
                sys.stderr.write(f"{words}\n")
        if "others" in row.contents.split() and run.camera is None and run.run.cameras is not None:
            _warn_of_rejected(run.run.cameras, self.export.force)
        if run.doubt is not None:
            warn(f"the calibration is rejected, and the file states the reason: {run.doubt}")
        elif (short := run.short_in_words) is not None:
            warn(short)
        return 0


def _warn_of_rejected(cameras: "CamerasFile", force: bool) -> None:
    """Print a warning for each rejected camera of a run: it is left out of the file, or with `force` it is in it."""
    for camera in cameras.rejected:
        where = "; it is left out, --force includes it"
        if camera.parent_from_camera is None:
            where = "; it has no pose and is left out"
        elif force:
            where = ", and the file contains it"
        warn(f"camera {camera.name} is rejected ({camera.doubt}){where}")


@dataclass(frozen=True, kw_only=True)
class QueryCommand:
    """Query the map of a run at points: occupancy, unknown, distance, its gradient, colour, label and std.

    Points are in metres, in the robot's base frame. Distances are NaN outside of the mapped workspace. std (m) is the
    standard deviation of the nearest surface along the gradient, by calibration and depth.

    for example:
      jcr query out/table points.csv
      jcr query out/table points.npy --write answers.csv
      jcr query out/table points.npy --unknown occupied --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, with its map.safetensors."""
    points: Annotated[Path, tyro.conf.Positional]
    """Points in a .csv file (three columns, header line optional) or .npy file of shape (n, 3)."""
    write: Path | None = None
    """File (.csv) to write; by default points.answers.csv in the folder of the points. --json prints the answers
    instead."""
    unknown: Literal["occupied", "free", "report"] = "report"
    """Treatment of unseen space as solid (occupied), empty (free), or of occupancy 0.5 (report)."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Query the map at every point, and write or print the answers in the order of the input.

        Raises RejectedError (status 3) after that if the calibration is rejected.
        """
        from jcr.result import load_run
        from jcr.scene.map_file import load_map

        scene = load_map(self.out)
        x_in_base = read_points(self.points)
        sample = scene.query(x_in_base, self.unknown)
        # Eight-bit colours, as in the point cloud; 0 outside of the workspace.
        colors = np.nan_to_num(sample.color * 255).round().astype(np.uint8).T
        columns = [*x_in_base.T, sample.occupancy, sample.unknown, sample.distance, *sample.gradient.T]
        columns += [*colors, sample.label, sample.std]
        count = np.bincount(sample.label, minlength=len(scene.label_names))
        labels = [f"{name} {n}" for name, n in zip(scene.label_names[1:], count[1:], strict=False) if n]
        unseen = f"{100 * float(np.mean(sample.unknown)):.0f} % of them unseen" if len(x_in_base) else "none"
        summary = f"points: {len(x_in_base)}, {unseen}{'; by label: ' * bool(labels)}{', '.join(labels)}"
        if len(x_in_base) and np.isnan(sample.distance).all():
            summary += "; all are outside of the mapped workspace: give metres in the robot's base frame"
        answers: dict[str, object] = {"label_names": list(scene.label_names)}
        if scene.uncertainty is not None:
            answers |= {"margin_95_m": scene.margin_95, "look_std_m": scene.uncertainty.look_std_m}
            summary += f"; surface within {1e3 * scene.margin_95:.1f} mm of the map on the free side (95 %)"
        if self.output.json:
            for name, column in zip(_CSV_COLUMNS.split(","), columns, strict=True):
                rounded = column.astype(float).round(6) if column.dtype.kind == "f" else column
                # JSON has no NaN.
                answers[name] = [None if value != value else value for value in rounded.tolist()]
        if self.write or not self.output.json:
            path = self.write or self.points.with_suffix(".answers.csv")
            if path.suffix != ".csv":
                raise InputError(f"{path}: answers are written as .csv")
            lines = (_FORMATS % row for row in zip(*(column.tolist() for column in columns), strict=True))
            write_text(path, "\n".join([_CSV_COLUMNS, *lines]) + "\n")
            summary = f"wrote {path}: {summary}"
        labels = [scene.label_names[k] if k else "no object" for k in sample.label]
        labels = ["unseen" if unseen else one for one, unseen in zip(labels, sample.unknown, strict=True)]
        values = (one.tolist() for one in (sample.distance, sample.std, sample.occupancy))
        few = islice(zip(x_in_base, *values, labels, strict=True), PRINTED_POINTS)
        lines = [summary, *(_answer(*one) for one in few)]
        self.output.result(lines, answers)
        if (doubt := load_run(self.out).calibration.doubt) is not None:
            raise RejectedError(f"answers rejected: {doubt}")
        return 0


def _answer(
    x_in_base: Float[ndarray, "3"],
    distance: float,
    std: float,
    occupancy: float,
    label: str,
) -> str:
    """Return the map's answer at one point on one line: distance with its standard deviation, occupancy, and label."""
    at = f"({numbers(x_in_base, 3)}) m"
    if np.isnan(distance):
        return f"{at}: outside of the mapped workspace"
    error = "" if np.isnan(std) else f" ± {1e3 * std:.1f}"
    return f"{at}: {1e3 * distance:.1f}{error} mm to the surface (1σ), occupancy {occupancy:.2f}, {label}"


def read_points(path: Path) -> Float[ndarray, "n 3"]:
    """Read points x, y, z (n,3) in metres, base frame, from .csv (three columns) or .npy (n,3).

    The names of a header line decide the order of the columns. Raises InputError for another file, for other names, and
    for a point that is not finite.
    """
    from jcr.capture.documents import read_tables
    from jcr.capture.readings import numbers_of_table

    if not path.is_file():
        raise InputError(f"{path}: no such file of points (.csv or .npy)")
    if path.suffix not in (".npy", ".csv"):
        raise InputError(f"{path}: points are read from .csv or .npy")
    tables = [table for table in read_tables(path) if len(table.columns) == 3 and not table.place]
    if not tables:
        raise InputError(f"{path}: expected three numbers x, y, z (m) in each row")
    points = numbers_of_table(tables[0])[:, _axes(path, tables[0].columns)]
    if not (finite := np.isfinite(points).all(1)).all():
        raise InputError(
            f"{path}: point {finite.argmin() + 1} is not three finite numbers; correct or remove it"
        )
    return points


def _axes(path: Path, names: Sequence[str | None]) -> list[int]:
    """Return the columns of x, y and z by the names of three columns; raise InputError for other names or units."""
    from jcr.capture.readings import UNITS, words_of

    if not any(names):
        return [0, 1, 2]
    words = [words_of(name or "") for name in names]
    stated = [next((word for word in own if word in ("x", "y", "z")), "") for own in words]
    units = {UNITS[word] for own in words for word in own if word in UNITS}
    if sorted(stated) != ["x", "y", "z"] or not units <= {"m"}:
        raise InputError(f"{path}: columns {', '.join(map(str, names))}; name them x, y, z and give metres")
    return [stated.index(axis) for axis in ("x", "y", "z")]


@dataclass(frozen=True)
class MeasureCommand:
    """Measure the support plane, and the height, footprint and box of each object on it, with standard deviations.

    OUT is the folder of a run. `jcr map --segments` selects how the scene is divided into objects.

    for example:
      jcr measure out/tabletop
      jcr measure out/tabletop --json > sizes.json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Print the sizes of the objects; raise RejectedError (status 3) if the calibration is rejected."""
        from jcr.pipeline.run import measure
        from jcr.result import load_run

        measured, lines = measure(self.out), list[str]()
        support, objects = measured.support, measured.objects
        x, y, z = support.base_from_support[:3, 2]
        lines.append(
            f"support plane through z = {support.base_from_support[2, 3]:.4f} m, normal {x:.4f} {y:.4f} {z:.4f}, "
            f"its points within {1e3 * support.noise:.1f} mm (1 σ)"
        )
        width = max([6, *(len(size.name) for size in objects)])
        titles = (f"{side + ' ± 1σ mm':>14}" for side in ("height", "length", "width"))
        columns = f"{'  '.join(titles)}  centre x, y (m)"
        lines.append(f"{'object':<{width}}  {columns}" if objects else "nothing stands on it")
        for size in objects:
            sides = zip(1e3 * size.box_size, 1e3 * size.box_std, strict=True)
            digits = [max(1, decimals_of(1e3 * std)) for std in size.box_std]
            length, across, height = (
                f"{value:.{n}f} ± {std:.{n}f}" for (value, std), n in zip(sides, digits, strict=True)
            )
            height = height if size.top_seen else f"≥ {1e3 * size.height:.1f}"
            x, y = size.base_from_box[:2, 3]
            lines.append(f"{size.name:<{width}}  {height:>14}  {length:>14}  {across:>14}  {x:.3f}, {y:.3f}")
        # Metres, base frame, one sigma; `on_plane` is left out because it has a value for each point of the cloud.
        plane = {name: value for name, value in vars(support).items() if name != "on_plane"}
        self.output.result(lines, {"support": plane, "objects": [vars(size) for size in objects]})
        if (doubt := load_run(self.out).calibration.doubt) is not None:
            raise RejectedError(f"sizes rejected: {doubt}")
        return 0


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """Show a run in the browser: points, cameras, grippers, robot, layers of the map, and a sphere to query it.

    The page is served until Ctrl-C, and only to this machine. From another one use ssh -L 8080:127.0.0.1:8080. The
    command needs viser: pip install 'jcr-handeye[view]'.

    for example:
      jcr view out/table
      jcr view out/table --urdf arm.urdf --port 9000
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    urdf: Path | None = None
    """Robot to show at the capture's joint angles of each image; by default that of the capture. Its root link is the
    base of the gripper poses."""
    port: int = 8080
    """Port of 127.0.0.1 to listen on; 0 selects a free one."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Show the run in the browser: serve its page until Ctrl-C; return the exit status 0."""
        from jcr.result import load_run

        run = load_run(self.out)  # raises an InputError at once if there is no run
        for package in ("viser", "torch"):
            extra(package, "view", "jcr view")
        from jcr.viewer.viewer import Viewer, open_server

        server = open_server(self.port, f"jcr · {self.out.resolve().name}")
        try:
            with progress_bars() as progress:
                Viewer(server, run, self.urdf, progress)
            address = f"http://127.0.0.1:{server.get_port()}"
            self.output.result([f"{address} (Ctrl-C ends it)"], {"address": address})
            threading.Event().wait()
        except KeyboardInterrupt:
            pass
        finally:
            server.stop()
        return 0
