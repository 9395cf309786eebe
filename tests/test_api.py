"""The names of the package, and that pycolmap may be imported before or after it."""

import inspect
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest

import jcr
from corpus import sound_run
from jcr.camera import project
from jcr.capture.images import encode_png
from jcr.capture.options import ReadOptions
from jcr.geometry import apply, rotation_exp, transform
from jcr.options import checked_options
from jcr.result import RunOptions
from places import ROOT
from refusal import refused


def test_the_api_is_listed_and_every_name_of_it_is_there():
    assert set(jcr.__all__) <= set(dir(jcr)) and "__version__" in dir(jcr)
    assert all(hasattr(jcr, name) for name in dir(jcr))
    assert len(set(jcr.__all__)) == len(jcr.__all__)
    with pytest.raises(AttributeError, match="No jcr attribute check; did you mean check_capture?"):
        _ = jcr.check  # pyright: ignore[reportAttributeAccessIssue]


def _types_of(hint: object) -> set[type]:
    return {hint} if isinstance(hint, type) else set().union(*map(_types_of, get_args(hint)))


def _own_types(value: Any) -> set[type]:
    """The types of jcr that annotations name, those that only type checkers import among them."""
    known = {**vars(sys.modules[value.__module__]), **{name: getattr(jcr, name) for name in jcr.__all__}}
    found = set().union(*map(_types_of, get_type_hints(value, known).values()))
    return {kind for kind in found if kind.__module__.startswith("jcr")}


def test_every_type_of_a_public_function_has_a_public_name():
    """Of functions, and of the methods and properties of what they take and return."""
    pytest.importorskip("torch")
    public = {getattr(jcr, name) for name in jcr.__all__}
    functions = [*filter(inspect.isfunction, public)]
    for record in filter(inspect.isclass, public):
        members = [value for name, value in vars(record).items() if not name.startswith("_")]
        own = [getattr(one, "fget", None) or getattr(one, "__func__", one) for one in members]
        functions += [one for one in own if inspect.isfunction(one) and one.__module__.startswith("jcr")]
    assert len(functions) > 80, "the annotations are read"
    for value in (*functions, jcr.RunOptions, jcr.RunResult, jcr.SegmentOptions):
        assert _own_types(value) <= public, value


@pytest.mark.slow
def test_others_write_pngs_and_archives_where_jcr_came_first_and_a_later_import_is_warned_of():
    write = "Image.effect_noise((640, 480), 50).save(io.BytesIO(), 'PNG'); zlib.compress(b'a' * 10000)"
    code = f"import jcr, pycolmap, io, zlib; from PIL import Image; {write}", "import pycolmap, jcr"
    first, second = (
        subprocess.run([sys.executable, "-c", one], capture_output=True, text=True, timeout=120)
        for one in code
    )
    assert first.returncode == 0, first.stderr
    assert "import jcr first" in second.stderr and "import jcr first" not in first.stderr


@pytest.mark.parametrize(
    ("shape", "kind"),
    [((7, 5, 3), np.uint8), ((480, 640), np.uint8), ((480, 640), np.uint16), ((1, 1), np.uint16)],
)
def test_a_png_holds_the_same_pixels(shape: tuple[int, ...], kind: type):
    pixels = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    file = encode_png(pixels[::-1])
    read = np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED))
    np.testing.assert_array_equal(read[..., ::-1] if pixels.ndim == 3 else read, pixels[::-1])


