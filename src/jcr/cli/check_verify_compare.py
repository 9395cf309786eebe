"""Commands that test a capture or a calibration: check, verify, compare and touch."""

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from jcr.backends import ReconstructOptions
from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli.output import Output, VerboseOutput, numbers
from jcr.cli.run_calibrate_batch import camera_lines, run_options
from jcr.errors import InputError, count_of
from jcr.findings import joined, sentence, warnings_of
from jcr.number_format import labelled, significant
from jcr.pipeline.options import TOLERANCE
from jcr.progress import Progress, progress_bars
from jcr.records import Capture, PosePairs

if TYPE_CHECKING:
    from jcr.pipeline.check import Examination
    from jcr.pipeline.verify import Verification
    from jcr.pipeline.verify_history import Verified

MOST_POSES = 5
"""Number of poses that `jcr verify --check-poses` prints; more images than that add little."""


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Check a capture before a run: files, units, motion, pose convention, and the calibration that a run would make.

    The options are those of `jcr calibrate`. The exit status is 3 if the calibration is rejected or not as exact as
    needed, if another camera of the cell is rejected, or if --poses-only leaves the reading of the poses undecided; the
    message has the reason and the remedy.

    for example:
      jcr check captures/table
      jcr check captures/table --robot-noise 0.1 0.05
      jcr check captures/table --poses-only --json
      jcr check samples.yaml
      jcr check scan.mcap --base-frame base_link --gripper-frame tool0
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture, or another format (jcr docs captures)."""
    poses_only: bool = False
    """Check files, units and motion only; the images are not matched, and usual errors are assumed."""
    output: VerboseOutput = field(default_factory=VerboseOutput)
    calibrate: CalibrateOptions = field(default_factory=CalibrateOptions)
    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    read: ReadOptions = field(default_factory=ReadOptions)

    def main(self) -> int:
        """Check the capture and print the result; return the exit status, 0 for the verdict "accepted", else 3."""
        from jcr.capture.read import read_source
        from jcr.pipeline.check import check_capture

        # Frames of a recording are extracted to a temporary folder.
        with progress_bars() as progress, TemporaryDirectory(prefix="jcr-capture-") as scratch:
            capture = read_source(self.capture, self.read, into=scratch, progress=progress)
            found = check_capture(capture, not self.poses_only, run_options(self), progress=progress)
            self.output.result(_check_lines(self, found), _check_facts(found))
        rejected = (
            [] if found.cameras is None else [one for one in found.cameras.cameras if not one.converged]
        )
        return 0 if found.verdict == "accepted" and not rejected else 3


def arguments_of(*options: Any) -> list[str]:
    """Return the fields of option records that are not at their default as command-line arguments."""
    given = list[str]()
    for record in options:
        for option in fields(record):
            value = getattr(record, option.name)
            if value != option.default:
                values = value if isinstance(value, tuple) else () if value is True else (value,)
                given += [f"--{option.name.replace('_', '-')}", *map(str, values)]
    return given


def _check_lines(command: CheckCommand, found: "Examination") -> list[str]:
    """Return the lines to print: verdict, causes and remedies, accuracy unless rejected, cameras, next command."""
    from jcr.calibration.summary import (
        LEAST_ACTIONS,
        MOST_LINES,
        actions,
        corner_is_missed,
        details,
        left_out_lines,
        verdict_in_words,
    )

    capture, made = found.capture, found.calibration
    about = f"{count_of(len(capture), 'sample')} with the poses of gripper and camera, no images"
    if not isinstance(capture, PosePairs):
        size = "x".join(map(str, capture.image_size))
        intrinsics = "given" if capture.intrinsics is not None else "unknown, to be estimated"
        about = f"{count_of(len(capture), 'image')} of {size}, intrinsics {intrinsics}"
    is_rejected, closing = found.verdict == "rejected", "jcr docs troubleshooting"
    undecided = isinstance(capture, Capture) and bool(capture.candidates)
    outcome, required = "good to calibrate", command.calibrate.require
    bad = [] if found.cameras is None else [one.name for one in found.cameras.cameras if not one.converged]
    if is_rejected:
        outcome = "a calibration would be rejected"
    elif bad and isinstance(capture, Capture):
        outcome = f"{capture.camera_name} is good to calibrate, but {joined(bad)} would be rejected"
    elif found.verdict != "accepted" and required != "none":
        outcome = f"a calibration would not reach {required[0]:g} mm and {required[1]:g}°"
    elif made is not None and corner_is_missed(made):
        outcome += ", but the corners of the image would miss the required accuracy"
    elif made is None:
        outcome += " by the motion alone; whether the poses are those of the images was not checked"
    verdict = verdict_in_words(found.findings)
    if undecided and not is_rejected:
        verdict, outcome = "NOT DECIDED", "neither names nor options say how the poses are written"
    lines = [f"{verdict}: {outcome}. {about}"]
    lines += _reading_lines(command, capture)
    if is_rejected and isinstance(capture, Capture):
        closing = _command_of_remedy(command, found) or closing
    if not is_rejected:
        lines += [] if undecided else _motion_lines(found)
        path = command.capture
        out = f"out/{path.stem if path.is_file() else path.resolve().name}"
        name = "run" if isinstance(capture, Capture) else "calibrate"
        options = arguments_of(command.read, command.calibrate, command.reconstruct)
        closing = shlex.join(["jcr", name, str(path), out, *options])
    if made is not None:
        lines += left_out_lines(made)
    lines += camera_lines(found.cameras)
    notes = [line for note in found.notes for line in labelled("Note", note)]
    acting = actions(found.findings, max(MOST_LINES - len(lines) - 1, LEAST_ACTIONS))
    if command.output.verbose:
        acting += (
            [f"{one.severity}: {sentence(one)}" for one in found.findings] if made is None else details(made)
        )
    else:
        notes = notes[: max(MOST_LINES - len(lines) - len(acting) - 1, 0)]
    lines += [*acting, *notes]
    return [*lines, *labelled("Next", closing)]


def _reading_lines(command: CheckCommand, capture: Capture | PosePairs) -> list[str]:
    """Return the lines on how the poses were read, and on the board of a fixed camera."""
    from jcr.capture.readings import decision_in_words

    lines = list[str]()
    if isinstance(capture, PosePairs):
        return lines
    if capture.candidates:
        readings = f"{len(capture.candidates)} readings of {capture.source} are possible; the images decide"
        lines += labelled("Poses", readings, "leave out --poses-only or name the reading (--pose-convention)")
    elif capture.reading is not None:
        lines += labelled("Poses", decision_in_words(capture.reading))
    if capture.mount == "base" and command.reconstruct.board is None:
        lines += labelled(
            "Board", "none was looked for; if the gripper holds one: --board (jcr docs cameras)"
        )
    return lines


def _command_of_remedy(command: CheckCommand, found: "Examination") -> str:
    """Return the command that checks a file with the options that its cause names; empty if it names none."""
    cause = found.findings[0].details
    changes: dict[str, Any] = {"pose_inverted": True} if "pose_inverted" in cause else {}
    capture = found.capture
    if isinstance(capture, Capture) and capture.reading is not None:  # a capture.json has one convention
        changes |= {name: cause[name] for name in cause.keys() & {"pose_convention"}}
    options = arguments_of(replace(command.read, **changes))
    return shlex.join(["jcr", "check", str(command.capture), *options]) if changes else ""


def _motion_lines(found: "Examination") -> list[str]:
    """Return the lines on the motion, the expected accuracy, and the agreement of poses and images."""
    from jcr.calibration.record import Calibration
    from jcr.calibration.summary import accuracy_in_words, corner_in_words

    rotation = np.degrees(found.largest_rotation_rad)
    motion = f"up to {1e3 * found.largest_move_m:.0f} mm and {rotation:.0f}° between two poses"
    lines, made = labelled("Motion", motion), found.calibration
    if found.expected is not None and found.expected.seen is not None:
        std = found.expected.std
        offset, turn = (
            " ".join(significant(float(value)) for value in part)
            for part in (1e3 * std[:3], np.degrees(std[3:6]))
        )
        errors = "assumed: the distance and usual errors" if made is None else "with the errors found in them"
        lines += labelled(
            "Expected",
            accuracy_in_words(found.expected),
            *filter(None, [made and corner_in_words(made)]),
            f"from {count_of(len(found.counted), 'image')}, {errors}",
            f"1σ of the transform: {offset} mm, {turn}°, scale {significant(100 * std[6])} %",
        )
    if isinstance(made, Calibration):
        noise = made.robot_noise
        agreement = f"{1e3 * noise.translation:.2f} mm, {np.degrees(noise.rotation):.3f}° per axis"
        lines += labelled("Agreement", f"poses and images: {agreement}, random errors alone")
    return lines


def _check_facts(found: "Examination") -> dict[str, Any]:
    """Return what `jcr check --json` prints: verdict, images, motion, expected accuracy, findings and notes."""
    from jcr.calibration.record import Calibration, as_json, mm_and_deg

    capture, made = found.capture, found.calibration
    reading = None if isinstance(capture, PosePairs) else capture.reading
    noise = made.robot_noise if isinstance(made, Calibration) else None
    seen = None if found.expected is None else found.expected.seen
    observed = ("observable", "unobservable", "advice")
    return {
        "verdict": found.verdict,
        "reading": reading and asdict(reading),
        "undecided": [] if isinstance(capture, PosePairs) else [asdict(one) for one, _ in capture.candidates],
        "images": capture.images,
        "largest_move_mm": 1e3 * found.largest_move_m,
        "largest_turn_deg": float(np.degrees(found.largest_rotation_rad)),
        "observability": {name: getattr(found.observability, name) for name in observed},
        "expected_std": None if found.expected is None else found.expected.std,
        "expected_seen": seen and asdict(seen),
        "expected_images": [capture.images[row] for row in found.counted],
        "robot_noise": None if noise is None else mm_and_deg(noise.translation, noise.rotation),
        "cameras": [] if found.cameras is None else found.cameras.as_json()["cameras"],
        "findings": [as_json(one) for one in found.findings],
        "warnings": warnings_of(found.findings),
        "notes": found.notes,
    }


@dataclass(frozen=True)
class CompareCommand:
    """Compare two calibrations: their difference in mm and degrees, and whether their covariances explain it.

    Each is a run folder, a calibration.json, a file of `jcr export` or easy_handeye, a document with a 4×4 matrix, or a
    JSON file (or its folder) with `gripper_from_camera` and, if its errors are known, `std_mm` and `std_deg`. --verbose
    adds χ², the squared difference in units of both covariances, and p, the probability of a larger one by chance. For
    two calibrations of one arm p is too large, because they share systematic errors. The exit status is 3 if one of the
    two is rejected, or if the reported errors do not explain the difference.

    for example:
      jcr compare out/tabletop examples/tabletop
      jcr compare out/today out/yesterday --json
    """

    out: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare."""
    reference: Annotated[Path, tyro.conf.Positional]
    """The calibration to compare it with."""
    output: VerboseOutput = field(default_factory=VerboseOutput)

    def main(self) -> int:
        """Print the difference of two calibrations, whether the reported errors explain it, and its possible causes."""
        from jcr.calibration.difference import compare
        from jcr.calibration.likely_cause import UNLIKELY

        paths, found = (self.out, self.reference), compare(self.out, self.reference)
        rejected = {str(path): doubt for path, doubt in zip(paths, found.doubts, strict=True) if doubt}
        mm, deg = 1e3 * found.translation_m, np.degrees(found.rotation_vector)
        facts: dict[str, object] = {
            "translation_mm": float(np.linalg.norm(mm)),
            "rotation_deg": float(np.linalg.norm(deg)),
            "translation_xyz_mm": mm,
            "likely_cause": found.likely_cause,
            "rejected": rejected,
        }
        offset, explained = f"{numbers(mm, 3)} mm (gripper axes)", "; neither file states its errors"
        is_contradiction = found.p_value is not None and found.p_value < UNLIKELY
        if found.sigmas is not None:
            facts |= {"sigmas": found.sigmas, "chi2": found.chi2, "p": found.p_value}
            facts["explained_by"] = found.explained_by
            offset += f"; at most {found.sigmas.max():.1f} of the reported standard deviations on any axis"
            explained = "; the reported errors explain it"
        remedy = []
        if is_contradiction:
            explained = "; more than the reported errors explain"
            remedy = [
                "check that both are transforms of the same camera and gripper frame",
                "then look for an error that one of the two does not state; if there is none, the camera moved",
            ]
        if found.likely_cause is not None:
            remedy = [f"compare first {found.likely_cause}", *remedy]
        verdict = "DIFFER" if is_contradiction else "NOT DECIDED" if found.p_value is None else "AGREE"
        if sum(found.has_errors) == 1:
            explained += f"; {paths[found.has_errors.index(False)]} states no errors"
        if rejected:  # what is rejected states nothing of the other
            verdict, explained = "NOT DECIDED", f"; {joined(list(rejected))} is rejected"
            remedy = ["remove the cause of the rejection, calibrate again, then compare"]
        apart = f"{facts['translation_mm']:.3f} mm, {facts['rotation_deg']:.4f}° apart"
        lines = [f"{verdict}: {apart}{explained}", *labelled("Remedy", *remedy)]
        lines += labelled("Difference", offset)
        shares = {name.replace("_", " "): 100 * share for name, share in found.explained_by.items()}
        causes = ", ".join(f"{name} {share:.0f} %" for name, share in shares.items() if share >= 0.5)
        if len(shares) > 1 and not is_contradiction and not rejected:
            lines += labelled("Causes", causes)
        if self.output.verbose and found.sigmas is not None:
            lines.append(f"χ² {found.chi2:.1f} of 6, p = {found.p_value:.2g}")
        lines += [line for path, why in rejected.items() for line in labelled("Rejected", f"{path}: {why}")]
        self.output.result(lines, facts)
        return 3 if is_contradiction or rejected else 0


