"""The table of back ends, the options that select one, and which result `--backend auto` keeps and why."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr import backends
from jcr.backends import BACKENDS, Backend, ReconstructOptions, candidates, tries
from jcr.calibration import calibrate as calibration_stage
from jcr.calibration.checks import convention
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.cli import dispatch
from jcr.errors import InputError, RejectedError
from jcr.findings import Finding, FindingKind
from jcr.pipeline import backend_selection
from jcr.pipeline.stages import begun
from jcr.records import Capture, Reconstruction, Tracks
from jcr.result import RunOptions, RunResult
from refusal import refused
from scenes import capture_of, reconstruction_of
from simulation.problems import HandEyeProblem, hand_eye_problem


def test_colmap_comes_first_then_networks_whose_weights_are_here_then_direct_alignment(present, monkeypatch):
    assert candidates(ReconstructOptions()) == ("colmap", "direct")
    present |= {"dust3r", "da3"}
    assert candidates(ReconstructOptions()) == ("colmap", "dust3r", "da3", "direct")
    present |= {"mast3r", "da3-small"}
    tried = [one.backend for one in tries(ReconstructOptions(features="auto"))]
    assert list(dict.fromkeys(tried)) == ["colmap", "mast3r", "da3", "direct"], "one network of each kind"
    monkeypatch.setattr(Backend, "is_installed", lambda self: self.name != "da3")
    assert candidates(ReconstructOptions())[3:] == ("da3-small", "direct")
    assert candidates(ReconstructOptions(backend="colmap")) == ("colmap",)


def test_without_weights_the_command_to_get_them_is_named(present: set[str], monkeypatch: pytest.MonkeyPatch):
    capture = capture_of(np.eye(4)[None])
    for installed, words in (
        (
            False,
            "needs depth_anything_3, .*: pip install .*; then jcr models get da3 downloads .* \\(0.5 GB\\)",
        ),
        (True, "DA3-BASE: not on this machine; jcr models get da3 downloads"),
    ):
        monkeypatch.setattr(Backend, "is_installed", lambda self, there=installed: there)
        monkeypatch.setattr(backends, "cached_files", lambda *of: [])
        with refused(words):
            backends.reconstruct(capture, ReconstructOptions(backend="da3"))


def test_an_option_of_one_back_end_selects_it(present: set[str]) -> None:
    present |= {"mast3r", "dust3r"}
    for options, names in {
        ReconstructOptions(predictions=Path("pairs.npz")): ("predictions",),
        ReconstructOptions(cameras=Path("sparse")): ("given",),
        ReconstructOptions(board="chessboard:9x6:0.025"): ("colmap", "marker"),
        ReconstructOptions(backend="marker", board="chessboard:9x6:0.025"): ("marker",),
        ReconstructOptions(board="chessboard:9x6:0.025", cameras=Path("sparse")): ("given", "marker"),
        ReconstructOptions(weights="folder"): ("dust3r", "colmap"),
        ReconstructOptions(backend="mast3r", weights="folder"): ("mast3r",),
    }.items():
        assert candidates(options) == names


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (ReconstructOptions(backend="colmap", predictions=Path("p.npz")), "--predictions p.npz: .*predictions"),
        (ReconstructOptions(backend="predictions", weights="p.npz"), "weights p.npz: .*mast3r or dust3r or da3"),
        (ReconstructOptions(backend="direct", board="b"), "--board b: .*colmap or marker or given"),
        (ReconstructOptions(board="b", predictions=Path("c")), r"--board b: .*\(predictions\) does not use it"),
        (ReconstructOptions(weights="w", predictions=Path("p")), "--weights and --predictions select"),
    ],
)  # fmt: skip
def test_what_a_back_end_does_not_use_is_refused(options: ReconstructOptions, words: str, present: set[str]):
    with refused(words):
        candidates(options)


@pytest.mark.parametrize(
    ("name", "option"), [("marker", "board"), ("predictions", "predictions"), ("given", "cameras")]
)
def test_a_back_end_without_its_input_names_the_option(name: str, option: str) -> None:
    with refused(f"backend {name}: give the option {option},"):
        backends.reconstruct(capture_of(np.eye(4)[None]), ReconstructOptions(backend=name))


def test_a_changed_file_of_predictions_is_another_input(tmp_path: Path) -> None:
    capture = capture_of(np.zeros((0, 4, 4)), folder=tmp_path)
    for name in ("predictions", "cameras"):
        path = tmp_path / name
        path.write_text("one")
        options = RunOptions(reconstruct=replace(ReconstructOptions(), **{name: path}))
        before = begun(tmp_path, capture, options).state.made
        assert begun(tmp_path, capture, options).state.made == before
        path.write_text("another")
        assert begun(tmp_path, capture, options).state.made != before


def test_models_are_listed_with_licence_scale_and_what_is_present(capsys: pytest.CaptureFixture[str]) -> None:
    assert dispatch(["models", "--json"]) == 0
    rows = {(row["backend"], row["weights"]): row for row in json.loads(capsys.readouterr().out)["models"]}
    assert rows["colmap", ""]["present"] == "yes"
    assert "non-commercial" in rows["mast3r", BACKENDS["mast3r"].hub_id]["licence"]
    assert rows["da3", BACKENDS["da3"].hub_id]["licence"] == "Apache-2.0"
    assert {row.name for row in BACKENDS.values()} == {name for name, _ in rows}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch):
    """The search for other readings of the poses takes seconds and is tested elsewhere, and there are no images."""
    monkeypatch.setattr(convention, "better_reading", lambda *_: ())
    monkeypatch.setattr(backend_selection, "view_findings", lambda _: ())
    monkeypatch.setattr(backend_selection, "calibrate_reconstruction", calibrated_once)


KNOWN: dict[object, Calibration] = {}


def calibrated_once(capture: Capture, made: Reconstruction, options: CalibrateOptions) -> Calibration:
    """Calibrate; the same poses, which come again and again, once."""
    poses = capture.base_from_gripper.tobytes(), made.recon_from_camera.tobytes()
    key = poses, made.backend, len(made.tracks.image), options
    if key not in KNOWN:
        KNOWN[key] = calibration_stage.calibrate_reconstruction(capture, made, options)
    return KNOWN[key]


def reconstruction(backend: str, poses: np.ndarray, observations: int = 0) -> Reconstruction:
    n = observations
    tracks = Tracks(
        image=np.zeros(n, int), x_px=np.zeros((n, 2)), point=np.arange(n), points_in_recon=np.zeros((n, 3))
    )
    return reconstruction_of(poses, tracks=tracks, backend=backend)


def auto_result(
    problem: HandEyeProblem,
    answers: dict[str, np.ndarray | Exception],
    monkeypatch: pytest.MonkeyPatch,
    observations: int = 0,
) -> tuple[Reconstruction, list[str]]:
    """What auto keeps where each back end, or features, give these camera poses or this error; which ones it ran."""
    tried = []

    def answered(capture: Capture, options: ReconstructOptions, progress: object) -> Reconstruction:
        tried.append(options.backend)
        answer = answers[options.backend if options.features == "auto" else options.features]
        if isinstance(answer, Exception):
            raise answer
        return reconstruction(options.backend, answer, observations)

    monkeypatch.setattr(backend_selection, "reconstruct", answered)
    made, found = backend_selection.select_reconstruction(capture_of(problem.base_from_gripper), RunOptions())
    assert [attempt.backend for attempt in found.attempts] == tried
    kept = [attempt for attempt in found.attempts if attempt.why_not is None]
    assert [attempt.backend for attempt in kept] == [made.backend]
    return made, tried


@pytest.mark.slow
def test_a_second_one_runs_only_if_the_first_is_rejected(present: set[str], monkeypatch: pytest.MonkeyPatch):
    present.add("mast3r")
    rng = np.random.default_rng(0)
    problem = hand_eye_problem(rng, 8, robot_noise=(2e-4, 5e-4))
    good = problem.recon_from_camera
    shuffled = good[rng.permutation(8)]

    kept, tried = auto_result(problem, {"colmap": good}, monkeypatch)
    assert tried == ["colmap"] and kept.backend == "colmap" and not kept.notes

    kept, tried = auto_result(problem, {"colmap": shuffled, "mast3r": good}, monkeypatch)
    assert tried == ["colmap", "mast3r"] and kept.backend == "mast3r"
    assert kept.notes[0].startswith("back end colmap (leave-one-out error ")
    assert "is rejected (" in kept.notes[0] and "; mast3r (leave-one-out error" in kept.notes[0]

    nothing = RejectedError("0 of 8 images registered")
    kept, _ = auto_result(problem, {"colmap": nothing, "mast3r": good}, monkeypatch)
    assert kept.backend == "mast3r" and "colmap failed (0 of 8" in kept.notes[0]
    damaged = InputError("model.safetensors: damaged")
    kept, tried = auto_result(problem, {"colmap": nothing, "mast3r": damaged, "direct": good}, monkeypatch)
    assert kept.backend == "direct" and "mast3r failed (model.safetensors: damaged)" in kept.notes[0]
    kept, _ = auto_result(problem, {"colmap": shuffled, "mast3r": damaged, "direct": nothing}, monkeypatch)
    assert kept.backend == "colmap" and "direct failed (0 of 8" in kept.notes[0]
    with pytest.raises(RejectedError, match="0 of 8.*mast3r failed"):
        auto_result(problem, {"colmap": nothing, "mast3r": damaged, "direct": nothing}, monkeypatch)


def test_of_two_rejected_the_one_that_shows_a_cause_stays(present: set[str], monkeypatch: pytest.MonkeyPatch):
    """Whatever its leave-one-out error, which a cause makes large."""
    present.add("mast3r")
    problem = hand_eye_problem(np.random.default_rng(0), 8, robot_noise=(2e-4, 5e-4))
    sound = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    uncertain = Finding(
        kind=FindingKind.UNCERTAIN, severity="rejects", concerns="images", value=0.03,
        details={"part": "translation"},
    )  # fmt: skip
    sheared = Finding(kind=FindingKind.ROLLING_SHUTTER, severity="rejects", value=9.0, std=0.5, p=1e-9)
    held_out = sound.held_out
    assert held_out is not None
    of_backend = {
        "colmap": sound.with_findings(uncertain),
        "mast3r": replace(sound, held_out=replace(held_out, translation_mm=40.0)).with_findings(
            uncertain, sheared
        ),
    }
    monkeypatch.setattr(
        backend_selection, "calibrate_reconstruction", lambda _, made, __: of_backend[made.backend]
    )
    poses = problem.recon_from_camera
    kept, tried = auto_result(problem, {"mast3r": poses, "colmap": poses}, monkeypatch)
    assert tried == ["colmap", "mast3r"] and kept.backend == "mast3r"
    assert "it shows the cause" in kept.notes[0]


@pytest.mark.slow
def test_of_two_rejected_the_least_leave_one_out_error_stays(present: set[str], monkeypatch):
    present.add("dust3r")
    rng = np.random.default_rng(1)
    problem = hand_eye_problem(rng, 8)
    poor, hopeless = (
        hand_eye_problem(np.random.default_rng(1), 8, camera_noise=(size, 4 * size)).recon_from_camera
        for size in (0.05, 0.3)
    )
    for answers, name in (
        ({"dust3r": poor, "colmap": hopeless}, "dust3r"),
        ({"dust3r": hopeless, "colmap": poor}, "colmap"),
    ):
        nothing = {"direct": RejectedError("0 of 8 images registered")}
        kept, tried = auto_result(problem, answers | nothing, monkeypatch)
        assert tried == ["colmap", "dust3r", "direct"] and kept.backend == name
        assert f"{name} (leave-one-out error" in kept.notes[0] and "the smaller one" in kept.notes[0]


@pytest.mark.slow
def test_what_many_features_reject_colours_do_not_accept(present: set[str], monkeypatch: pytest.MonkeyPatch):
    """Direct alignment tests no camera: a stronger fault, which features reject, would get the less honest answer."""
    present |= {"xfeat", "da3"}
    monkeypatch.setattr(backend_selection, "TEXTURED", 10)
    problem = hand_eye_problem(np.random.default_rng(3), 8)
    good = problem.recon_from_camera
    shuffled = good[np.random.default_rng(4).permutation(8)]
    answers = {"sift": shuffled, "xfeat": shuffled, "da3": good, "direct": good}
    kept, tried = auto_result(problem, answers, monkeypatch, observations=80)
    assert tried == ["colmap"] and kept.backend == "colmap"
    assert kept.notes[0].endswith("and they register 8 of 8 images"), "other features would show the same"
    assert kept.notes[1].startswith("da3 was not tried: it is for scenes without features")
    _, tried = auto_result(problem, answers | {"sift": shuffled[:6]}, monkeypatch, observations=80)
    assert tried == ["colmap", "colmap"], "of images that SIFT left out, learned features may register more"
    _, tried = auto_result(problem, answers, monkeypatch, observations=79)
    assert tried == ["colmap", "colmap", "da3"]
    # A scene full of features that agree on nothing is none without features; one of too few of them is.
    lost = RejectedError("0 of 8 images registered", despite_texture=True)
    with pytest.raises(RejectedError, match="0 of 8.*da3 was not tried"):
        auto_result(problem, answers | {"sift": lost, "xfeat": lost}, monkeypatch)
    few = RejectedError("0 of 8 images registered").with_more("too little texture")
    _, tried = auto_result(problem, answers | {"sift": few, "xfeat": lost}, monkeypatch)
    assert tried == ["colmap", "colmap", "da3"]


@pytest.mark.slow
def test_every_attempt_is_recorded_with_the_time_of_each_stage(present, tmp_path, tabletop, monkeypatch):
    from jcr.capture.read import read_capture
    from jcr.pipeline.run import calibrate

    problem = hand_eye_problem(np.random.default_rng(3), 12)
    capture = replace(read_capture(tabletop), base_from_gripper=problem.base_from_gripper)
    shuffled = problem.recon_from_camera[np.random.default_rng(4).permutation(12)]
    made, now_s = [], [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now_s[0])

    def door(capture: Capture, options: ReconstructOptions, progress: object) -> Reconstruction:
        made.append(options.backend)
        now_s[0] += {"colmap": 20.0, "direct": 400.0}[options.backend]
        poses = {"colmap": shuffled, "direct": problem.recon_from_camera}[options.backend]
        return reconstruction(options.backend, poses)

    def slow(*arguments: object) -> Calibration:
        now_s[0] += 3.0
        return calibration_stage.calibrate_reconstruction(*arguments)

    monkeypatch.setattr(backend_selection, "reconstruct", door)
    monkeypatch.setattr(backend_selection, "calibrate_reconstruction", slow)
    calibrate(capture, tmp_path)
    content = json.loads((tmp_path / "calibration.json").read_text())
    colmap, direct = content["attempts"]
    assert (colmap["backend"], direct["backend"]) == ("colmap", "direct")
    assert colmap["images_registered"] == direct["images_registered"] == 12
    assert colmap["why_not"].startswith("rejected: ") and direct["why_not"] is None
    assert (colmap["reconstruct_s"], direct["reconstruct_s"]) == (20.0, 400.0)
    assert (colmap["calibrate_s"], direct["calibrate_s"]) == (3.0, 3.0)
    assert content["timings_s"] == {"reconstruct": 420.0, "calibrate": 6.0, "report": 0.0}
    # With other options of the calibration none is tried again: the account of the selection stays, with new times.
    calibrate(capture, tmp_path, RunOptions(calibrate=CalibrateOptions(require=(50.0, 9.0))))
    again = RunResult(tmp_path).calibration
    assert made == ["colmap", "direct"]
    assert again.as_json()["attempts"] == content["attempts"]
    assert again.timings_s == {"reconstruct": 0.0, "calibrate": 3.0, "report": 0.0}


def test_where_nothing_is_found_each_attempt_reports_why(present, tmp_path, tabletop, monkeypatch):
    from jcr.capture.read import read_capture
    from jcr.pipeline.run import calibrate

    def door(capture: Capture, options: ReconstructOptions, progress: object) -> Reconstruction:
        raise RejectedError(f"{options.backend} saw nothing")

    monkeypatch.setattr(backend_selection, "reconstruct", door)
    with pytest.raises(RejectedError, match="direct saw nothing; back end colmap failed"):
        calibrate(read_capture(tabletop), tmp_path)
    tried = RunResult(tmp_path).calibration.attempts
    assert [(attempt.backend, attempt.images_registered, attempt.why_not) for attempt in tried] == [
        ("colmap", None, "colmap saw nothing"),
        ("direct", None, "direct saw nothing"),
    ]
    report = (tmp_path / "report.html").read_text()
    for backend in ("colmap", "direct"):
        assert re.search(rf"<b>{backend}</b>, [\d.]+ s: {backend} saw nothing</li>", report)
