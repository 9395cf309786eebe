"""The table of back ends: a row is all that a new one takes, and no option that it does not use passes silently."""

import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jcr import reconstruct as backends
from jcr import run_folder
from jcr.calibration.options import CalibrateOptions
from jcr.cli import call, dispatch, models, run
from jcr.errors import InputError
from jcr.pages import page
from jcr.reconstruct import (
    BACKENDS,
    Backend,
    ReconstructOptions,
    candidates,
    for_backend,
    with_cameras_of,
)
from jcr.records import Capture

MINE = """
        Backend(
            name="mine",
            reconstruct=lambda capture, options, progress: (options.backend, len(capture)),
            licence="MIT",
            metric=True,
            auto=True,
            options=("weights",),
            accuracy="9 mm",
        ),
"""


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the back ends whose weights are to count as present; none at first."""
    names: set[str] = set()
    monkeypatch.setattr(Backend, "has_weights", lambda self: not self.hub_id or self.name in names)
    monkeypatch.setattr(Backend, "is_installed", lambda self: True)
    return names


@pytest.fixture
def with_mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module as it would be with one more row in its table, before the others, and nothing else changed."""
    source = Path(backends.__file__).read_text()
    begin = "    for row in (\n"
    assert source.count(begin) == 1
    path = tmp_path / "backends_with_mine.py"
    path.write_text(source.replace(begin, begin + MINE.removeprefix("\n")))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    return module