@pytest.mark.parametrize(("options", "message"), [
    ({"mapp": None}, "RunOptions: no option 'mapp'; did you mean map?"),
    ({"calibrate": {"reqire": (1, 1)}}, "CalibrateOptions: no option 'reqire'; did you mean require?"),
    ({"calibrate": {"require": (1, "far")}}, "require: give (MM, DEG) or 'none', not (1, 'far')"),
    ({"calibrate": {"require": 2}}, "CalibrateOptions: require: give (MM, DEG) or 'none', not 2"),
    ({"reconstruct": {"backend": "colmp"}}, "did you mean colmap?"),
])  # fmt: skip
def test_wrong_options_are_input_errors_before_any_work(options, message: str, tmp_path: Path):
    with refused(re.escape(message)):
        jcr.run("nowhere", tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_options_take_text_for_paths_lists_for_tuples_and_name_what_they_are(tabletop: Path):
    found = checked_options({"poses": "poses.csv", "episode": [0, 2]}, ReadOptions)
    assert found == ReadOptions(poses=Path("poses.csv"), episode=(0, 2))
    assert checked_options(None, RunOptions) == RunOptions()
    assert jcr.read_capture(str(tabletop), {"base_frame": "base"}).images
    with refused("--pose-convention 'kukka': not one of .*did you mean kuka"):
        jcr.read_capture(tabletop, {"pose_convention": "kukka"})
    with refused(r"RunOptions: map: False: give jcr.MapOptions.*None for no map"):
        checked_options({"map": False}, RunOptions)
    with refused("give jcr.RunOptions"):
        checked_options(ReadOptions(), RunOptions)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_an_object_that_is_no_path_is_an_input_error(tabletop: Path):
    """In a process of its own, because the tests check annotations."""
    calls = (
        *("read_capture(3)", f"calibrate(jcr.read_capture({str(tabletop)!r}), None)", "load_run(None)"),
        *("verify_run('nowhere', 3)", "add_camera('nowhere', 'side', [3])", "export_run(None, 'ros2')"),
        *("touch('nowhere', None)", "build_map(3).state"),
    )
    code = "import jcr\n" + "".join(
        f"try: jcr.{one}\nexcept jcr.InputError as error: print(error)\n" for one in calls
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert len(lines) == len(calls) and all("is no path; give text or" in line for line in lines), done


def test_a_run_is_loaded_and_compared_by_path_record_and_matrix(tmp_path: Path):
    out = sound_run(tmp_path)
    loaded = jcr.load_run(str(out))
    assert loaded.verdict == loaded.calibration.verdict and loaded.converged == loaded.calibration.converged
    assert loaded.covariance.shape == (7, 7)
    assert (
        loaded.findings == loaded.calibration.findings and loaded.intrinsics == loaded.calibration.intrinsics
    )
    assert re.fullmatch(
        r"<RunResult .*: accepted, \d+ of \d+ images, a point within [\d.]+ mm \(95 %\)>", repr(loaded)
    )
    assert "no such file" in repr(jcr.RunResult(tmp_path / "nothing"))
    with refused("the camera's mount is gripper: read gripper_from_camera and"):
        _ = loaded.base_from_camera
    matrix = loaded.gripper_from_camera.tolist()
    for other in (str(out), out, loaded, loaded.calibration, matrix):
        assert jcr.compare(loaded, other).chi2 == pytest.approx(0, abs=1e-9)
    matrix[0][3] += 0.01
    assert np.abs(jcr.compare(loaded, matrix).translation_m) == pytest.approx([0.01, 0, 0])
    with refused(r"shape \(2,\); give a 4×4"):
        jcr.compare(loaded, [1.0, 2.0])
    with refused(r"reconstruction.npz: no such file"):
        jcr.touch(str(out), "touched.csv")


def test_a_pixel_and_its_depth_give_a_point_in_the_base_from_lists_and_arrays(tmp_path: Path):
    shutil.copy(ROOT / "tests" / "calibrations" / "accepted.json", tmp_path / "calibration.json")
    run = jcr.load_run(tmp_path)
    camera, x = run.intrinsics, run.gripper_from_camera
    assert camera is not None
    gripper = transform(rotation_exp(np.array([0.1, -0.2, 0.3])), np.array([0.4, 0.1, 0.5]))
    x_in_camera = np.array([[0.05, -0.04, 0.5], [-0.1, 0.02, 0.7]])
    pixels = project(camera, x_in_camera)
    found, covariance = run.point_in_base(pixels.tolist(), [0.5, 0.7], gripper.tolist())
    assert found == pytest.approx(apply(gripper @ x, x_in_camera), abs=1e-9)
    single, of_single = run.point_in_base(pixels[1], 0.7, gripper)
    assert single == pytest.approx(found[1]) and of_single == pytest.approx(covariance[1])
    assert np.linalg.eigvalsh(covariance).min() > 0
    for pixel, depth_m, pose, fault in (
        ([320, 240], -0.4, gripper, "no depth"),
        ([320, 240], 500.0, gripper, "no depth"),  # millimetres
        ([320, 240], np.nan, gripper, "no depth"),
        ([-20, 240], 0.4, gripper, "outside of the image"),
        ([320, 240], 0.4, transform(gripper[:3, :3], 1e3 * gripper[:3, 3]), "these look like millimetres"),
        ([320], 0.4, gripper, "x and y"),
        ([[320, 240]] * 2, [0.4] * 3, gripper, "one depth for each"),
        ([320, 240], 0.4, gripper[:3, :3], "4×4"),
        ([320, 240], 0.4, 2 * gripper, "base_from_gripper: "),
    ):
        with refused(fault):
            run.point_in_base(pixel, depth_m, pose)
