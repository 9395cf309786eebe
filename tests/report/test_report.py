"""The report: that it says what was found, harms nobody, needs nothing, and works in a browser."""

import base64
import itertools
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chromium import Chromium
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.summary import summary
from jcr.cell.cameras_json import ArmPlacement, CameraPlacement, CamerasFile, TransformUncertainty
from jcr.cli.output import VerboseOutput
from jcr.cli.run_calibrate_batch import show
from jcr.estimation.observability import excitation
from jcr.findings import Finding, FindingKind
from jcr.geometry import inverse, transform
from jcr.number_format import decimals_of, significant
from jcr.records import COVARIANCE_ORDER, CellCamera, Reconstruction
from jcr.report.html import report_html
from jcr.report.images import MAGNIFIED, images_section
from jcr.report.motion import excitation_bars
from jcr.report.render import render
from jcr.result import RunResult
from jcr.scene.cloud import point_cloud
from jcr.scene.options import MapOptions
from jcr.segments.tabletop import label_tabletop
from scenes import NO_TRACKS, capture_of
from simulation.truth import read_truth

pytestmark = pytest.mark.slow

EVIL = "<script>alert(1)</script>&\"'.jpg"
"""The name of the second image; a legal path on every Unix."""
WRONG, UNREGISTERED = 5, 11
"""Images whose gripper pose is wrong, and that the back end did not find."""


