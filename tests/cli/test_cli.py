"""The command line on the bundled capture and on faults: results, exit statuses, printed words."""

import io
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jcr
from capture_writers import write_easy_handeye2
from in_process import run_jcr
from jcr.calibration.record import Calibration, read_calibration
from jcr.cli import COMMANDS, command, dispatch
from jcr.cli.arguments import _flags
from jcr.cli.capture import CaptureCommand, _conclude
from jcr.cli.check_verify_compare import CheckCommand, _command_of_remedy
from jcr.cli.map_query_export_view import PRINTED_POINTS, read_points
from jcr.cli.output import write_lines
from jcr.findings import Finding, FindingKind
from jcr.geometry import rotation_exp, scale_translation, transform
from jcr.live.session import SessionOptions
from jcr.number_format import INDENT, labelled
from jcr.pipeline import run
from jcr.records import Reading, Requirement
from jcr.scene.cloud import read_cloud
from jcr.scene.options import MapOptions
from places import ROOT
from refusal import refused
from scenes import capture_of
from simulation.problems import hand_eye_problem

CALIBRATIONS = ROOT / "tests" / "calibrations"
TABLETOP = str(ROOT / "examples" / "tabletop")


@pytest.fixture(scope="module")
def commands(done: Path, tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """The commands that are quick here; those that are not have the same in their own tests."""
    scratch = tmp_path_factory.mktemp("commands")
    run = scratch / "run"
    shutil.copytree(done, run)
    np.save(scratch / "points.npy", np.zeros((2, 3)))
    lines = {
        "calibrate": ["calibrate", tabletop, run], "check": ["check", tabletop, "--poses-only"],
        "query": ["query", run, scratch / "points.npy"], "export": ["export", run, "ros2"],
        "measure": ["measure", run], "compare": ["compare", run, tabletop], "models": ["models"],
    }  # fmt: skip
    return {name: list(map(str, line)) for name, line in lines.items()}


def test_json_is_one_object_quiet_silence(commands: dict[str, list[str]], capsys: pytest.CaptureFixture[str]):
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
    assert "\nWARNING     with so few images (4)" in printed.out and not printed.err
    rejected = ROOT / "tests" / "calibrations" / "rejected.json"
    shutil.copy(rejected, tmp_path / "out" / "calibration.json")
    export = ["export", str(tmp_path / "out"), "urdf", "--parent-frame", "tool0", "--force", "--quiet"]
    assert dispatch(export) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: the calibration is rejected") and printed.err.count("\n") == 1


def test_answers_from_the_map_of_a_rejected_run_end_with_3(done: Path, tmp_path: Path):
    out = shutil.copytree(done, tmp_path / "out")
    shutil.copy(CALIBRATIONS / "rejected.json", out / "calibration.json")
    np.save(tmp_path / "points.npy", np.zeros((1, 3)))
    found = run_jcr("query", out, tmp_path / "points.npy")
    assert found.returncode == 3 and found.stderr.startswith("error: answers rejected: ")
    assert found.stdout.startswith("wrote ")


@pytest.mark.parametrize(("arguments", "words"), [
    (["--board", "chessbord:9x6:0.02"], "no such board; write it as charuco:"),
    (["--board", "chessboard:9x6:-1"], "-1 is no length of a square in metres"),
    (["--backend", "colmap", "--board", "chessboard:9:0.02"], "9 is no size such as 7x5"),
    (["--require", "-1", "2"], "require -1 2: give two positive numbers"),
    (["--robot-noise", "0.5", "nan"], "robot_noise 0.5 nan: give two positive numbers"),
    (["--scale", "0"], "scale 0: give a positive number"),
    (["--robot", "ur99"], "robot ur99: not known"),
])  # fmt: skip
def test_impossible_options_are_refused_before_any_work(tabletop, tmp_path, monkeypatch, arguments, words):
    monkeypatch.setattr(run, "begun", lambda *_: pytest.fail("the capture was worked on"))
    found = run_jcr("run", tabletop, tmp_path / "out", *arguments)
    assert found.returncode == 2 and words in found.stderr, found.stderr
    assert len(found.stderr.splitlines()) == 1 and not (tmp_path / "out" / "calibration.json").exists()


def result(name: str, reached_mm: float) -> Any:
    """A calibration of all images, accepted or rejected, that reaches an accuracy."""
    required = Requirement(
        translation_mm=2.0, rotation_deg=0.3, distance_mm=500.0, reached_mm=reached_mm, reached_deg=0.1
    )  # fmt: skip
    content = read_calibration(ROOT / "tests" / "calibrations" / f"{name}.json")
    assert isinstance(content, Calibration)
    content = replace(content, requirement=required)
    if not required.met:
        missed = Finding.of(FindingKind.NOT_EXACT_ENOUGH, "warns", "none", **required.details)
        content = content.with_findings(missed)
    return SimpleNamespace(
        converged=content.converged, verdict=content.verdict, calibration=content,
        out=Path("captures/live/result"),
    )  # fmt: skip


CHECK, RUN = "jcr check captures/live", "jcr run captures/live out/live"
RESUME = "the same command resumes; 3 or more images are needed"


@pytest.mark.parametrize(("images", "found", "until_accurate", "status", "last"), [
    (2, None, False, 0, RESUME),
    (2, None, True, 3, RESUME),
    (9, None, False, 3, CHECK),
    (9, result("rejected", 1.0), False, 3, CHECK),
    (9, result("accepted", 1.0), False, 0, RUN),
    (9, result("accepted", 1.0), True, 0, RUN),
    (9, result("accepted", 3.0), True, 3, RUN),
])  # fmt: skip
def test_exit_status_and_last_line_of_a_capture(images, found, until_accurate, status, last, capsys):
    options = SessionOptions(until_accurate=until_accurate, require=(2.0, 0.3))
    facts = {"capture": "captures/live", "images": images * ["0.png"], "answers": []}
    assert (
        _conclude(
            CaptureCommand(out=Path("captures/live"), session=options), facts, found, requirement_met=True
        )
        == status
    )
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == f"Next        {last}" and len(printed) <= 14
    if found is not None:
        assert printed[0].startswith("ACCEPTED" if found.converged else "REJECTED")


def test_a_map_without_depth_adds_depth_of_a_whole_run(small_capture: Path, small_done: Path, tmp_path: Path):
    capture, stages = jcr.read_capture(small_capture), list[str]()
    shutil.copytree(small_done, tmp_path / "whole")
    jcr.calibrate(capture, tmp_path / "out")
    options = MapOptions(max_seconds=1.0, cell=0.03)
    mapped = jcr.build_map(tmp_path / "out", map=options, progress=lambda stage, share: stages.append(stage))
    assert "dense depth" in stages and "matching" not in stages
    assert jcr.measure(tmp_path / "out").objects
    for name in ("reconstruction.npz", "depth.npz"):
        with np.load(tmp_path / "out" / name) as one_file, np.load(tmp_path / "whole" / name) as other_file:
            assert set(one_file) == set(other_file)
            for array in one_file:
                np.testing.assert_array_equal(one_file[array], other_file[array])
    stamp, stages[:] = (tmp_path / "whole" / "depth.npz").stat().st_mtime_ns, []
    report = lambda stage, share: stages.append(stage)  # noqa: E731
    whole = jcr.run(capture, tmp_path / "whole", jcr.RunOptions(map=options), progress=report)
    assert "dense depth" not in stages and "matching" not in stages
    assert (tmp_path / "whole" / "depth.npz").stat().st_mtime_ns == stamp
    np.testing.assert_array_equal(mapped.gripper_from_camera, whole.gripper_from_camera)


def test_the_map_answers_points(done: Path, tabletop: Path, tmp_path: Path):
    truth = json.loads((tabletop / "truth" / "scene.json").read_text())
    table = truth["table_height"]
    capture = jcr.read_capture(tabletop)
    over = capture.base_from_gripper[:, :2, 3].mean(0)
    points = tmp_path / "points.csv"
    surface = read_cloud(done / "cloud.ply").points_in_base[::500]
    rows = [[over[0], over[1], table + 0.3], [9.0, 9.0, 9.0], *surface]
    points.write_text("x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in rows))
    answered = run_jcr("query", done, points, "--json")
    assert answered.returncode == 0, answered.stderr
    answers = json.loads(answered.stdout)
    _, first, second, *more = run_jcr("query", done, points).stdout.splitlines()
    assert f": {1e3 * answers['distance'][0]:.1f} ± " in first and "outside of the mapped" in second
    assert len(more) == PRINTED_POINTS - 2
    # High over the table everyone looked and saw nothing; nine metres away nobody did; points lie on surfaces.
    assert answers["occupancy"][0] < 0.5 and not answers["unknown"][0]
    assert answers["unknown"][1]
    assert np.mean(np.array(answers["occupancy"][2:]) > 0.5) > 0.5
    distance = np.array(answers["distance"][2:], float)
    assert np.isfinite(distance).mean() > 0.98  # the map's box holds all but a hundredth of the points
    assert np.nanmedian(np.abs(distance)) < 0.01
    # The surface is known to millimetres, as the run's calibration and depth say.
    assert 1e-5 < np.nanmedian(np.array(answers["std"][2:], float)) < 0.01
    assert 1e-4 < answers["margin_95_m"] < 0.05 and answers["look_std_m"] > 0


def test_objects_are_measured_to_three_percent(done: Path, tabletop: Path):
    answered = run_jcr("measure", done, "--json")
    assert answered.returncode == 0, answered.stderr
    found = json.loads(answered.stdout)["objects"]
    true = json.loads((tabletop / "truth" / "scene.json").read_text())["objects"]
    places = np.array([thing["base_from_box"] for thing in true])[:, :2, 3]
    near = [np.linalg.norm(places - np.array(size["base_from_box"])[:2, 3], axis=1) for size in found]
    at = {int(d.argmin()): size for d, size in zip(near, found, strict=True) if d.min() < 0.02}
    heights = {k: size["height"] for k, size in at.items()}
    beyond = {
        true[k]["name"]: (size["height"] - true[k]["height"]) / size["height_std"] for k, size in at.items()
    }
    # The recessed lid of the can and the rim of the mug were 11 and 12 of their own σ off.
    assert all(abs(sigmas) < 3 for name, sigmas in beyond.items() if name != "apple"), beyond
    assert len(heights) >= 5
    # The stalk of the apple, 3 mm thick, is beyond what depth resolves.
    off = {true[k]["name"]: height / true[k]["height"] - 1 for k, height in heights.items()}
    assert all(abs(share) < 0.031 for name, share in off.items() if name != "apple"), off
    lines = run_jcr("measure", done).stdout.splitlines()
    assert len(lines) == 2 + len(found) and "±" in lines[2]


@pytest.mark.parametrize(("arguments", "words"), [
    (["fly"], "not a jcr command; choose from"),
    (["run", "a", "b", "--requre", "1", "1"], "did you mean --require? (jcr run --help)"),
    (["run", "a", "b", "--backend", "colmp"], "did you mean colmap?; choose from auto, "),
    (["export", "a", "octomapp"], "did you mean octomap?"),
    (["run", "a", "b", "--require", "2"], "--require takes MM DEG|none, not '2' (jcr run --help)"),
    (["run", "a", "-o", "b"], "jcr run has no option -o"),
    (["run", ROOT / "examples/tabletop", "b", "--workspace", "1", "1", "1", "0", "0", "0"], "minima below maxima"),
    (["verify", "a", "--board", "b"], "it is an option of jcr run, jcr calibrate, jcr batch and jcr check (jcr verify"),
    (["run", "a", "--out", "b"], "give it by its place: jcr run CAPTURE OUT (jcr run --help)"),
    (["run", "a", "b", "--frobnicate"], "jcr run has no option --frobnicate (jcr run --help)"),
    (["run", "nowhere", "out"], "nowhere"),
    (["--verison"], "did you mean --version?"),
    (["board", "b.pdf", "charuco:9x6:0.060:0.050:DICT_5X5_100"], "but a4 has room for 267 x 180"),
    (["check", ROOT / "examples/tabletop", "--poses-only", "--board", "chessboard:7x5:30"], "30 is no length of"),
    (["run", "nowhere", "out", "--backend", "magic"], "auto, colmap, da3, da3-small, direct, "),
    (["compare", "nowhere", "nowhere"], "nowhere"),
    (["calibrate", TABLETOP, ""], "an argument of jcr calibrate is empty"),
    (["calibrate", TABLETOP, "out", "--scale", "0.5"], "scale: is for camera poses without images"),
    (["calibrate", TABLETOP, "out", "--frames", "5"], "--frames is for bags and data sets"),
    (["run", TABLETOP, "out", "--cell", "0"], "cell 0: give metres, above 0 and up to 0.1"),
    (["run", TABLETOP, "out", "--max-points", "-5"], "max_points -5"),
    (["run", TABLETOP, "out", "--confidence-percentile", "200"], "confidence_percentile 200"),
    (["run", TABLETOP, "out", "--max-seconds", "-1"], "max_seconds -1"),
    (["run", TABLETOP, "out", "--steps", "5"], "is for the preset paper"),
    (["run", TABLETOP, "out", "--object-gap", "-1"], "object_gap -1"),
])  # fmt: skip
def test_wrong_arguments_are_one_line_and_exit_2(tmp_path: Path, arguments: list[str], words: str):
    finished = run_jcr(*arguments, cwd=tmp_path)
    assert finished.returncode == 2
    assert finished.stderr.startswith("error: ") and finished.stderr.count("\n") == 1
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("columns", [80, 120])
def test_the_help_breaks_no_line_within_a_sentence(columns: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    printed = run_jcr("run", "--help").stdout
    assert "(default: None)" not in printed and "(default: )" not in printed
    text = printed.partition("--require ")[2].partition("--robot-noise ")[0].splitlines()[1:-1]
    assert len(text) > 2
    # No word that begins a line would have had room in the line before it.
    for line, following in pairwise(text):
        assert len(f"{line.rstrip()} {following.split()[0]}") > columns, line


def test_each_option_is_listed_by_the_help_of_its_command_or_by_one_that_this_help_names():
    def listed(name: str) -> set[str]:
        return {*re.findall(r"^. (--[a-z-]+)", run_jcr(name, "--help").stdout, re.MULTILINE)}

    for name in COMMANDS:
        text = run_jcr(name, "--help").stdout
        named = re.findall(r"^  jcr ([a-z-]+) --help  ", text, re.MULTILINE)
        found = set().union(listed(name), *map(listed, named))
        missing = {*_flags(command(name))} - found
        assert not missing, (name, missing)
        assert len(text.splitlines()) < 125, name


def test_a_rejected_check_prints_the_command_with_the_option_that_reads_the_poses():
    details = {"reading": "angles", "remedy": "give it", "fits": "1 mm", "given": "9 mm"}
    read = {"pose_convention": "euler:xyz", "pose_inverted": 1.0}
    cause = Finding.of(FindingKind.POSE_CONVENTION, "rejects", "poses", value=0.0, **details, **read)
    command: Any = CheckCommand(capture=Path("c"))
    read_from = Reading(file="p.csv", decided_by="names")
    capture = capture_of(np.tile(np.eye(4), (3, 1, 1)), reading=read_from)
    found: Any = SimpleNamespace(findings=(cause,), capture=capture)
    expected = "jcr check c --pose-convention euler:xyz --pose-inverted"
    assert _command_of_remedy(command, found) == expected


def test_compared_calibrations_agree_or_differ(tmp_path: Path):
    for name, x_m, deg in (("a", 0.0, 0.0), ("b", 0.0003, 0.1), ("c", 0.17, 0.0), ("d", 0.0, 2.0)):
        pose = transform(rotation_exp(np.array([0.0, np.radians(deg), 0.0])), np.array([x_m, 0.05, 0.1]))
        errors = {"std_mm": [0.5] * 3, "std_deg": [0.1] * 3}
        content = {"gripper_from_camera": pose.tolist()} | errors
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    np.savetxt(tmp_path / "bare.txt", pose)
    bare = run_jcr("compare", "a.json", "bare.txt", cwd=tmp_path).stdout
    assert bare.splitlines()[0].endswith("; bare.txt states no errors") and bare.startswith("DIFFER")
    close, far, turned = (run_jcr("compare", "a.json", f"{name}.json", cwd=tmp_path) for name in "bcd")
    assert close.returncode == 0 and close.stdout.startswith("AGREE: 0.300 mm")
    assert far.returncode == 3 and far.stdout.startswith("DIFFER: 170.000 mm")
    assert "of the same camera and gripper frame" in far.stdout
    assert turned.returncode == 3 and turned.stdout.startswith("DIFFER: 0.000 mm, 2.0000° apart")


def test_a_comparison_with_a_rejected_calibration_decides_nothing_and_names_no_cause():
    found = run_jcr("compare", CALIBRATIONS / "accepted.json", CALIBRATIONS / "rejected.json")
    assert found.returncode == 3 and found.stdout.startswith("NOT DECIDED: ")
    assert "rejected.json is rejected" in found.stdout.splitlines()[0]
    assert "remove the cause of the rejection" in found.stdout and "the camera moved" not in found.stdout


def test_long_lines_are_wrapped_below_their_label_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch):
    lines = [*labelled("WARNING", " ".join(["word"] * 30)), *labelled("Next", "jcr run " + "a " * 60)]
    for is_terminal in (False, True):
        output = io.StringIO()
        monkeypatch.setattr(output, "isatty", lambda is_terminal=is_terminal: is_terminal, raising=False)
        monkeypatch.setattr(sys, "stdout", output)
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.delenv("NO_COLOR", raising=False)
        write_lines(lines)
        coloured = output.getvalue()
        assert coloured.startswith("\033[1;33mWARNING\033[0m ") == is_terminal
        *wrapped, following = re.sub(r"\033\[[0-9;]*m", "", coloured).splitlines()
        assert following == lines[-1], "a command to copy stays on one line"
        assert wrapped == lines[:-1] if not is_terminal else max(map(len, wrapped)) <= 80
    output.truncate(output.seek(0))
    write_lines(["ACCEPTED (5 mm)", "ACCEPTED, BUT NOT AS EXACT AS NEEDED", "REJECTED: no"])
    assert re.findall(r"\033\[1;(\d+)m", output.getvalue()) == ["32", "33", "31"]
    assert wrapped[1].startswith(" " * INDENT + "word") and len(wrapped) > 1


def test_wrong_input_is_refused_before_a_camera_is_opened_or_a_map_read(tmp_path: Path):
    wrong = run_jcr("capture", tmp_path / "out", "--camera", 77, "--poses", "ure:1")
    assert wrong.returncode == 2 and wrong.stderr.startswith("error: --poses ure:1: give ur:HOST")
    wrong = run_jcr(
        "capture", tmp_path / "out", "--camera", 77, "--poses", "http", "--verify", tmp_path / "none"
    )
    assert wrong.returncode == 2 and "none" in wrong.stderr and "kept" not in wrong.stderr
    (tmp_path / "file").touch()
    wrong = run_jcr("capture", tmp_path / "file" / "out", "--camera", 77)
    assert wrong.stderr == f"error: {tmp_path / 'file'}: is a file; name a folder for the results\n"
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,0\n0,nan,0\n")
    with refused(r"points\.csv: point 2 is not three finite numbers"):
        read_points(tmp_path / "points.csv")
    (tmp_path / "0.jpg").touch()
    wrong = run_jcr("check", tmp_path / "0.jpg")
    assert wrong.returncode == 2 and "0.jpg: is one image; name the folder" in wrong.stderr
    for header in ("x,y,height", "x_mm,y_mm,z_mm"):
        (tmp_path / "points.csv").write_text(f"{header}\n0,0,0\n")
        with refused("name them x, y, z and give metres"):
            read_points(tmp_path / "points.csv")
    (tmp_path / "points.csv").write_text("y_m,z_m,x_m\n2,3,1\n5,6,4\n")
    assert read_points(tmp_path / "points.csv").tolist() == [[1, 2, 3], [4, 5, 6]]
    assert [file.name for file in tmp_path.iterdir()].count("out") == 0


@pytest.mark.slow
def test_a_reader_that_ends_early_is_no_success():
    """`jcr run … | head` was stopped in the middle with exit status 0."""
    asked = subprocess.Popen(
        [sys.executable, "-m", "jcr", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    asked.stdout.close()
    assert asked.wait() == 141 and not asked.stderr.read()
    asked.stderr.close()
