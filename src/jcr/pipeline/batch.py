"""Runs of many captures, in processes of this machine or on a Ray cluster, and a table that ranks their results."""

import csv
import io
import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.calibration.record import AnyCalibration, FailedCalibration
from jcr.capture.formats import lerobot
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.extras import extra
from jcr.files import locked, write_text
from jcr.findings import Verdict, sentence, verdict_of
from jcr.pipeline.episode_agreement import agreement, letter
from jcr.pipeline.options import BatchOptions
from jcr.pipeline.run import run
from jcr.progress import Progress, silent
from jcr.report.render import render
from jcr.result import CAPTURE, RunOptions, load_run

MIN_EPISODES = 3
"""Smallest number of sound episodes of a data set whose cameras are compared with each other."""
THREADS = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"
"""Environment variables from which numerical libraries read their number of threads when a process starts."""

Task = tuple[Path, Path, RunOptions, ReadOptions]
"""Path of a capture, its run folder, and the options to run and to read it: the arguments of `run_one`."""


@dataclass(frozen=True, kw_only=True)
class BatchRow:
    """Row of the table of a batch: capture, status, accuracy, and the reason of a problem."""

    capture: str
    out: str
    status: Verdict | Literal["failed"]
    """Verdict on the calibration; "failed": there is none because of an error."""
    backend: str = ""
    images: int = 0
    used: int = 0
    point_95_mm: float | None = None
    """Bound of 95 % of the errors of a point at the distance of the scene; None without a calibration."""
    rotation_95_deg: float | None = None
    """Bound of 95 % of the errors of the rotation; None without a calibration."""
    scale_std_percent: float | None = None
    held_out_mm: float | None = None
    """Translation of the leave-one-out error."""
    held_out_deg: float | None = None
    """Rotation of the leave-one-out error."""
    moved_mm: float | None = None
    """Distance of the camera from its pose in most episodes of the data set; None with fewer than MIN_EPISODES."""
    moved_deg: float | None = None
    """Rotation angle of the camera from its pose in most episodes."""
    episode: int | None = None
    """Number of the episode, for a LeRobot data set."""
    camera: str = ""
    """Letter of the group of episodes with one pose of the camera; empty with fewer than MIN_EPISODES."""
    x_m: float | None = None
    """Position of the camera in the gripper frame, with y_m and z_m."""
    y_m: float | None = None
    z_m: float | None = None
    qx: float | None = None
    """Rotation gripper_from_camera as quaternion qx, qy, qz, qw."""
    qy: float | None = None
    qz: float | None = None
    qw: float | None = None
    fx: float | None = None
    """Focal lengths and principal point (px), with fy, cx and cy."""
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    seconds: float = 0.0
    reason: str = ""
    """Reason of a failure or rejection, or that the camera moved between episodes, or else the first warning."""

    @property
    def is_accepted(self) -> bool:
        """Whether the calibration is accepted and as exact as required, or by the published method."""
        return self.status in ("accepted", "not checked")

    @property
    def is_sound(self) -> bool:
        """Whether no check contradicts the calibration, which may be less exact than needed."""
        return self.status not in ("rejected", "failed")


