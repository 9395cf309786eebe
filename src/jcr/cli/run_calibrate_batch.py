"""Commands that calibrate: run, calibrate, batch and add-camera."""

import re
import shlex
import sys
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from jcr.backends import ReconstructOptions
from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import Output, VerboseOutput, write_lines
from jcr.depth.options import DepthOptions
from jcr.errors import InputError, RejectedError
from jcr.files import locked
from jcr.findings.finding import joined
from jcr.number_format import labelled, significant
from jcr.pipeline.options import BatchOptions
from jcr.progress import Progress, progress_bars
from jcr.records import Capture, PosePairs
from jcr.scene.options import CloudOptions, MapOptions
from jcr.segments.options import SegmentOptions

if TYPE_CHECKING:
    from jcr.cell.cameras_json import CamerasFile
    from jcr.result import RunOptions, RunResult


@dataclass(frozen=True, kw_only=True)
class CalibrateCommand:
    """Calibrate a capture without dense depth and map; write calibration.json, report.html and log.txt.

    CAPTURE may also be a samples file of easy_handeye2 or MoveIt Calibration, whose marker poses need no images.

    for example:
      jcr calibrate examples/tabletop out/tabletop
      jcr calibrate captures/table out/table --backend colmap --seed 1 --json
      jcr calibrate samples.yaml out/marker
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture, or another format (jcr docs captures)."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder for the results."""
    method: Literal["default", "paper"] = "default"
    """default; or paper, the published method without uncertainty and checks. paper takes the back ends dust3r, mast3r,
    predictions, or colmap as its baseline without the gripper poses."""
    output: VerboseOutput = field(default_factory=VerboseOutput)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)

    def main(self) -> int:
        """Calibrate and print the result; return the exit status of `show`."""
        from jcr.capture.read import read_source
        from jcr.pipeline.run import calibrate_poses, require_folder_of_results
        from jcr.result import CAPTURE

        require_folder_of_results(self.out)
        with progress_bars() as progress:
            with locked(self.out):
                capture = read_source(self.capture, self.read, into=self.out / CAPTURE, progress=progress)
            if isinstance(capture, PosePairs):
                result = calibrate_poses(capture, self.out, self.calibrate, self.method)
            else:
                result = _run(self, capture, run_options(self, map=None), progress)
        # While progress bars are drawn, rich would also wrap commands that are to be copied.
        if isinstance(capture, PosePairs):
            show_calibration(result, capture, self.output)
        return show(result, self.output)


@dataclass(frozen=True, kw_only=True)
class RunCommand(CalibrateCommand):
    """Reconstruct, calibrate, map and report a capture.

    CAPTURE is a folder with capture.json and images, or any format that `jcr docs captures` lists: images and a table
    of poses, bags, LeRobot data sets … The run writes calibration.json, reconstruction.npz, depth.npz,
    cloud.ply, map.safetensors, report.html and log.txt to OUT. The same command resumes an interrupted run.

    for example:
      jcr run examples/tabletop out/tabletop
      jcr run captures/table out/table --robot-noise 0.1 0.05 --json
      jcr run captures/ur5 out/ur5 --pose-convention ur
      jcr run captures/table out/table --no-map
      jcr run captures/table out/paper --method paper --backend colmap
      jcr run scan.mcap out/scan --base-frame base_link --gripper-frame tool0 --frames 12
    """

    depth: DepthOptions = field(default_factory=DepthOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)
    segment: SegmentOptions = field(default_factory=SegmentOptions)
    no_map: bool = False
    """Calibrate and write the report only, without dense depth, cloud and map; this needs no torch."""

    def main(self) -> int:
        """Run every stage, print the result and return the exit status of `show`."""
        from jcr.capture.read import read_capture
        from jcr.pipeline.run import require_folder_of_results
        from jcr.result import CAPTURE

        require_folder_of_results(self.out)
        options = run_options(self, map=None if self.no_map else self.map)
        with progress_bars() as progress:
            with locked(self.out):
                capture = read_capture(self.capture, self.read, into=self.out / CAPTURE, progress=progress)
            result = _run(self, capture, options, progress)
        lines = [note for note in result.calibration.notes if note.startswith("no map was made")]
        if not result.calibration.converged:
            lines = []
        elif (self.out / "map.safetensors").is_file():
            lines = [f"jcr view {shlex.quote(str(self.out))}"]
        elif self.no_map:
            lines = []
        return show(result, self.output, *labelled("Map", *lines))


