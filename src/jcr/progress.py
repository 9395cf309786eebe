"""Progress bars on stderr, one for each stage, with the remaining time."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

Progress = Callable[[str, float], None]
"""Callback of progress; its arguments are the name of the stage and the finished fraction, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Do nothing: the callback of progress for a run without display.

    `stage` is the name of the stage, `fraction` its finished part, 0 to 1.
    """


def steps(progress: Progress, stage: str, items: Sequence[Item]) -> Iterator[Item]:
    """Yield the items one by one, and report the finished fraction of the stage before each item and at the end.

    `progress` is called with the name `stage` and the fraction, 0 to 1.
    """
    for k, item in enumerate(items):
        progress(stage, k / len(items))
        yield item
    progress(stage, 1.0)


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Yield to a `with` block a callback of progress that draws bars, or `silent` unless stderr is a terminal."""
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
    # Finished bars disappear, because they would stand between two parts of the result.
    bars = Progress(*columns, console=Console(file=sys.stderr), transient=True)

    def report(stage: str, fraction: float) -> None:
        """Draw the bar of a stage at the finished fraction, 0 to 1."""
        if stage not in tasks:
            bars.start()  # not before the first stage, so that an earlier error message is not mixed with bars
            tasks[stage] = bars.add_task(stage, total=1.0)
        bars.update(tasks[stage], completed=fraction)

    try:
        yield report
    finally:
        bars.stop()
