"""The table of back ends: a row is all that a new one takes, and no option that it does not use passes silently."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr import reconstruct as backends
from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.pipeline.stages import begun
from jcr.reconstruct import (
    BACKENDS,
    Backend,
    ReconstructOptions,
    candidates,
    tries,
    with_cameras_of,
)
from jcr.result import RunOptions
from scenes import capture_of


def test_colmap_comes_first_then_networks_whose_weights_are_here_then_direct_alignment(
    present: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert candidates(ReconstructOptions()) == ("colmap", "direct")
    present |= {"dust3r", "da3"}
    assert candidates(ReconstructOptions()) == ("colmap", "dust3r", "da3", "direct")
    present |= {"mast3r", "da3-small"}
    tried = [one.backend for one in tries(ReconstructOptions(features="auto"))]
    assert list(dict.fromkeys(tried)) == ["colmap", "mast3r", "da3", "direct"], "one network of each kind"
    monkeypatch.setattr(Backend, "is_installed", lambda self: self.name != "da3")
    assert candidates(ReconstructOptions())[3:] == ("da3-small", "direct")
    assert candidates(ReconstructOptions(backend="colmap")) == ("colmap",)


def test_without_weights_the_command_that_gets_them_is_said_in_a_line(
    present: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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
        ReconstructOptions(backend="mast3r", weights="folder"): ("mast3r",),
    }.items():
        assert candidates(options) == names


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (ReconstructOptions(backend="colmap", predictions=Path("p.npz")), "--predictions p.npz: .*predictions"),
        (ReconstructOptions(backend="predictions", weights="p.npz"), "--weights p.npz: .*mast3r or dust3r or da3"),
        (ReconstructOptions(backend="direct", board="b"), "--board b: .*colmap or marker or given"),
        (ReconstructOptions(board="b", predictions=Path("c")), r"--board b: .*\(predictions\) does not use it"),
        (ReconstructOptions(weights="w", predictions=Path("p")), "--weights and --predictions select"),
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
    capture = capture_of(np.eye(4)[None])
    with pytest.raises(InputError, match=f"--backend {name}: name the .* with {flag}[ ,]"):
        backends.reconstruct(capture, ReconstructOptions(backend=name))


def test_the_captures_own_cameras_are_taken_where_nothing_else_is_asked_for(tmp_path: Path) -> None:
    capture = capture_of(np.eye(4)[None], folder=tmp_path, cameras=tmp_path / "sparse")
    for options in (ReconstructOptions(), ReconstructOptions(backend="given"), ReconstructOptions(board="b")):
        assert with_cameras_of(capture, options) == replace(options, cameras=tmp_path / "sparse")
        assert candidates(with_cameras_of(capture, options))[0] == "given"
    for options in (ReconstructOptions(backend="colmap"), ReconstructOptions(cameras=Path("mine"))):
        assert with_cameras_of(capture, options) == options


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