@dataclass(frozen=True, kw_only=True)
class BatchCommand:
    """Run many captures, each into its own folder in OUT, and rank them in OUT/summary.csv and .html.

    A capture that fails does not stop the others. The same command again runs only missing or changed ones. The
    exit status is 3 if any capture failed, was rejected, or is not as exact as needed.

    for example:
      jcr batch captures/* out/all
      jcr batch captures/* out/all --processes 4 --calibrate-only
      jcr batch /shared/captures/* /shared/out --ray auto --gpus-per-task 0.25
      jcr batch droid/ out/episodes --calibrate-only --episode all
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURES... OUT")]
    """Folders of the captures, then the folder for the results."""
    method: Literal["default", "paper"] = "default"
    """default; or paper, the published method without uncertainty and checks. paper takes the back ends dust3r, mast3r,
    predictions, or colmap as its baseline without the gripper poses."""
    output: Output = field(default_factory=Output)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    batch: BatchOptions = field(default_factory=BatchOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    cloud: CloudOptions = field(default_factory=CloudOptions)
    map: MapOptions = field(default_factory=MapOptions)

    def main(self) -> int:
        """Run all captures and print a table; return 0, or raise RejectedError unless all are accepted."""
        from jcr.pipeline.batch import batch

        if len(self.paths) < 2:
            raise InputError("batch: name one capture or more, then the folder for the results")
        *captures, out = self.paths
        with progress_bars() as progress:
            rows = batch(captures, out, run_options(self), self.batch, progress, self.read)
        summary, lines = out / "summary.html", list[str]()
        for rank, row in enumerate(rows, start=1):
            accuracy, used = "", f"{row.used:3d}/{row.images:<3d}"
            if row.point_95_mm is not None and row.rotation_95_deg is not None:
                accuracy = f"{significant(row.point_95_mm)} mm, {significant(row.rotation_95_deg)}° (95 %)"
            line = f"{rank:3d}  {Path(row.out).name:<24} {row.status:<35} {used} {accuracy}  {row.reason}"
            lines.append(line.rstrip())
        self.output.result([*lines, f"table: {summary}"], {"captures": [asdict(row) for row in rows]})
        if doubtful := sum(not row.is_accepted for row in rows):
            why = "failed, are rejected, or are not as exact as needed"
            raise RejectedError(f"{doubtful} of {len(rows)} captures {why}; see {summary}")
        return 0


@dataclass(frozen=True, kw_only=True)
class AddCameraCommand:
    """Locate a fixed camera (base_from_camera) from its images of the scene of a run.

    OUT is the run folder; the capture of the run must still be at its old path. No marker is needed: the images are
    matched with those of the wrist camera. One image is enough. Without intrinsics the focal length is estimated, and
    the output says if the image does not determine it. The camera becomes part of the run (OUT/cameras.json, the
    report, `jcr export`). If it cannot be located, nothing is written and the exit status is 3.

    for example:
      jcr add-camera out/table overhead.png --intrinsics overhead.json
      jcr add-camera out/table left/0.png left/1.png --name left
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    images: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGES...")]
    """Images of one fixed camera, all of the same size."""
    name: str | None = None
    """Name of the camera; by default the file name of the first image."""
    intrinsics: Path | None = None
    """File with the intrinsics, as for --camera-info, in pixels of these images; by default they are estimated."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Locate the camera and print its pose in the base frame; return the exit status 0."""
        from jcr.cell.cameras_json import in_words
        from jcr.pipeline.run import add_camera

        if not self.images:
            raise InputError("add-camera: no images; name one or more images of the camera")
        name = self.name or re.sub(r"^[^A-Za-z]+|[^A-Za-z0-9_]+", "_", self.images[0].stem).strip("_")
        with progress_bars() as progress:
            result = add_camera(self.out, name or "camera", self.images, self.intrinsics, progress=progress)
        assert result.cameras is not None
        mine = result.cameras.model_copy(update={"cameras": result.cameras.cameras[-1:], "arms": []})
        self.output.result(in_words(mine), mine.as_json()["cameras"][0])
        return 0


def run_options(arguments: Any, **chosen: Any) -> "RunOptions":
    """Return the options of a run from the fields of a command with the same names; those in `chosen` replace them."""
    from jcr.result import RunOptions

    given = {f.name: getattr(arguments, f.name) for f in fields(RunOptions) if hasattr(arguments, f.name)}
    return RunOptions(**given | chosen)