@dataclass(frozen=True, kw_only=True)
class VerifyCommand:
    """Test with later captures whether the camera has moved on the gripper since its calibration.

    OUT is the run folder of the calibration; its capture must still be at its old path. CAPTURES are captures in any
    format, oldest first, or a folder of captures, with one or more new images of the same scene. Three to five images
    with a rotated wrist distinguish a moved camera from a moved table. Each capture is tested with those that were
    verified before (OUT/verify.json), with at most 0.1 false alarms per hundred captures; OUT/verify.html shows all.
    The fixed cameras that the last capture names in `cameras` are also tested. The exit status is 3 if something
    has moved, or if the images cannot decide.

    for example:
      jcr verify out/table captures/this-morning
      jcr verify out/table captures/november --tolerance 1 0.1 --json
      jcr verify out/table droid/ --episode 40 80 120
      jcr verify out/table --check-poses
      jcr verify out/table captures/other-table --new-scene
      jcr verify out/table captures/november --recalibrate out/table-2
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the run that calibrated the camera."""
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[CAPTURES...]")] = ()
    """The new images and their poses: capture folders, or another format (jcr docs captures)."""
    read: ReadOptions = field(default_factory=ReadOptions)
    tolerance: Annotated[tuple[float, float], tyro.conf.arg(metavar="MM DEG")] = TOLERANCE
    """Largest translation and rotation that raise no alarm, even if they are significant."""
    new_scene: bool = False
    """Calibrate the capture (8 images or more of another scene) alone, and compare it with the run."""
    recalibrate: Annotated[Path | None, tyro.conf.arg(metavar="NEW_OUT")] = None
    """Folder of a new run of old and new images if nothing has moved, otherwise of the images since the change. The exit
    status is that of the new calibration."""
    check_poses: bool = False
    """Print the gripper poses of the run at which new images are most useful, and the change that they would find."""
    output: VerboseOutput = field(default_factory=VerboseOutput)

    def main(self) -> int:
        """Print for each camera whether it has moved since the calibration, and the remedy; return the exit status."""
        from jcr.calibration.summary import summary
        from jcr.pipeline.recalibrate import recalibrate
        from jcr.pipeline.verify import verify_run
        from jcr.pipeline.verify_page import write_page

        if self.check_poses:
            return self._print_poses()
        if not self.captures:
            raise InputError("verify: no captures; name those with new images of the scene, or --check-poses")
        with progress_bars() as progress, TemporaryDirectory(prefix="jcr-capture-") as scratch:
            captures = read_captures(self.captures, self.read, Path(scratch), progress)
            if self.new_scene:
                return self._print_new_scene(captures, progress)
            found = verify_run(self.out, captures, self.tolerance, progress)
            lines, facts = verification_lines(found, self.output.verbose), found.as_json()
            rows = found.history[-len(captures) :]
            page = write_page(self.out, found, self.tolerance)
            lines += [*(_series(rows) if len(rows) > 1 else ()), *labelled("Page", str(page))]
            status = 3 if found.moved or any(one.moved for one in found.others) else 0
            if self.recalibrate is not None:
                result = recalibrate(self.out, captures, self.recalibrate, found, progress)
                facts |= {
                    "run": str(result.out),
                    "verdict_of_run": result.verdict,
                    "version": result.state.version,
                }
                lines += [*labelled("New run", f"{result.out}, version {result.state.version}"), ""]
                lines += summary(result.calibration).splitlines()
                status = 0 if result.verdict == "accepted" else 3
        self.output.result(lines, facts)
        return status

    def _print_new_scene(self, captures: dict[str, Capture], progress: Progress) -> int:
        """Print the comparison of the run with a calibration of another scene; return the exit status."""
        from jcr.pipeline.recalibrate import verify_by_new_scene

        if len(captures) > 1 or self.recalibrate is not None:
            raise InputError("--new-scene: takes one capture, and nothing is calibrated again with it")
        ((name, capture),) = captures.items()
        found = verify_by_new_scene(self.out, name, capture, self.tolerance, progress)
        self.output.result(verification_lines(found, self.output.verbose), found.as_json())
        return 3 if found.moved else 0

    def _print_poses(self) -> int:
        """Print the gripper poses of the run at which new images would tell most; return the exit status 0."""
        from scipy.spatial.transform import Rotation

        from jcr.pipeline.verify_history import telling_poses
        from jcr.result import load_run

        run, lines, facts = load_run(self.out), list[str](), list[dict[str, object]]()
        capture = run.capture
        for row, (metres, radians) in telling_poses(run, MOST_POSES):
            pose, image = capture.base_from_gripper[row], capture.images[row]
            quat_xyzw = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
            mm, deg = 1e3 * metres, float(np.degrees(radians))
            lines.append(f"{image:<20} {numbers([*pose[:3, 3], *quat_xyzw], 4)}   {mm:.2f} mm {deg:.3f}°")
            joints = None if capture.joints is None else capture.joints[row]
            lines += [] if joints is None else [f"{'':<20} joints (rad) {numbers(joints, 4)}"]
            facts.append({"image": image, "base_from_gripper": pose, "joints": joints})
            facts[-1] |= {"detectable_mm": mm, "detectable_deg": deg}
        head = (
            "take an image at these poses (m, quaternion xyzw). After each line, the images so far find 9 of 10 motions "
            "of the camera of the size at its end"
        )
        self.output.result([head, *lines], {"poses": facts})
        return 0


