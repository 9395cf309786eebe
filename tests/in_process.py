"""Command line without a process of its own, which would import everything again."""

import contextlib
import io
from pathlib import Path
from subprocess import CompletedProcess

from jcr.cli import dispatch


def run_jcr(*arguments: object, cwd: Path | None = None) -> CompletedProcess[str]:
    """Status, output and errors of one command, run in a folder."""
    words = list(map(str, arguments))
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
        contextlib.chdir(cwd or Path()),
    ):
        status = dispatch(words)
    return CompletedProcess(words, status, out.getvalue(), err.getvalue())
