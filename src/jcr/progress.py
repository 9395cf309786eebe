"""Progress on stderr: one bar a stage, with the time left."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

Progress = Callable[[str, float], None]
"""Gets the stage's name and the fraction of it that is done."""


def silent(stage: str, fraction: float) -> None:
    """Progress that is not shown."""


def steps(progress: Progress, stage: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield the items one by one, and report their share of the stage before and after each."""
    for k, item in enumerate(items):
        progress(stage, k / len(items))
        yield item
    progress(stage, 1.0)


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Yield the callable that stages report to; bars are drawn where stderr is a terminal."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    bars = Progress(*columns, console=Console(file=sys.stderr))

    def report(stage: str, fraction: float) -> None:
        if stage not in tasks:
            bars.start()  # with the first stage: an error before it is a line of its own
            tasks[stage] = bars.add_task(stage, total=1.0)
        bars.update(tasks[stage], completed=fraction)

    try:
        yield report
    finally:
        bars.stop()