def test_a_new_back_end_is_one_row(
    with_mine: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert with_mine.candidates(with_mine.ReconstructOptions())[0] == "mine"
    named = with_mine.ReconstructOptions(backend="mine", weights=str(tmp_path))
    assert with_mine.candidates(named) == ("mine",) and with_mine.weights_of(named).path == tmp_path
    assert "mine" in str(with_mine.BackendName)
    with pytest.raises(InputError, match="give --backend mine or mast3r or"):
        with_mine.candidates(replace(named, backend="colmap"))

    row = Backend(**vars(with_mine.BACKENDS["mine"]))
    monkeypatch.setattr(models, "BACKENDS", {"mine": row} | BACKENDS)
    assert dispatch(["models", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["models"][0] == {
        "backend": "mine", "weights": "", "licence": "MIT", "commercial": True, "scale": "metres",
        "parameters_m": 0, "download_gb": 0.0, "present": "yes", "accuracy": "9 mm",
    }  # fmt: skip

    # The help of `jcr run`, were its options these.
    command = ModuleType("command")
    vars(command).update(Arguments=with_mine.ReconstructOptions, main=run.main)
    assert call(lambda: command, "jcr run", ["--help"]) == 0
    assert "{auto,mine,mast3r," in re.sub(r"[\s│]", "", capsys.readouterr().out)


def test_a_row_is_called_with_the_options_as_it_takes_them(with_mine: ModuleType) -> None:
    capture = Capture(
        folder=Path(),
        images=("a.png", "b.png"),
        base_from_gripper=np.stack([np.diag([1.0, 1.0, 1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])]),
        image_size=(64, 48),
    )
    seen = []
    with_mine._of_capture = lambda found, order: seen.append((found, order.tolist()))
    with_mine.reconstruct(capture, with_mine.ReconstructOptions())
    assert seen == [(("mine", 2), [1, 0])]


def test_the_best_whose_weights_are_here_comes_first(
    present: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert candidates(ReconstructOptions()) == ("colmap", "direct")
    present |= {"dust3r", "mapanything"}
    assert candidates(ReconstructOptions()) == ("dust3r", "colmap", "mapanything", "direct")
    present.add("mast3r")
    assert candidates(ReconstructOptions())[0] == "mast3r"
    monkeypatch.setattr(Backend, "is_installed", lambda self: self.name != "mapanything")
    assert candidates(ReconstructOptions()) == ("mast3r", "dust3r", "colmap", "direct")
    assert candidates(ReconstructOptions(backend="colmap")) == ("colmap",)


def test_without_weights_the_command_that_gets_them_is_said_in_a_line(
    present: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = Capture(
        folder=Path(), images=("a.png",), base_from_gripper=np.eye(4)[None], image_size=(64, 48)
    )
    for installed, words in (
        (
            False,
            "needs depth_anything_3, .*: pip install .*; then jcr models get da3 downloads .* \\(0.5 GB\\)",
        ),
        (True, "DA3-BASE: not on this machine; jcr models get da3 downloads"),
    ):
        monkeypatch.setattr(Backend, "is_installed", lambda self, there=installed: there)
        monkeypatch.setattr(backends, "cached_files", lambda *of: [])
        with pytest.raises(InputError, match=words) as caught:
            backends.reconstruct(capture, ReconstructOptions(backend="da3"))
        assert "\n" not in str(caught.value)


def test_an_option_of_one_back_end_selects_it(present: set[str]) -> None:
    present |= {"mast3r", "dust3r"}
    for options, names in {
        ReconstructOptions(predictions=Path("pairs.npz")): ("predictions",),
        ReconstructOptions(cameras=Path("sparse")): ("given",),
        ReconstructOptions(board="chessboard:9x6:0.025"): ("colmap", "marker"),
        ReconstructOptions(backend="marker", board="chessboard:9x6:0.025"): ("marker",),
        ReconstructOptions(board="chessboard:9x6:0.025", cameras=Path("sparse")): ("given", "marker"),
        ReconstructOptions(weights="folder"): ("dust3r", "colmap"),
        ReconstructOptions(weights="folder", pair_graph="window"): ("dust3r", "colmap"),
        ReconstructOptions(backend="mast3r", weights="folder"): ("mast3r",),
    }.items():
        assert candidates(options) == names


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (ReconstructOptions(backend="colmap", predictions=Path("p.npz")), "--predictions p.npz: .*predictions"),
        (ReconstructOptions(backend="predictions", weights="p.npz"), "--weights p.npz: .*mast3r or dust3r or .*mapany"),
        (ReconstructOptions(backend="direct", board="b"), "--board b: .*colmap or marker or given"),
        (ReconstructOptions(backend="mapanything", pair_graph="window"), "--pair-graph window: .*mast3r or dust3r"),
        (ReconstructOptions(pair_graph="robot"), r"--pair-graph robot: .*\(colmap, direct\) does not use it"),
        (ReconstructOptions(board="b", predictions=Path("c")), r"--board b: .*\(predictions\) does not use it"),
        (ReconstructOptions(weights="w", predictions=Path("p")), "--weights and --predictions select"),
        (ReconstructOptions(predictions=Path("p"), pair_graph="robot"), "--pair-graph robot: "),
    ],
)  # fmt: skip
def test_what_a_back_end_does_not_use_is_refused_in_a_line(
    options: ReconstructOptions, words: str, present: set[str]
) -> None:
    with pytest.raises(InputError, match=words) as caught:
        candidates(options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "flag"), [("marker", "--board"), ("predictions", "--predictions"), ("given", "--cameras")]
)
def test_a_back_end_without_its_input_shows_which_option_names_it(name: str, flag: str) -> None:
    capture = Capture(
        folder=Path(), images=("a.png",), base_from_gripper=np.eye(4)[None], image_size=(64, 48)
    )
    with pytest.raises(InputError, match=f"--backend {name}: name the .* with {flag}[ ,]"):
        backends.reconstruct(capture, ReconstructOptions(backend=name))


def test_a_second_back_end_is_spared_what_was_meant_for_the_first() -> None:
    options = ReconstructOptions(weights="folder", pair_graph="window", seed=3)
    assert for_backend(options, "dust3r") == replace(options, backend="dust3r")
    assert for_backend(options, "colmap") == ReconstructOptions(backend="colmap", seed=3)


def test_the_captures_own_cameras_are_taken_where_nothing_else_is_asked_for(tmp_path: Path) -> None:
    capture = Capture(
        folder=tmp_path,
        images=("a.png",),
        base_from_gripper=np.eye(4)[None],
        image_size=(64, 48),
        cameras=tmp_path / "sparse",
    )
    for options in (ReconstructOptions(), ReconstructOptions(backend="given"), ReconstructOptions(board="b")):
        assert with_cameras_of(capture, options) == replace(options, cameras=tmp_path / "sparse")
        assert candidates(with_cameras_of(capture, options))[0] == "given"
    for options in (
        ReconstructOptions(backend="colmap"),
        ReconstructOptions(cameras=Path("mine")),
    ):
        assert with_cameras_of(capture, options) == options


def test_options_survive_a_run_folder(tmp_path: Path) -> None:
    options = ReconstructOptions(predictions=tmp_path / "p.npz", seed=2)
    state = run_folder.state_of(
        Capture(folder=tmp_path, images=(), base_from_gripper=np.zeros((0, 4, 4)), image_size=(64, 48)),
        run_folder.MadeWith(reconstruct=options, calibrate=CalibrateOptions()),
    )
    folder = run_folder.RunFolder(tmp_path)
    folder.keep_state(state)
    assert folder.options().reconstruct == options


def test_a_changed_file_of_predictions_is_another_input(tmp_path: Path) -> None:
    capture = Capture(folder=tmp_path, images=(), base_from_gripper=np.zeros((0, 4, 4)), image_size=(64, 48))
    for name in ("predictions", "cameras"):
        path = tmp_path / name
        path.write_text("one")
        options = ReconstructOptions(**{name: path}).as_json()
        before = run_folder.fingerprint(capture, options)
        assert run_folder.fingerprint(capture, options) == before
        path.write_text("another")
        assert run_folder.fingerprint(capture, options) != before


def test_the_help_names_what_each_option_selects() -> None:
    helped = Path(backends.__file__).read_text().split("class ReconstructOptions")[1].split("def as_json")[0]
    for row in BACKENDS.values():
        if row.selected_by and not row.hub_id:
            said = helped.split(f"    {row.selected_by}: ")[1].split('"""')[1]
            assert f"selects the back end {row.name}" in said


def test_models_are_listed_with_licence_scale_and_what_is_present(capsys: pytest.CaptureFixture[str]) -> None:
    assert dispatch(["models", "--json"]) == 0
    rows = {(row["backend"], row["weights"]): row for row in json.loads(capsys.readouterr().out)["models"]}
    assert rows["colmap", ""]["present"] == "yes"
    assert "non-commercial" in rows["mast3r", BACKENDS["mast3r"].hub_id]["licence"]
    assert rows["mapanything", BACKENDS["mapanything"].hub_id]["licence"] == "Apache-2.0"
    assert {row.name for row in BACKENDS.values()} == {name for name, _ in rows}


def test_the_numbers_of_the_table_are_measured() -> None:
    for row in BACKENDS.values():
        if row.accuracy:
            numbers, where = re.fullmatch(r"(.*) \(jcr docs (.*)\)", row.accuracy).groups()
            text = page(where)
            for number in re.findall(r"\d+\.\d+(?= mm|°)", numbers):
                assert number in text, (row.name, number)