def batch(
    captures: Sequence[Path],
    out: Path,
    run_options: RunOptions,
    options: BatchOptions,
    progress: Progress = silent,
    read: ReadOptions | None = None,
) -> list[BatchRow]:
    """Run every capture into its own folder inside `out`; write summary.csv and summary.html, best calibration first.

    A capture that fails does not stop the others; one that was finished with the same inputs and options is not run
    again. Each episode that `read` names is run as a separate capture, and the cameras of the episodes are compared.
    """
    if options.processes is not None and options.processes < 1:
        raise InputError(f"--processes {options.processes}: give 1 or more")
    if not captures:
        raise InputError("batch: no captures; name one or more")
    read = read or ReadOptions()
    run_options = replace(run_options, map=None) if options.calibrate_only else run_options
    tasks, names, notes = list[Task](), set[str](), list[str]()
    for path in captures:
        own = (path.parent if path.is_file() else path).resolve().name or "capture"
        numbered = (own if k == 1 else f"{own}-{k}" for k in range(1, len(captures) + 1))
        names.add(name := next(name for name in numbered if name not in names))
        episodes, total = lerobot.episodes_of(path, read)
        if len(episodes) < total:
            notes.append(f"{name}: {len(episodes)} of {total} episodes, evenly")
        for episode in episodes:
            folder = out.resolve() / (name if len(episodes) == 1 else f"{name}-episode-{episode}")
            tasks.append((path.resolve(), folder, run_options, replace(read, episode=(episode,))))
    out.mkdir(parents=True, exist_ok=True)
    progress("captures", 0.0)
    rows: list[BatchRow] = []
    order = (*get_args(Verdict), "failed")
    for new in _on_ray(tasks, options) if options.ray else _on_this_machine(tasks, options):
        rows.append(new)
        rows.sort(key=lambda row: (order.index(row.status), row.point_95_mm or np.inf, row.capture))
        _write_summary(out, rows, notes)
        progress("captures", len(rows) / len(tasks))
    rows, sentences = _with_compared_cameras(rows)
    _write_summary(out, rows, [*notes, *sentences])
    return rows


def run_one(capture: Path, out: Path, options: RunOptions, read: ReadOptions) -> BatchRow:
    """Run all stages for one capture in `out`, unless finished already; return its row, which reports an error."""
    start, reason = time.perf_counter(), ""
    row = BatchRow(capture=str(capture), out=str(out), status="failed")
    if lerobot.recognises(capture) and isinstance(number := read.episode[0], int):
        row = replace(row, episode=number)
    try:
        with locked(out):
            found = read_capture(capture, read, into=out / CAPTURE)
        try:
            content = run(found, out, options).calibration
        except RejectedError as error:
            content, reason = load_run(out).calibration, str(error)
    except InputError as error:
        return replace(row, reason=str(error))
    except Exception as error:  # a bug is reported in the row, and does not stop the other captures
        return replace(row, reason=f"{type(error).__name__}: {error}")
    uncertainty, held_out = content.uncertainty, content.held_out
    seen = None if uncertainty is None else uncertainty.seen
    named = next((sentence(one) for one in content.findings if one.severity != "informs"), "")
    return replace(
        row,
        status=verdict_of(content.findings),
        backend=content.backend,
        images=len(content.images),
        used=content.images_used,
        point_95_mm=None if seen is None else seen.within_95_mm,
        rotation_95_deg=None if seen is None else seen.rotation_95_deg,
        scale_std_percent=None if uncertainty is None else uncertainty.scale_std_percent,
        held_out_mm=None if held_out is None else held_out.translation_mm,
        held_out_deg=None if held_out is None else held_out.rotation_deg,
        seconds=round(time.perf_counter() - start, 2),
        reason=reason or named,
        **_camera_cells(content),
    )


def _camera_cells(content: AnyCalibration) -> dict[str, float]:
    """Return the cells of a row with the pose of the wrist camera and its intrinsics, as far as they are known."""
    cells = dict[str, float]()
    if not isinstance(content, FailedCalibration) and content.mount == "gripper":
        x = content.gripper_from_camera
        numbers = [*x[:3, 3].tolist(), *Rotation.from_matrix(x[:3, :3]).as_quat(canonical=True).tolist()]
        cells |= dict(zip(("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"), numbers, strict=True))
    if (camera := content.intrinsics) is not None:
        cells |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    return cells


def _with_compared_cameras(rows: Sequence[BatchRow]) -> tuple[list[BatchRow], list[str]]:
    """Return the rows with the cameras of the episodes of each capture compared, and the agreement in words.

    `moved_mm` and `moved_deg` are relative to the most exact episode of the largest group. Captures with fewer than
    MIN_EPISODES sound episodes are unchanged.
    """
    found, sentences = list(rows), list[str]()
    for capture in dict.fromkeys(row.capture for row in rows):
        members = [k for k, row in enumerate(rows) if row.capture == capture and row.is_sound]
        members.sort(key=lambda k: (rows[k].episode or 0, rows[k].out))
        if len(members) < MIN_EPISODES:
            continue
        numbers = [k if (own := rows[at].episode) is None else own for k, at in enumerate(members)]
        agreed = agreement(numbers, [load_run(Path(rows[k].out)).solved for k in members])
        sentences += agreed.sentences
        most = max(set(agreed.group), key=agreed.group.count)
        for k, group, apart in zip(members, agreed.group, agreed.apart, strict=True):
            mm = float(1e3 * np.linalg.norm(apart.translation_m))
            deg = float(np.degrees(np.linalg.norm(apart.rotation_vector)))
            found[k] = replace(rows[k], moved_mm=mm, moved_deg=deg, camera=letter(group))
            if group != most:
                reason = f"the camera differs by {mm:.1f} mm and {deg:.2f}° from that of most episodes"
                found[k] = replace(found[k], reason=reason)
    return found, sentences