def read_captures(
    paths: Sequence[Path], read: ReadOptions, scratch: Path, progress: Progress
) -> dict[str, Capture]:
    """Return the captures at some paths by name, in their order: a folder of captures has one for each folder in it.

    A data set has a capture for each episode that `read` names. Images of recordings are extracted into `scratch`.
    """
    from jcr.capture.formats import lerobot
    from jcr.capture.read import read_capture

    captures = dict[str, Capture]()
    for path in paths:
        inside = sorted(file.parent for file in path.glob("*/capture.json")) if path.is_dir() else []
        for one in inside if inside and not (path / "capture.json").is_file() else [path]:
            for episode in (episodes := lerobot.episodes_of(one, read)[0]):
                into, own = scratch / str(len(captures)), replace(read, episode=(episode,))
                found = read_capture(one, own, into=into, progress=progress, at_least=1)
                name = (one.parent if one.name == "capture.json" else one).absolute().name
                name += f" episode {episode}" if len(episodes) > 1 else ""
                numbered = (name if k == 1 else f"{name} {k}" for k in range(1, len(captures) + 2))
                captures[next(name for name in numbered if name not in captures)] = found
    return captures


def verification_lines(found: "Verification", verbose: bool) -> list[str]:
    """Return the lines of `jcr verify`: verdict, remedy, drift with its σ, images and warnings of each camera.

    The verdict is on all captures of the history, drift and images are those of the capture that was verified last.
    """
    std = np.sqrt(np.diag(found.covariance))
    mm, mm_std = (1e3 * part[:3] for part in (found.offset, std))
    deg, deg_std = (np.degrees(part[3:]) for part in (found.offset, std))
    drift = f"{np.linalg.norm(mm):.2f} mm, {np.linalg.norm(deg):.3f}° from the calibration"
    moved = f"{numbers(mm, 2)} ± {numbers(mm_std, 2)} mm, {numbers(deg, 3)} ± {numbers(deg_std, 3)}°"
    verdict, warnings = "REJECTED" if found.moved else "ACCEPTED", len(found.notes)
    if warnings and not found.moved:
        verdict += f" with {count_of(warnings, 'warning')}"
    noticed = f"{1e3 * found.detectable[0]:.1f} mm or {np.degrees(found.detectable[1]):.2f}°"
    of, axes = (f"of {found.name}", "gripper") if found.fixed is None else ("", "base")
    lines = [
        f"{verdict}: {found.finding}" + ("" if found.moves else f", {drift}"),
        *(labelled("Remedy", found.advice) if found.moved else ()),
        *labelled("Drift", f"{moved} (1σ, {axes} axes) {of}".rstrip()),
        *labelled(
            "Images", f"{len(found.images)} {of}".rstrip() + f"; they find 9 of 10 changes of {noticed}"
        ),
        *(line for note in found.notes for line in labelled("WARNING", note)),
        *_history_lines(found),
        *([f"p = {found.p_value:.2g}"] if verbose else ()),
    ]
    return [*lines, *(line for one in found.others for line in verification_lines(one, verbose))]


