"""Stages on a run folder: each starts from the files of those before it, and adds its own and its time."""

import time
from collections.abc import Sequence
from dataclasses import replace

from jcr import __version__
from jcr.allocator import give_back
from jcr.boards.proposal import proposed_for
from jcr.calibration.record import calibration_of, failed_calibration
from jcr.capture.added import write_added
from jcr.cell.added import read_added_cameras
from jcr.cell.carried import carried_scene, refined
from jcr.cell.placement import CamerasFile
from jcr.depth.densify import densify
from jcr.findings import sentence
from jcr.pipeline.selection import NothingFoundError, Selection, again, choose, timings_of
from jcr.progress import Progress
from jcr.records import Attempt, Capture, CellCamera
from jcr.results import RunOptions, RunResult
from jcr.run_folder import MOVING, RunFolder, State, state_of


def calibrated(capture: Capture, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """Calibrate the reconstruction that the folder has of the same input; without one, try back ends.

    Where the camera watches the gripper, what the gripper carries is the scene.
    """
    watches = capture.mount == "base"
    seen = carried_scene(capture, folder.path / MOVING) if watches else capture
    state = state_of(seen, options.made_with).model_copy(update={"capture": str(capture.folder.resolve())})
    # The arm's kinematics are those of the reported poses, and not of their inverses.
    own = replace(options, calibrate=replace(options.calibrate, robot=None)) if watches else options
    try:
        selected, attempts = _reused(seen, folder, own, state, progress) or _chosen(
            seen, folder, own, state, progress
        )
    except NothingFoundError as error:
        raise _failed(capture, folder, options, state, error) from None
    state = state.model_copy(update={"attempts": attempts})
    folder.keep_state(state)
    folder.keep_depth(selected.reconstruction, state)
    hand_eye = selected.hand_eye
    if watches:
        hand_eye = refined(capture, selected.reconstruction, hand_eye, options.calibrate)
    content = calibration_of(
        capture, selected.reconstruction, hand_eye, timings_of(selected.attempts), __version__, attempts
    )
    if content.verdict == "rejected" or content.short is not None:
        board = proposed_for(capture, options.reconstruct.board)
        content = content if board is None else content.with_findings(board)
    folder.keep_calibration(content)
    return RunResult(
        out=folder.path,
        capture=capture,
        calibration=content,
        hand_eye=hand_eye,
        reconstruction=selected.reconstruction,
    )


def located(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """Return the result with the other cameras of the cell, those of the capture and those added to the run."""
    start = time.perf_counter()
    found = cameras(result, read_added_cameras(folder.path, result.capture), folder, options, progress)
    folder.keep_cameras(found)
    if found is None:
        return result
    result = replace(result, cameras=found).timed("cameras", start)
    folder.amend_calibration(result.calibration)
    return result


def cameras(
    result: RunResult,
    added: Sequence[CellCamera],
    folder: RunFolder,
    options: RunOptions,
    progress: Progress,
) -> CamerasFile | None:
    """Return the other cameras of the cell as cameras.json has them; None where there are none."""
    others = (*result.capture.others, *added)
    if not others:
        return None
    from jcr.cell.stage import place_cameras

    found = place_cameras(
        result.capture, others, result.reconstruction, result.hand_eye, options.calibrate, progress
    )
    return found.file(__version__)


def densified(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """Return the result with the dense depth of the map: predicted, in the folder, or estimated now."""
    start = time.perf_counter()
    reconstruction = densify(
        result.capture,
        result.reconstruction,
        options.depth,
        progress,
    )
    give_back()
    folder.keep_depth(reconstruction, folder.state())
    return replace(result, reconstruction=reconstruction).timed("densify", start)


def mapped(
    result: RunResult, added: Capture, folder: RunFolder, options: RunOptions, progress: Progress
) -> RunResult:
    """Return the result with cloud, map and measured objects; `added` are further images for the map."""
    from jcr.pipeline.mapping import make_map  # labels and sizes need half of SciPy, a calibration does not

    start = time.perf_counter()
    made = make_map(result, added, options, progress)
    folder.keep_map(made.cloud, made.scene)
    if len(added):
        write_added(added, result.capture)
    result = replace(result, cloud=made.cloud, scene=made.scene, measured=made.measured)
    result = result.timed("map", start, made.notes)
    folder.amend_calibration(result.calibration)
    return result


def reported(result: RunResult, folder: RunFolder, options: RunOptions, progress: Progress) -> RunResult:
    """Return the result after the report is written, with the last of the times."""
    from jcr.report.html import report_html

    start = time.perf_counter()
    progress("report", 0.0)
    folder.keep_report(report_html(result, options.for_report))
    result = result.timed("report", start)
    folder.amend_calibration(result.calibration)
    progress("report", 1.0)
    return result


def _reused(
    capture: Capture, folder: RunFolder, options: RunOptions, state: State, progress: Progress
) -> tuple[Selection, tuple[Attempt, ...]] | None:
    """Calibrate the reconstruction that an earlier run, or `jcr capture`, selected from the same input.

    Return it with the attempts of that selection; None where there is none.
    """
    start = time.perf_counter()
    reused = folder.reuse_reconstruction(state) or folder.reuse_live(capture, state)
    if reused is None:
        return None
    reconstruction, earlier = reused
    read_s = time.perf_counter() - start
    selected = again(
        capture,
        reconstruction,
        read_s,
        options.calibrate,
        progress,
        options.depth,
    )
    return selected, earlier.attempts or selected.attempts


def _chosen(
    capture: Capture, folder: RunFolder, options: RunOptions, state: State, progress: Progress
) -> tuple[Selection, tuple[Attempt, ...]]:
    """Select a reconstruction now, and keep it in the folder as soon as the selection is certain."""
    selected = choose(
        capture,
        options.reconstruct,
        options.calibrate,
        progress,
        lambda made: folder.keep_reconstruction(made, state),
        options.depth,
    )
    return selected, selected.attempts


def _failed(
    capture: Capture, folder: RunFolder, options: RunOptions, state: State, error: NothingFoundError
) -> NothingFoundError:
    """Return the error, with the --board that the images show, after its reason is written to the folder.

    Nothing stays there of another capture or of other options.
    """
    from jcr.report.html import failed_report_html

    board = proposed_for(capture, options.reconstruct.board)
    if folder.earlier(state) is None:
        folder.forget_reconstruction()
        folder.keep_state(state)
    content = failed_calibration(
        capture,
        error.attempts[-1].backend,
        error.findings,
        timings_of(error.attempts),
        __version__,
        error.attempts,
    )
    content = content if board is None else content.with_findings(board)
    folder.keep_calibration(content)
    folder.keep_report(failed_report_html(capture, content, options.for_report))
    return error if board is None else NothingFoundError(error.with_more(sentence(board)), error.attempts)