@pytest.fixture(scope="module")
def run(done: Path, tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """The bundled run with one image less and a wrong gripper pose, in a folder and with an image of evil names."""
    from jcr.scene.build import build_scene

    truth, found = read_truth(tabletop), RunResult(done).reconstruction
    folder = tmp_path_factory.mktemp("report") / "a & <b>"
    names = [EVIL if k == 1 else name for k, name in enumerate(truth.images)]
    for name, source in zip(names, truth.images, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(tabletop / source, folder / name)
    reported = truth.base_from_gripper.copy()
    reported[WRONG, :3, 3] += [0.05, 0.0, 0.03]
    intrinsics = truth.intrinsics
    size = intrinsics.width, intrinsics.height
    capture = capture_of(reported, folder=folder, images=tuple(names), image_size=size, intrinsics=intrinsics)
    assert found.image_index[-1] == UNREGISTERED
    rows = np.arange(UNREGISTERED)
    reconstruction = replace(
        found, image_index=rows, recon_from_camera=found.recon_from_camera[rows],
        pointmaps=found.dense.of_rows(rows), tracks=found.tracks.only(found.tracks.image < UNREGISTERED),
        backend="cast", notes=("a <note> & more",), warnings=("a <pose> is off",),
    )  # fmt: skip
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    cloud = label_tabletop(point_cloud(capture, reconstruction, hand_eye))
    cloud = replace(cloud, label_names=("none", *(f"<i>{name}" for name in cloud.label_names[1:])))
    return RunResult(
        out=folder, capture=capture, calibration=hand_eye, reconstruction=reconstruction, measured=None,
        cloud=cloud, scene=build_scene(cloud, MapOptions(cell=0.02, max_seconds=1.0)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(run: RunResult) -> str:
    return report_html(run)


class Elements(HTMLParser):
    """Every element with its attributes, and the text of the page outside of scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.scripts = "", list[str]()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.cdata_elem == "script":
            self.scripts[-1] += data
        elif self.cdata_elem is None:
            self.text += data

    def copied(self, what: str) -> str:
        label = f"copy {what}"
        return next(a["data-copy"] or "" for _, a in self.found if a.get("aria-label") == label)


def test_numbers_are_those_of_the_calibration_file(run: RunResult, page: str):
    written = json.loads(json.dumps(run.calibration.as_json()))
    elements = Elements(page)
    assert json.loads(elements.copied("the matrix")) == written["gripper_from_camera"]
    x = np.array(written["gripper_from_camera"])
    np.testing.assert_allclose(json.loads(elements.copied("Translation (m)")), x[:3, 3], atol=1e-9)

    def is_rotation(rotation: Rotation) -> None:
        np.testing.assert_allclose(rotation.as_matrix(), x[:3, :3], atol=1e-8)

    is_rotation(Rotation.from_quat(json.loads(elements.copied("Quaternion"))))
    is_rotation(Rotation.from_rotvec(json.loads(elements.copied("Rotation vector (rad)"))))
    for unit, degrees in (("rad", False), ("deg", True)):
        roll, pitch, yaw = json.loads(elements.copied(f"Roll, pitch, yaw ({unit})"))
        # R = Rz(yaw) Ry(pitch) Rx(roll), as URDF means it.
        is_rotation(Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=degrees))
    ros = elements.copied("the ROS 2 command")
    values = dict(re.findall(r"--([a-z-]+) (\S+)", ros))
    assert (values["frame-id"], values["child-frame-id"]) == ("GRIPPER_FRAME", "camera_color_optical_frame")
    np.testing.assert_allclose([float(values[axis]) for axis in "xyz"], x[:3, 3], atol=1e-9)
    is_rotation(Rotation.from_quat([float(values[f"q{axis}"]) for axis in "xyzw"]))

    camera, given = run.calibration.intrinsics, run.capture.intrinsics
    assert camera is not None and given is not None and abs(camera.fx - given.fx) > 0.01
    assert f"fx {camera.fx:.2f}, fy {camera.fy:.2f}" in elements.text
    assert "intrinsics given, refined" in elements.text
    offered = json.loads(elements.copied("the covariance"))
    assert offered["order"] == list(COVARIANCE_ORDER)
    assert np.array_equal(offered["covariance"], run.found.covariance)
    leave_one_out = written["held_out"]
    said = f"{significant(leave_one_out['translation_mm'])} mm, {significant(leave_one_out['rotation_deg'])}°"
    assert f"Leave-one-out error {said}" in elements.text
    required = run.calibration.requirement
    within = (
        f"is placed within {significant(required.reached_mm)} mm and {significant(required.reached_deg)}°"
    )
    seen = f"a point seen at {significant(1e-3 * required.distance_mm)} m {within}"
    assert f"{written['verdict'].capitalize()}: {seen}" in elements.text
    mm, deg = (written["uncertainty"][name] for name in ("translation_std_mm", "rotation_std_deg"))
    stated = (
        f"translation ±{', '.join(map(significant, mm))} mm, rotation ±{', '.join(map(significant, deg))}°"
    )
    assert stated in elements.text and all(f"±{significant(std)} mm" in elements.text for std in mm)
    for image in written["images"]:
        if image["used"]:
            assert f"{significant(image['reprojection_px'])}\u00a0px" in elements.text


def test_rejected_images_are_reported_with_why(run: RunResult, page: str):
    images = run.calibration.images
    assert [k for k, image in enumerate(images) if not image.used] == [WRONG, UNREGISTERED]
    text = Elements(page).text
    for k in (WRONG, UNREGISTERED):
        assert f"Left out: {images[k].reason}" in text
    (row,) = re.findall(r'class="rejected"><th>.*?<span>(.*?)</span>', page)
    assert f"its gripper pose is {row} and" in str(images[WRONG].reason), "one number in card and table"


def test_text_from_files_stays_text(page: str):
    elements = Elements(page)
    assert "<script>alert" not in page
    # The scene's data, the images' pixels, the 3D view, the copy buttons, the large images.
    assert len(elements.scripts) == 5
    assert all(f"<i>{name}" in elements.text for name in ("table", "object 1"))
    scene = json.loads(elements.scripts[0])
    assert scene["views"][1]["name"] == Path(EVIL).name and Path(EVIL).name in elements.text
    assert EVIL in [a.get("title") for _, a in elements.found]
    assert "a & <b>" in elements.text and "a <note> & more" in elements.text


def test_page_is_one_small_file(page: str):
    assert len(page.encode()) < 4e6
    elements = Elements(page)
    loads = [a[key] for _, a in elements.found for key in ("src", "href", "srcset", "data") if a.get(key)]
    ids = {f"#{a['id']}" for _, a in elements.found if a.get("id")}
    assert loads and all(url.startswith("data:image/") or url in ids for url in loads)
    assert {"#transform", "#view", "#images", "#residuals", "#details"} <= set(loads)
    assert "url(" not in page
    assert "http:" not in page and "https:" not in page and "@import" not in page
    policy = next(a["content"] for _, a in elements.found if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy
    assert "$" not in elements.text


def test_every_camera_of_the_cell_is_in_the_scene(run: RunResult):
    """A camera on the gripper and one on another arm, of whose images one was used; each where it was then."""
    size, poses = run.capture.image_size, run.capture.base_from_gripper
    mount, base = transform(np.eye(3), np.array([0.0, 0.1, 0.0])), transform(np.eye(3), np.array([1.0, 0, 0]))
    wrist = {"mount": "gripper", "image_size": size}
    others = (
        CellCamera(name="second", images=("a", "b", "c"), frame=np.array([0, 2, UNREGISTERED]), **wrist),
        CellCamera(name="other", images=("b", "a"), arm="right", base_from_gripper=poses[:2], **wrist),
    )
    found = [
        CameraPlacement.of(
            camera,
            (),
            [90] * len(camera.images),
            px={k: 0.3 for k, name in enumerate(camera.images) if name != "b"},
            gripper_from_camera=mount,
            uncertainty=TransformUncertainty.of(1e-6 * np.eye(6), mount, 1.0),
            intrinsics=run.intrinsics,
        )
        for camera in others
    ]
    known = TransformUncertainty.of(1e-6 * np.eye(6))
    arm = ArmPlacement(name="right", base_from_other_base=base.tolist(), uncertainty=known)
    content = CamerasFile(cameras=found, arms=[arm], version="0.0")
    capture = replace(run.capture, others=others)
    page = report_html(run.with_parts(capture=capture, cloud=None, scene=None, cameras=content))
    scene = json.loads(Elements(page).scripts[0])
    drawn = {camera["name"]: np.array(camera["cameras"]) for camera in scene["others"]}
    assert {name: len(places) for name, places in drawn.items()} == {"second": 1, "other": 1}
    assert np.allclose(drawn["other"][0], (base @ poses[1] @ mount)[:3], atol=1e-6)
    camera = np.array(scene["views"][0]["camera"] + [[0, 0, 0, 1]])
    expected = camera @ inverse(run.found.gripper_from_camera) @ mount
    assert np.allclose(drawn["second"][0], expected[:3], atol=1e-5)
    assert scene["bases"][0]["name"] == "base of right"


@pytest.mark.parametrize(("source", "words"), [("given", "given, refined"), ("estimated", "estimated")])
def test_page_and_terminal_agree_on_the_source_of_the_intrinsics(run: RunResult, source: Any, words: str):
    """The terminal called refined intrinsics of a fixed camera estimated, for which there is no second pair."""
    found = replace(run.found, intrinsics_source=source, with_given_intrinsics=None)
    page = report_html(run.with_parts(calibration=found, cloud=None, scene=None))
    assert f"intrinsics {words}" in Elements(page).text and f"Intrinsics  {words}: fx" in summary(found)


def test_rejected_cameras_are_named_on_the_page_and_in_the_terminal(run: RunResult, capsys):
    """The page of a run whose further cameras are rejected was green, and its exit status 3."""
    lost = Finding.of(FindingKind.NOT_REGISTERED, "rejects", "images", "a.png", value=3.0)
    cameras = [
        CameraPlacement.of(
            CellCamera(name=name, mount="base", images=("a.png",), image_size=(64, 48)), [lost]
        )
        for name in ("left", "right")
    ]
    found = run.with_parts(
        cameras=CamerasFile(cameras=cameras, arms=[], version="0.0"), cloud=None, scene=None
    )
    text = Elements(report_html(found)).text
    for camera in cameras:
        assert f"Camera {camera.name} is rejected: {camera.doubt}" in text
    assert show(found, VerboseOutput()) == 3
    assert "left and right are rejected;" in " ".join(capsys.readouterr().out.split())


def test_cameras_alone_are_reported_without_tracks_points_or_map(run: RunResult):
    page = with_reconstruction(run, replace(run.reconstruction, backend="marker", tracks=NO_TRACKS))
    ids = {a.get("id") for _, a in Elements(page).found}
    assert "map" not in ids and {"transform", "scene", "images", "residuals", "uncertainty"} < ids
    assert "predicted colour" not in page and "points as measured" not in page
    assert "back end marker" in Elements(page).text and 'class="marks"' not in page


def with_reconstruction(run: RunResult, reconstruction: Reconstruction) -> str:
    """Return the report of the calibration of another reconstruction, without a map."""
    hand_eye = calibrate_reconstruction(run.capture, reconstruction)
    found = run.with_parts(cloud=None, scene=None, reconstruction=reconstruction)
    return report_html(found.with_parts(calibration=hand_eye))


def test_a_rejected_calibration_is_not_recommended(run: RunResult):
    still = run.capture.base_from_gripper.copy()
    still[:, :3, :3] = np.eye(3)
    cameras, of_sliding = still @ run.found.gripper_from_camera, replace(run.capture, base_from_gripper=still)
    sliding = replace(run.reconstruction, recon_from_camera=cameras[:UNREGISTERED], tracks=NO_TRACKS)
    found = Elements(with_reconstruction(run.with_parts(capture=of_sliding), sliding))
    text = found.text
    assert "Rejected:" in text and "does not support the result" in text and "Accepted:" not in text
    assert not any("data-copy" in attributes for _, attributes in found.found), (
        "a rejected transform is not copied"
    )
    bars = list(excitation_bars(excitation(still, run.found.gripper_from_camera)))
    assert [kind for kind, *_ in bars] == ["rejected"] * 3 + ["used"] * 4


def test_reprojections_are_those_of_the_run(run: RunResult, page: str):
    marks = re.findall(r'<svg class="marks" viewBox="0 0 640 480".*?d="([^"]*)"', page)
    assert len(marks) == len(run.reconstruction.image_index)
    ways = np.array([re.findall(r"l(-?\d+) (-?\d+)", path)[:20] for path in marks], float) / MAGNIFIED
    stated = [image.reprojection_px for image in run.calibration.images if image.reprojection_px]
    assert np.median(np.linalg.norm(ways, axis=-1)) == pytest.approx(np.median(stated), abs=1.5 / MAGNIFIED)
    # The lines lead from the features to the projections: features that are 3 px too far right have them on the left.
    tracks = run.reconstruction.tracks
    right = replace(run.reconstruction, tracks=replace(tracks, x_px=tracks.x_px + [3.0, 0.0]))
    cards = images_section(run.capture, run.with_parts(reconstruction=right))["cards"]
    across = [float(x) for card in cards for x in re.findall(r"l(-?\d+) ", card["marks"] or "")]
    assert np.median(across) == pytest.approx(-3 * MAGNIFIED, abs=5)
    elements = Elements(page)
    assert all(part in elements.text for part in ("left of the tick", "tracked features (red)"))


def test_numbers_have_two_digits_and_none_below_a_tenth_of_sigma():
    assert [significant(v) for v in (0.0, 1e-9, 0.0123, -0.5, 1.0, 12.34, 1234.5, np.inf)] == [
        "0", "0", "0.012", "-0.50", "1.0", "12", "1234", "unknown",
    ]  # fmt: skip
    assert [decimals_of(std) for std in (2.8e-5, 0.021, 0.1, 3.0, 40.0, np.inf)] == [5, 2, 2, 0, 0, 0]


@pytest.fixture(scope="module")
def file(page: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(page)
    return path


def test_in_a_browser(chromium: Chromium, file: Path):
    chromium.open(file.as_uri(), 1280)
    assert chromium.js("document.documentElement.scrollHeight") <= 4000
    image = chromium.image("#scene")
    drawn = image[(image != image[20, 20]).any(-1)]
    assert len(drawn) > 0.05 * image.shape[0] * image.shape[1]
    assert len(np.unique(drawn, axis=0)) > 200

    # Rotated by the mouse, it shows something else; every layer and switch changes it too.
    before = chromium.image("#scene")
    x, y = chromium.center("#scene")
    mouse = {"button": "left", "buttons": 1, "clickCount": 1}
    chromium.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **mouse)
    for k in range(1, 5):
        chromium.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + 20 * k, y=y + 5 * k, **mouse)
    chromium.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + 80, y=y + 20, **mouse)
    images = [before, chromium.image("#scene")]
    for control in (
        'input[name="scene-layer"][value="1"]',
        'input[name="scene-layer"][value="2"]',
        "#scene-cameras",
        "#scene-grippers",
        "#scene-grid",
        "#scene-tracks",
        '[data-look="[-90, 89]"]',
        '[data-through="1"]',
    ):
        chromium.js(f"document.querySelector('{control}').click()")
        images.append(chromium.image("#scene"))
    for one, two in itertools.pairwise(images):
        assert (one != two).any()
    # Out of a camera, the photograph can be laid over the map.
    assert chromium.js("document.getElementById('scene-photo').naturalWidth") > 100

    chromium.js("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    chromium.call("Browser.grantPermissions", permissions=["clipboardReadWrite"])
    copied = chromium.js(
        "(async () => { const out = []; for (const b of document.querySelectorAll('[data-copy]'))"
        " { b.click(); while (b.textContent !== 'copied') await new Promise(requestAnimationFrame);"
        " out.push([b.dataset.copy, await navigator.clipboard.readText()]); } return out; })()"
    )
    assert len(copied) == 10
    assert all(offered == found for offered, found in copied)
    # An image opens large with its marks, and arrow keys lead to the next.
    chromium.js("document.querySelectorAll('.images .shot')[1].click()")
    assert chromium.js("document.getElementById('large').open")
    width = "document.querySelector('#large img').getBoundingClientRect().width"
    assert chromium.js(width) > 3 * chromium.js(width.replace("#large", ".images"))
    # Where a point is in the file of the image: what jcr touch asks for.
    x, y = chromium.center("#large img")
    chromium.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    name, *pixel = chromium.js("document.getElementById('pixel').textContent").split(",")
    assert name == chromium.js("document.querySelector('#large img').alt")
    assert [float(value) for value in pixel] == pytest.approx([319.5, 239.5], abs=1.5)
    chromium.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
    chromium.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)
    pasted = chromium.js("new Promise(done => setTimeout(() => done(navigator.clipboard.readText()), 200))")
    *named, x_px, y_px = pasted.rsplit(",", 2)
    assert named == [name] and chromium.js("document.getElementById('large').open")
    assert [float(x_px), float(y_px)] == pytest.approx([float(value) for value in pixel], abs=1.0)
    first = chromium.js("document.querySelector('#large p').textContent")
    key = {"key": "ArrowRight", "code": "ArrowRight", "windowsVirtualKeyCode": 39}
    chromium.call("Input.dispatchKeyEvent", type="keyDown", **key)
    assert chromium.js("document.querySelector('#large p').textContent") != first
    _assert_quiet(chromium)


@pytest.mark.long
def test_on_a_phone_and_in_the_dark(chromium: Chromium, file: Path):
    chromium.open(file.as_uri(), 400, phone=True)
    top = "document.querySelector('{}').getBoundingClientRect().top"
    assert chromium.js(f"{top.format('.verdict')} < {top.format('header .soft')}")
    # The remedy may hold a word that is longer than the window.
    chromium.js("document.querySelector('#verdict p').append('charuco:'.repeat(30))")
    assert chromium.js("document.documentElement.scrollWidth") <= 400
    assert chromium.js("document.documentElement.scrollHeight") <= 7000
    chromium.js("document.querySelector('nav a[href=\"#residuals\"]').click()")
    assert chromium.js(
        "new Promise(done => setTimeout(() => done(document.getElementById('residuals').open), 100))"
    )
    light = chromium.js("getComputedStyle(document.body).backgroundColor")
    before = chromium.image("#scene")
    x, y = chromium.center("#scene")
    finger = [{"x": x, "y": y, "id": 0}]
    chromium.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=finger)
    for k in range(1, 6):
        moved = [{"x": x + 12 * k, "y": y, "id": 0}]
        chromium.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=moved)
    chromium.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert (chromium.image("#scene") != before).any()

    cells = ("at least 100.4", "100.4 ± 1.2", "100.4 ± 1.2", "-0.123, -0.456")
    table = render("objects.html", {"it": {"rows": [("object 1", [1, 2, 3], cells)], "noise": "0.1"}})
    chromium.js(f"document.querySelector('main').insertAdjacentHTML('beforeend', {json.dumps(table)})")
    assert chromium.js("(box => box.scrollWidth <= box.clientWidth)(document.querySelector('.scroll'))")

    chromium.open(file.as_uri(), 1280, scheme="dark")
    dark = chromium.js("getComputedStyle(document.body).backgroundColor")
    assert sum(map(int, re.findall(r"\d+", dark)[:3])) < 200 < sum(map(int, re.findall(r"\d+", light)[:3]))
    printed = base64.b64decode(chromium.call("Page.printToPDF")["data"])
    assert printed.startswith(b"%PDF") and len(printed) > 50_000
    _assert_quiet(chromium)


def _assert_quiet(chromium: Chromium) -> None:
    """No error, no message, no dialogue, and nothing asked of any network."""
    noise = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded", "Page.javascriptDialog")
    assert not [event for event in chromium.events if event["method"].startswith(noise)]
    asked = [e["params"]["request"]["url"] for e in chromium.events if e["method"].endswith("WillBeSent")]
    assert asked and all(url.startswith(("file:", "data:")) for url in asked)
