"""What every command says and where, and what the shell completes."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from capture_writers import write_easy_handeye2
from jcr.calibration.words import actions
from jcr.cli import dispatch
from jcr.findings import Finding, FindingKind
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
    assert "\nWARNING     with 4 images" in printed.out and not printed.err
    rejected = ROOT / "tests" / "calibrations" / "rejected.json"
    shutil.copy(rejected, tmp_path / "out" / "calibration.json")
    assert dispatch(["export", str(tmp_path / "out"), "urdf", "--force", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: the calibration is rejected") and printed.err.count("\n") == 1


def test_errors_are_named_quiet_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert dispatch(["measure", str(tmp_path), "--quiet", "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("error: ") and printed.err.count("\n") == 1


TYPED = {"jcr ru": {"run"}, "jcr run --backe": {"--backend"}, "jcr run --backend col": {"colmap"}}
"""Typed words, and what Tab offers for the last one."""


@pytest.mark.slow
def test_bash_completes(tmp_path: Path):
    """Sourced, the script answers with the options that the parser has."""
    script = tmp_path / "jcr.bash"
    assert dispatch(["--tyro-write-completion", "bash", str(script)]) == 0
    function = re.search(r"^complete .*-F (\S+) jcr$", script.read_text(), re.MULTILINE)
    assert function is not None
    for line, offered in TYPED.items():
        words = " ".join(f"'{word}'" for word in line.split(" "))
        asked = (
            f"source {script}; COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMP_LINE='{line}'; "
            f"COMP_POINT=${{#COMP_LINE}}; {function[1]}; "
            'printf "%s\\n" "${COMPREPLY[@]}"'
        )
        printed = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, timeout=30)
        assert set(printed.stdout.split()) == offered, (line, printed.stderr)


@pytest.mark.slow
def test_what_was_written_before_an_error_is_not_lost() -> None:
    code = """
import sys
import jcr.cli as cli

def dispatched(arguments):
    sys.stdout.write("half of a table")
    raise cli.InputError("row 3 is wrong")

cli._dispatched = dispatched
cli.main([])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "half of a table")
    assert done.stderr == "error: row 3 is wrong\n"


def test_no_more_images_are_asked_for_beside_another_cause():
    apart = Finding.of(FindingKind.POSES_CONTRADICT_IMAGES, "rejects", "poses", value=0.06, rotation=0.4)
    wide = Finding.of(FindingKind.UNCERTAIN, "rejects", "motion", value=0.1, part="translation")
    assert [line.split()[0] for line in actions([apart, wide], 9)] == ["Cause", "Remedy"]
    assert "add images" in actions([wide], 9)[1]