def _history_lines(found: "Verification") -> list[str]:
    """Return the lines on a capture that was verified before a later one, and on how to go on after a change."""
    lines = list[str]()
    if found.history and (last := found.history[-1].name) != found.name:
        lines += labelled("Note", f"{found.name} was verified before {last}, and does not count again")
    if found.history and found.moved:
        repaired = "after a repair: calibrate again, or verify new images if the camera is back in its place"
        wrong = "after a wrong check, such as one with wrong poses: delete verify.json in the run folder"
        lines += labelled("Next", repaired, wrong)
    return lines


def _series(rows: Sequence["Verified"]) -> list[str]:
    """Return the table of captures: drift of camera and scene, the smallest change that is found, scene left."""
    width = max(len("capture"), *(len(row.name) for row in rows))
    lines = [f"{'capture':<{width}}  {'camera':>16}  {'scene':>16}  {'smallest found':>16}  scene left"]
    for row in rows:
        steps = (row.camera.step, row.scene.step)
        pairs = [(float(np.linalg.norm(one[:3])), float(np.linalg.norm(one[3:]))) for one in steps]
        cells = (f"{1e3 * m:.2f} mm {np.degrees(rad):.3f}°" for m, rad in (*pairs, row.detectable))
        left = "" if row.scene_left is None else f"{100 * row.scene_left:.0f} %"
        lines.append(f"{row.name:<{width}}  {'  '.join(f'{cell:>16}' for cell in cells)}  {left:>10}")
    return lines


