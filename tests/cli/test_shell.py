"""What every command says and where, and what the shell completes."""

import json
import os
import pty
import re
import select
import shutil
import subprocess
import time
from importlib import import_module
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from capture_writers import write_easy_handeye2
from jcr.cli import COMMANDS, dispatch
from jcr.cli.arguments import groups
from jcr.cli.completion import SHELLS, script
from jcr.cli.output import Output
from jcr.cli.query import labelled
from jcr.export.formats import FORMATS
from jcr.export.options import FormatName
from jcr.geometry import scale_translation
from places import ROOT
from simulation.problems import hand_eye_problem


@pytest.fixture(scope="module")
def commands(done: Path, tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """The commands that are quick here; those that are not have the same in their own tests."""
    scratch = tmp_path_factory.mktemp("commands")
    run = scratch / "run"
    shutil.copytree(done, run)
    np.save(scratch / "points.npy", np.zeros((2, 3)))
    lines = {
        "calibrate": ["calibrate", tabletop, run],
        "check": ["check", tabletop, "--poses-only"],
        "query": ["query", run, scratch / "points.npy"],
        "export": ["export", run, "ros2"],
        "measure": ["measure", run],
        "compare": ["compare", run, tabletop],
        "models": ["models"],
    }
    return {name: list(map(str, line)) for name, line in lines.items()}


def _arguments(name: str) -> type:
    return import_module(f"jcr.cli.{name.replace('-', '_')}").Arguments


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_takes_json_and_quiet(name: str):
    assert isinstance(_arguments(name).__dataclass_fields__["output"].default_factory(), Output)


def test_json_is_one_object_and_quiet_is_silence(
    commands: dict[str, list[str]], capsys: pytest.CaptureFixture[str]
):
    for name, line in commands.items():
        assert dispatch([*line, "--quiet", "--json"]) == 0, name
        printed = capsys.readouterr()
        assert isinstance(json.loads(printed.out), dict), name
        assert printed.err == "", name
    for name in ("measure", "compare", "models"):
        assert dispatch([*commands[name], "--quiet"]) == 0, name
        printed = capsys.readouterr()
        assert printed.out and printed.err == "", name


def test_what_decides_is_named_quiet_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of four samples a wrong one cannot be identified: a warning, and no word else."""
    problem = hand_eye_problem(np.random.default_rng(0), 4, robot_noise=(2e-4, 5e-4))
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    samples = write_easy_handeye2(tmp_path, problem.base_from_gripper, cameras)
    assert dispatch(["calibrate", str(samples), str(tmp_path / "out"), "--quiet"]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: with 4 images") and printed.err.count("\n") == 1
    rejected = ROOT / "tests" / "calibrations" / "rejected.json"
    shutil.copy(rejected, tmp_path / "out" / "calibration.json")
    assert dispatch(["export", str(tmp_path / "out"), "urdf", "--force", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: the calibration is rejected") and printed.err.count("\n") == 1


def test_a_query_shows_on_what_its_points_lie():
    said = labelled(np.array([0, 2, 2, 1, 2, 0]), ("none", "table", "object 1", "object 2"))
    assert said == "; by label: table 1, object 1 3"
    assert labelled(np.zeros(3, int), ("none",)) == ""


def test_errors_are_named_quiet_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert dispatch(["measure", str(tmp_path), "--quiet", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("error: ") and printed.err.count("\n") == 1


def test_every_export_format_is_in_the_table():
    assert tuple(row.name for row in FORMATS) == get_args(FormatName)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_completed_is_what_the_help_lists(name: str, capsys: pytest.CaptureFixture[str]):
    assert dispatch([name, "--help-all"]) == 0
    printed = capsys.readouterr().out
    listed = set(re.findall(r"^  (--[a-z][a-z0-9-]*)", printed, re.MULTILINE))
    offered = {argument.flag for group in groups(_arguments(name), "jcr") for argument in group.arguments}
    assert listed == offered - {""}
    # Arguments have their own names, and None is no word of a command line.
    assert "{None" not in printed and " PATH PATH" not in printed.splitlines()[0]


TYPED = {
    "jcr ru": {"run"},
    "jcr run --backe": {"--backend"},
    "jcr calibrate a b --device ": {"auto", "cpu", "cuda"},
    "jcr run --backend col": {"colmap"},
    "jcr map out --segments ta": {"tabletop"},
    "jcr export out octo": {"octomap"},
    "jcr run --pos": {"--poses", "--pose-convention", "--pose-inverted", "--pose-units"},
    "jcr check ima": {"images/"},
    "jcr check --poses ima": {"images/"},
}
"""What is typed, and what Tab offers, in a folder that holds a folder `images`."""


@pytest.mark.slow
def test_bash_completes(tmp_path: Path):
    (tmp_path / "images").mkdir()
    (tmp_path / "jcr.bash").write_text(script("bash", COMMANDS))
    for line, offered in TYPED.items():
        words = " ".join(f"'{word}'" for word in line.split(" "))
        asked = (
            f"source jcr.bash; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); "
            '_jcr jcr "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"; '
            # What -o default does where the function has nothing to offer.
            '((${#COMPREPLY[@]})) || COMPREPLY=($(compgen -f -S / -- "${COMP_WORDS[COMP_CWORD]}")); '
            'printf "%s\\n" "${COMPREPLY[@]}"'
        )
        printed = subprocess.run(
            ["bash", "-c", asked], cwd=tmp_path, capture_output=True, text=True, timeout=10
        )
        assert set(printed.stdout.split()) == offered, (line, printed.stderr)


def test_fish_completes(tmp_path: Path):
    if shutil.which("fish") is None:
        pytest.skip("fish is not installed")
    (tmp_path / "images").mkdir()
    (tmp_path / "jcr.fish").write_text(script("fish", COMMANDS))
    for line, offered in TYPED.items():
        printed = subprocess.run(
            ["fish", "-c", f"source jcr.fish; complete -C '{line}'"],
            cwd=tmp_path, capture_output=True, text=True, timeout=30, check=True,
        )  # fmt: skip
        found = {row.split("\t")[0] for row in printed.stdout.splitlines()}
        assert found == offered, (line, printed.stderr)


def test_zsh_completes(tmp_path: Path):
    if shutil.which("zsh") is None:
        pytest.skip("zsh is not installed")
    (tmp_path / "jcr.zsh").write_text(script("zsh", COMMANDS))
    # Tab works in a terminal alone.
    asking, terminal = pty.openpty()
    zsh = subprocess.Popen(
        ["zsh", "-fi"], cwd=tmp_path, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True
    )
    try:
        os.write(asking, b"unsetopt beep; autoload -U compinit; compinit -u -D; source ./jcr.zsh\n")
        # Tab completes, then the line's start (Ctrl-A) becomes an echo of what stands there.
        printed, deadline = "", time.monotonic() + 30
        os.write(asking, b"jcr run --backe\t\x01echo told: \n")
        while not re.search(r"^told: jcr run --backend", printed, re.MULTILINE):
            assert time.monotonic() < deadline, printed
            if select.select([asking], [], [], 1)[0]:
                printed += os.read(asking, 4096).decode(errors="replace")
    finally:
        zsh.kill()
        zsh.wait()
        os.close(asking)
        os.close(terminal)


def test_there_is_no_script_for_other_shells(capsys: pytest.CaptureFixture[str]):
    assert dispatch(["--completion", "tcsh"]) == 2
    printed = capsys.readouterr().err
    assert all(shell in printed for shell in SHELLS)


@pytest.mark.slow
def test_what_was_written_before_an_error_is_not_lost() -> None:
    code = """
import sys
import jcr.cli as cli

def dispatch(arguments):
    sys.stdout.write("half of a table")
    raise cli.InputError("row 3 is wrong")

cli.dispatch = dispatch
cli.main([])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "half of a table")
    assert done.stderr == "error: row 3 is wrong\n"