def _failed(task: Task, reason: str) -> BatchRow:
    """Return the row of a task that failed for this reason."""
    return BatchRow(capture=str(task[0]), out=str(task[1]), status="failed", reason=reason)


def _on_this_machine(tasks: list[Task], options: BatchOptions) -> Iterator[BatchRow]:
    """Yield the row of each task when it ends; the tasks run in processes, which divide the cores among them."""
    # macOS has no sched_getaffinity, because it cannot bind a process to cores.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    processes = min(options.processes or max(1, cores // 2), len(tasks))
    # Processes are spawned, because libraries with threads do not survive a fork. Ctrl-C, which reaches every process of
    # the terminal, ends each of them without a traceback.
    context, on_interrupt = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_DFL)
    before, waiting = dict(os.environ), [tasks]
    os.environ.update(dict.fromkeys(THREADS, str(max(1, cores // processes))))
    try:
        while waiting:
            own = waiting.pop(0)
            count = min(processes, len(own))
            pool = ProcessPoolExecutor(count, context, initializer=signal.signal, initargs=on_interrupt)
            task_of = {pool.submit(run_one, *task): task for task in own}
            for future in as_completed(task_of):
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield future.result()
                elif len(own) > 1:
                    # A killed process ends its whole pool. Each unfinished task is run again in a pool of its own.
                    waiting.append([task_of[future]])
                else:
                    yield _failed(task_of[future], "its process died: out of memory, or a crash in a library")
            pool.shutdown()
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        os.environ.clear()
        os.environ.update(before)


def _on_ray(tasks: list[Task], options: BatchOptions) -> Iterator[BatchRow]:
    """Yield the row of each task when it ends on the Ray cluster; raise InputError if no node has enough resources."""
    extra("ray", "cluster", "--ray")
    import ray  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

    try:
        ray.init(options.ray, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {options.ray}: no cluster there ({error})") from None
    try:
        cpus, gpus = options.cpus_per_task, options.gpus_per_task
        resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(has.get("CPU", 0) >= cpus and has.get("GPU", 0) >= gpus for has in resources):
            # Ray would wait forever for a node with enough resources.
            raise InputError(
                f"--ray {options.ray}: no node has the {cpus} cores and {gpus:g} GPUs that a capture takes; "
                "lower --cpus-per-task or --gpus-per-task, or add the node first"
            )
        remote = ray.remote(num_cpus=cpus, num_gpus=gpus)(run_one)  # tried three times more if its node fails
        task_of = {remote.remote(*task): task for task in tasks}
        waiting = list(task_of)
        while waiting:
            (done,), waiting = ray.wait(waiting, num_returns=1)
            try:
                yield ray.get(done)
            except RayError as error:
                yield _failed(task_of[done], " ".join(str(error).split())[:200])
    finally:
        ray.shutdown()


def _write_summary(out: Path, rows: Sequence[BatchRow], sentences: Sequence[str]) -> None:
    """Write the table as summary.csv and as the page summary.html, with these sentences and links to the reports."""
    text, content = io.StringIO(), [asdict(row) for row in rows]
    table = csv.DictWriter(text, list(content[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(content)
    write_text(out / "summary.csv", text.getvalue())
    folders = [Path(row.out) for row in rows]
    reports = {folder.name for folder in folders if (folder / "report.html").is_file()}
    lines = list(zip([folder.name for folder in folders], rows, strict=True))
    content = {"table": lines, "reports": reports, "sentences": sentences}
    write_text(out / "summary.html", render("batch.html", content))