@dataclass(frozen=True)
class TouchCommand:
    """Compare points that a calibrated tip touches with the map, to measure the error in task space.

    OUT is the folder of a run, POINTS a CSV with one line per point: image, x_px, y_px (the pixel of an image of the
    run that shows the point) and x_m, y_m, z_m (the tip in the base frame when it touches the point). report.html shows
    the pixel under the pointer in an image that is opened large, and a click copies it as image,x_px,y_px. Use three or
    more different points, spread over the scene: printed marks and textured places on flat surfaces. Pixels at the
    edges of objects often have no depth; their rows are left out. The exit status is 3 if the errors are larger than
    the reported uncertainty explains.

    for example:
      jcr touch out/table touched.csv
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder of a run."""
    points: Annotated[Path, tyro.conf.Positional]
    """The touched points, .csv."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Print the verdict, then the error at each touched point and its expected standard deviation."""
        from jcr.calibration.likely_cause import UNLIKELY
        from jcr.pipeline.touch import touch

        found = touch(self.out, self.points)
        is_larger, mean = found.p_value < UNLIKELY, 1e3 * found.common
        rms, expected = 1e3 * found.rms, 1e3 * found.expected
        verdict = "REJECTED: larger than" if is_larger else "ACCEPTED: within"
        lines = [f"{verdict} the reported uncertainty: {rms:.2f} mm (rms), {expected:.2f} mm expected"]
        if is_larger:
            remedy = (
                "check the calibration of the tip if the error is constant, then calibrate again (jcr run)"
            )
            lines += labelled("Remedy", remedy)
        lines += labelled("Mean", f"{numbers(mean, 2, '+')} mm")
        points = []
        for one, error, std in zip(found.touches, 1e3 * found.error, 1e3 * found.std, strict=True):
            points.append({"line": one.line, "image": one.image, "pixel": one.x_px})
            points[-1] |= {"error_mm": error, "std_mm": std}
            lines.append(f"{one}: {numbers(error, 2, '+')} mm (± {numbers(std, 2)})")
        lines += [line for note in found.notes for line in labelled("Note", note)]
        facts = {"rms_mm": rms, "expected_mm": expected, "p": found.p_value, "mean_mm": mean}
        self.output.result(lines, facts | {"points": points, "notes": found.notes})
        return 3 if is_larger else 0
