"""Runs of many captures, over processes of this machine or a Ray cluster, and a table that ranks them."""

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
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from jcr.calibration.difference import compare
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.extras import extra
from jcr.files import locked, write_text
from jcr.findings import Verdict, sentence, verdict_of
from jcr.pipeline.options import BatchOptions
from jcr.pipeline.run import run
from jcr.progress import Progress, silent
from jcr.report.render import render
from jcr.result import CAPTURE, RunOptions, load_run

RETRIES = 3
"""Number of times a task is started again whose Ray node died."""
MIN_EPISODES = 3
"""Smallest number of accepted episodes of which most can agree."""
MOVED_P = 1e-3
"""Chance of a difference between two episodes below which the camera moved; the false-alarm rate of `jcr verify`."""


@dataclass(frozen=True, kw_only=True)
class BatchRow:
    """Row of the table: one capture."""

    capture: str
    out: str
    status: Verdict | Literal["failed"]
    backend: str = ""
    images: int = 0
    used: int = 0
    offset_std_mm: float | None = None
    """One sigma of the camera's translation along its worst axis; `turn_std_deg` is that of its rotation."""
    turn_std_deg: float | None = None
    scale_std_percent: float | None = None
    held_out_mm: float | None = None
    held_out_deg: float | None = None
    moved_mm: float | None = None
    """Translation from the camera that most episodes of the data set agree on; `moved_deg` is the rotation."""
    moved_deg: float | None = None
    seconds: float = 0.0
    reason: str = ""
    """Why it failed or is rejected, a camera that moved between episodes, or its first warning."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Capture to run, with its options."""

    capture: Path
    out: Path
    run: RunOptions
    calibrate_only: bool
    read: ReadOptions


def batch(
    captures: Sequence[Path],
    out: Path,
    run_options: RunOptions,
    options: BatchOptions,
    progress: Progress | None = None,
    read: ReadOptions | None = None,
) -> list[BatchRow]:
    """Run every capture into a folder of its own in `out`; summary.csv and summary.html rank them, best first.

    A capture that fails fails alone. One that was finished from the same inputs and options is not run again. Each
    episode that `read` names is a capture of its own, and its camera is compared with that of the other episodes.
    Raises InputError for options that mean nothing.
    """
    if options.processes is not None and options.processes < 1:
        raise InputError(f"--processes {options.processes}: give 1 or more")
    report = progress or silent
    read = read or ReadOptions()
    parts = [(path, episode) for path in captures for episode in read.episode]
    tasks = [
        Task(
            capture=path.resolve(),
            out=out.resolve() / (name if len(read.episode) == 1 else f"{name}-episode-{episode}"),
            run=run_options,
            calibrate_only=options.calibrate_only,
            read=replace(read, episode=(episode,)),
        )
        for (path, episode), name in zip(parts, np.repeat(_names(captures), len(read.episode)), strict=True)
    ]
    out.mkdir(parents=True, exist_ok=True)
    report("captures", 0.0)
    rows: list[BatchRow] = []
    for row in _on_ray(tasks, options) if options.ray else _on_this_machine(tasks, options):
        rows.append(row)
        rows.sort(key=_rank)
        _write_summary(out, rows)
        report("captures", len(rows) / len(tasks))
    rows = _with_moved_cameras(rows)
    _write_summary(out, rows)
    return rows


def run_one(task: Task) -> BatchRow:
    """Run one capture, unless it is finished, and return its row; an error is in the row."""
    start, reason = time.perf_counter(), ""
    try:
        with locked(task.out):
            capture = read_capture(task.capture, task.read, into=task.out / CAPTURE)
        options = replace(task.run, map=None) if task.calibrate_only else task.run
        try:
            content = run(capture, task.out, options).calibration
        except RejectedError as error:
            content, reason = load_run(task.out).calibration, str(error)
    except InputError as error:
        return _failed(task, str(error))
    except Exception as error:  # a bug shows in its row, and does not take the other captures with it
        return _failed(task, f"{type(error).__name__}: {error}")
    uncertainty, held_out = content.uncertainty, content.held_out
    named = next((sentence(one) for one in content.findings if one.severity != "informs"), "")
    return BatchRow(
        capture=str(task.capture),
        out=str(task.out),
        status=verdict_of(content.findings),
        backend=content.backend,
        images=len(content.images),
        used=content.images_used,
        offset_std_mm=None if uncertainty is None else max(uncertainty.translation_std_mm),
        turn_std_deg=None if uncertainty is None else max(uncertainty.rotation_std_deg),
        scale_std_percent=None if uncertainty is None else uncertainty.scale_std_percent,
        held_out_mm=None if held_out is None else held_out.translation_mm,
        held_out_deg=None if held_out is None else held_out.rotation_deg,
        seconds=round(time.perf_counter() - start, 2),
        reason=reason or named,
    )


