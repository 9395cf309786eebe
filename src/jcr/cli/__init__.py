"""Command line: one class per command, whose module is imported only when the command runs.

The docstring of a command's class is the help (with examples), the docstrings of its fields are the help of its options,
and `main` returns the exit status: 0 done, 2 wrong input, 3 rejected, 1 a bug. Each command has an `output`
(output.py): with --json the result is one JSON object on stdout; with --quiet only errors and warnings are printed on
stderr.
"""

import atexit
import contextlib
import errno
import gc
import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

from jcr.cli.output import Quiet
from jcr.errors import InputError, RejectedError, did_you_mean, printable
from jcr.memory import MORE_MEMORY, require_address_space

GROUPS = {
    "calibrate": {
        "run_calibrate_batch.run": "calibrate a capture, build the map, and write the report",
        "run_calibrate_batch.calibrate": "calibrate a capture without the map",
        "run_calibrate_batch.add-camera": "locate a fixed camera from its images of a run's scene",
        "run_calibrate_batch.batch": "run many captures, on this machine or a Ray cluster",
    },
    "use": {
        "map_query_export_view.export": "export to ROS, MoveIt, OctoMap, cuRobo, COLMAP, nerfstudio, …",
        "map_query_export_view.query": "query the map at points: occupancy, distance, colour, label",
        "map_query_export_view.measure": "measure the support plane and the objects on it",
        "map_query_export_view.view": "show a run in 3D, in the browser",
        "map_query_export_view.map": "build or rebuild the map of a run",
    },
    "check": {
        "check_verify_compare.check": "state what a calibration would state, and keep no files",
        "check_verify_compare.verify": "test with a few new images whether the camera has moved",
        "check_verify_compare.compare": "test whether two calibrations differ more than they state",
        "check_verify_compare.touch": "compare points that the robot's tip touches with the map",
    },
    "prepare": {
        "capture.capture": "take a capture live, with its accuracy after each image",
        "board_docs_models.board": "draw a calibration board to print",
    },
    "more": {
        "board_docs_models.models": "list back ends with their licences; download weights",
        "board_docs_models.docs": "print the pages of the manual",
    },
}
"""Commands and their descriptions by group; a key is MODULE.COMMAND."""
MODULES = {name: module for group in GROUPS.values() for module, name in (key.split(".") for key in group)}
COMMANDS = {key.split(".")[1]: about for group in GROUPS.values() for key, about in group.items()}

_OVERVIEW = """\
usage: jcr COMMAND [ARGUMENTS]

jcr calibrates a wrist camera without a target. From images and the gripper
pose at each, it estimates the hand-eye transform, the metric scale and a map
in the robot's base frame.

{commands}

jcr COMMAND --help     print arguments, options and examples of a command
jcr --version          print the version

for example:
  jcr run captures/table out/table
  jcr query out/table points.csv
"""


_DISK = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "make room or choose another folder; results are kept"),
    errno.EFBIG: "the disk cannot hold a file of that size; choose another folder",
    errno.EROFS: "choose a folder on a writable disk",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "choose a folder you can write to, or files you can read"),
    errno.EIO: "the disk is failing; copy its files and use another",
    errno.EISDIR: "there is a folder where a file belongs; move it away",
    errno.ENOTDIR: "there is a file where a folder belongs; move it away",
    errno.ELOOP: "a link leads back to itself; put a file or a folder there",
    errno.ENAMETOOLONG: "choose a shorter name",
}
"""Remedies of operating-system errors that the user can correct, by errno."""
LONGEST_LINE = 2000
"""Largest number of characters of an error message."""


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line `arguments` and exit with its status, without Python's clean-up, which takes a second.

    `arguments` are the words after "jcr"; None: those of this process.
    """
    # Spinning threads gain nothing on small matrices; together with torch's threads they cost a run 2 of 15 seconds.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Imports make 250,000 objects that stay; searching them for garbage again and again takes half a second of a run.
    gc.set_threshold(100_000)
    # Closed standard streams are opened on the null device; the next opened file would otherwise become such a stream.
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or os.fdopen(os.dup(1), "w")
    sys.stderr = sys.stderr or os.fdopen(os.dup(2), "w")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal cannot print ±
    status = dispatch(sys.argv[1:] if arguments is None else arguments)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)


def _dispatched(arguments: Sequence[str]) -> int:
    if arguments[:1] == ["help"] and arguments[1:]:
        return _dispatched([arguments[1], "--help"])
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        groups = (
            "\n".join([f"{group}:", *(f"  {key.split('.')[1]:<10} {about}" for key, about in rows.items())])
            for group, rows in GROUPS.items()
        )
        sys.stdout.write(_OVERVIEW.format(commands="\n\n".join(groups)))
        return 0
    name, rest = arguments[0], arguments[1:]
    if name in ("--version", "version"):
        from jcr import __version__

        sys.stdout.write(f"jcr {__version__}\n")
        return 0
    if name not in COMMANDS:
        like = did_you_mean(name, (*COMMANDS, "--version", "--help"))
        raise InputError(f"{name!r} is not a jcr command{like}; choose from {', '.join(COMMANDS)} (--help)")
    from jcr.cli.arguments import parsed

    try:
        record = parsed(command(name), f"jcr {name}", rest)
    except SystemExit as end:  # after --help
        return int(end.code or 0)
    require_address_space()
    with contextlib.ExitStack() as silence:
        if record.output.quiet:
            quiet = silence.enter_context(Quiet(silence.enter_context(open(os.devnull, "wb")), sys.stderr))
            silence.enter_context(contextlib.redirect_stderr(quiet))
        return record.main()


def command(name: str) -> Any:
    """Return the class of a command, whose fields are its arguments: `add-camera` is AddCameraCommand."""
    return getattr(import_module(f"jcr.cli.{MODULES[name]}"), name.title().replace("-", "") + "Command")


def dispatch(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit status; print an error as one line on stderr.

    The status is 0 for success, 2 for invalid input or lack of disk or memory, 3 if rejected, 130 after Ctrl-C, 141
    after the reader of the output closed it.
    """
    try:
        status = _dispatched(arguments)
        sys.stdout.flush()
        return status
    except (InputError, RejectedError) as error:
        status, message = 2 if isinstance(error, InputError) else 3, str(error)
    except BrokenPipeError:
        _write_no_more()  # the reader of the output closed it: 128 + SIGPIPE, as of other programs
        return 141
    except OSError as error:
        if error.errno not in _DISK:
            raise
        if error.filename is None:
            _write_no_more()
        # If a file could not be renamed, filename2 is the file that would have been replaced.
        named = error.filename2 or error.filename or "the output"
        status, message = 2, f"{named}: {error.strerror}; {_DISK[error.errno]}"
    except MemoryError as error:
        status, message = 2, f"out of memory ({error or 'no more is given'}); {MORE_MEMORY}"
    except BaseException as error:
        cause = error  # libraries raise errors of their own after Ctrl-C
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        status, message = 130, "interrupted; the same command resumes after the last finished stage"
    line = printable(" ".join(message.split()))
    # Messages quote the content of files, in which a name may have a million letters.
    sys.stderr.write(f"error: {line if len(line) <= LONGEST_LINE else f'{line[:LONGEST_LINE]}…'}\n")
    return status


def _write_no_more() -> None:
    """Discard all later standard output, because its reader has closed it."""
    with contextlib.suppress(OSError):  # in tests stdout is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