def _run(
    command: CalibrateCommand, capture: Capture, options: "RunOptions", progress: Progress
) -> "RunResult":
    """Run all stages for a capture and return the result; print the calibration before depth and map are computed.

    If no back end found a reconstruction, the result's calibration.json contains the reason.
    """
    from jcr.pipeline.backend_selection import NothingFoundError
    from jcr.pipeline.run import run
    from jcr.result import load_run

    show_early = partial(show_calibration, capture=capture, output=command.output)
    try:
        result = run(capture, command.out, options, progress=progress, calibrated=show_early)
        if not result.is_unchanged:
            return result
        sys.stderr.write(f"unchanged: {command.out} is the run of this capture with these options\n")
    except NothingFoundError:
        result = load_run(command.out)
    show_early(result)
    return result


def show_calibration(result: "RunResult", capture: Capture | PosePairs, output: VerboseOutput) -> None:
    """Print the summary of a calibration and the capture's notes; nothing with --json, for which `show` prints all."""
    from jcr.calibration.summary import MOST_LINES, summary
    from jcr.capture.readings import decision_in_words

    if not output.json:
        others = 0 if result.cameras is None else len(result.cameras.cameras)
        most = MOST_LINES - others - 1  # one line is left to the caller
        lines = summary(result.calibration, most).splitlines()
        reading = None if isinstance(capture, PosePairs) else result.capture.reading
        if reading is not None:
            lines += labelled("Poses", decision_in_words(reading))
        notes = [line for note in capture.notes for line in labelled("Note", note)]
        lines += notes[: max(most - 2 - len(lines), 0)]
        write_lines(lines)


def show(result: "RunResult", output: VerboseOutput, *more: str) -> int:
    """Print the rest of a run's result; return the exit status.

    The status is 3 if the calibration is rejected or not as exact as needed, or a camera is rejected; else 0.

    Printed are other cameras, the lines `more`, the path of the report, the next command, and with --verbose the
    details. With --json the whole result is printed as one object.
    """
    from jcr.calibration.summary import details

    content, cameras, out = result.calibration, result.cameras, result.out
    placed = [] if cameras is None else cameras.cameras
    facts = content.as_json()
    if cameras is not None:
        facts |= {name: cameras.as_json()[name] for name in ("cameras", "arms")}
    following = "jcr docs troubleshooting"
    if content.converged:
        is_named = content.mount == "base" or content.frame_names.gripper is not None
        name = "" if is_named else " --parent-frame FRAME"
        # A driver often publishes the optical frame below a root link of the camera.
        about = (
            "" if is_named else "FRAME is the frame of your gripper poses, such as tool0 or flange; "
        ) + "for a driver: --to-root LINK"
        about = "if this accuracy is enough, else see Remedy; " * (content.short is not None) + about
        following = f"jcr export {shlex.quote(str(out))} ros2{name}  # {about}"
    lines = camera_lines(cameras)
    bad = [] if cameras is None else [camera.name for camera in cameras.rejected]
    if content.converged and bad:
        why = f"{joined(bad)} {'is' if len(bad) == 1 else 'are'} rejected"
        can = f"the calibration of {result.capture.camera_name} can be used"
        lines += labelled("Exit", f"status 3: {why}; {can}")
    lines += [*more, *labelled("Report", str(out / "report.html")), *labelled("Next", following)]
    if output.verbose:
        lines += ["", *details(content), *(line for camera in placed for line in camera.in_words)]
    output.result(lines, facts)
    is_reached = content.converged and content.short is None
    return 0 if is_reached and not bad else 3


def camera_lines(cameras: "CamerasFile | None") -> list[str]:
    """Return a line for each other camera of the cell: its verdict and uncertainty, or the reason of its rejection."""
    from jcr.calibration.summary import verdict_in_words

    lines = list[str]()
    for camera in () if cameras is None else cameras.cameras:
        about = f"REJECTED: {camera.doubt}"
        if camera.doubt is None and (found := camera.uncertainty) is not None:
            mm, deg = (significant(max(std)) for std in (found.translation_std_mm, found.rotation_std_deg))
            about = f"{verdict_in_words(camera.findings)}, {camera.mount}_from_camera ±{mm} mm, {deg}° (1σ, worst axis)"
        lines += labelled("Camera", f"{camera.name}: {about}")
    return lines