def _with_moved_cameras(rows: Sequence[BatchRow]) -> list[BatchRow]:
    """Return the rows with the difference of each episode's camera from the one that most episodes agree on.

    The common camera is that of the episode with the smallest median χ² to the others of its data set.
    """
    of_set: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        if is_accepted(row):
            of_set.setdefault(row.capture, []).append(k)
    found = list(rows)
    for members in of_set.values():
        if len(members) < MIN_EPISODES:
            continue
        results = [load_run(Path(rows[k].out)).calibration for k in members]
        squared = [np.median([compare(one, other).chi2 or 0.0 for other in results]) for one in results]
        common = results[int(np.argmin(squared))]
        for k, result in zip(members, results, strict=True):
            apart = compare(common, result)
            mm, deg = (
                1e3 * np.linalg.norm(apart.translation_m),
                np.degrees(np.linalg.norm(apart.rotation_vector)),
            )
            reason = rows[k].reason
            if apart.p_value is not None and apart.p_value < MOVED_P:
                reason = f"the camera differs by {mm:.1f} mm and {deg:.2f}° from that of most episodes"
            found[k] = replace(rows[k], moved_mm=float(mm), moved_deg=float(deg), reason=reason)
    return found


def _failed(task: Task, reason: str) -> BatchRow:
    """Return the row of a capture that failed."""
    return BatchRow(capture=str(task.capture), out=str(task.out), status="failed", reason=reason)


def is_accepted(row: BatchRow) -> bool:
    """Test whether the calibration is accepted, with warnings or without."""
    return row.status in ("accepted", "accepted with warnings")


def _rank(row: BatchRow) -> tuple[int, float, str]:
    order = (*get_args(Verdict), "failed").index(row.status)
    return order, float("inf") if row.offset_std_mm is None else row.offset_std_mm, row.capture


def _names(captures: Sequence[Path]) -> list[str]:
    """Return a folder name for each capture: its own, with a number where two have the same."""
    names: list[str] = []
    for path in captures:
        own = (path.parent if path.is_file() else path).resolve().name or "capture"
        name, number = own, 2
        while name in names:
            name, number = f"{own}-{number}", number + 1
        names.append(name)
    return names


def _on_this_machine(tasks: list[Task], options: BatchOptions) -> Iterator[BatchRow]:
    # macOS cannot bind a process to cores.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    processes = min(options.processes or max(1, cores // 2), len(tasks))
    with _threads_per_process(max(1, cores // processes)):
        left = yield from _over_pool(tasks, processes)
        # A process that was killed takes its pool along; alone, only the capture that did it fails.
        for task in left:
            if (yield from _over_pool([task], 1)):
                yield _failed(task, "its process died: out of memory, or a crash in a library")


def _over_pool(tasks: list[Task], processes: int):
    """Yield rows as they come; return the tasks that a broken pool left undone."""
    left: list[Task] = []
    # Spawned, not forked: libraries with threads of their own do not survive a fork.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, initializer=_dies_on_interrupt)
    try:
        task_of = {pool.submit(run_one, task): task for task in tasks}
        for future in as_completed(task_of):
            try:
                yield future.result()
            except BrokenProcessPool:
                left.append(task_of[future])
        pool.shutdown()
        return left
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        pool.shutdown(cancel_futures=True)
        raise


def _dies_on_interrupt() -> None:
    """End at Ctrl-C, which reaches every process of the terminal, without a report."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def _threads_per_process(threads: int) -> Iterator[None]:
    """Set the number of threads that numerical libraries read when a process starts."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _on_ray(tasks: list[Task], options: BatchOptions) -> Iterator[BatchRow]:
    extra("ray", "cluster", "--ray")
    import ray  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

    own = not ray.is_initialized()
    if own:
        try:
            ray.init(address=options.ray, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError) as error:
            raise InputError(f"--ray {options.ray}: no cluster there ({error})") from None
    try:
        cpus, gpus = options.cpus_per_task, options.gpus_per_task
        resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(has.get("CPU", 0) >= cpus and has.get("GPU", 0) >= gpus for has in resources):
            # Ray would wait for such a node without end.
            raise InputError(
                f"--ray {options.ray}: no node has the {cpus} cores and {gpus:g} GPUs that a capture takes; "
                "lower --cpus-per-task or --gpus-per-task, or add the node first"
            )
        remote = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=RETRIES)(run_one)
        task_of = {remote.remote(task): task for task in tasks}
        waiting = list(task_of)
        while waiting:
            (done,), waiting = ray.wait(waiting, num_returns=1)
            try:
                yield ray.get(done)
            except RayError as error:
                task, reason = task_of[done], " ".join(str(error).split())[:200]
                yield _failed(task, reason)
    finally:
        if own:
            ray.shutdown()


def _write_summary(out: Path, rows: list[BatchRow]) -> None:
    """Write the table as CSV and as a page."""
    text = io.StringIO()
    table = csv.DictWriter(text, [field.name for field in fields(BatchRow)], lineterminator="\n")
    table.writeheader()
    table.writerows(asdict(row) for row in rows)
    write_text(out / "summary.csv", text.getvalue())
    numbers = (
        "offset_std_mm",
        "turn_std_deg",
        "scale_std_percent",
        "held_out_mm",
        "held_out_deg",
        "moved_mm",
        "moved_deg",
        "seconds",
    )
    shown = [
        {
            "row": row,
            "name": Path(row.out).name,
            "has_report": (Path(row.out) / "report.html").is_file(),
            "is_accepted": is_accepted(row),
            "numbers": [getattr(row, name) for name in numbers],
        }
        for row in rows
    ]
    write_text(out / "summary.html", render("batch.html", {"table": shown}))
