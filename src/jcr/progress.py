"""What a user sees while something runs: one bar a stage on stderr, with the time left."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""Told the stage's name and the fraction of it that is done."""


def silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Yield the callable that stages report to; bars are drawn on a terminal, unless `quiet`."""
    if quiet or not sys.stderr.isatty():
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
