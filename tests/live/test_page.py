"""The live page: what it shows in each state, and that no other site reads or commands it."""

import http.client
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jcr
from chromium import Chromium
from jcr.capture.images import read_image
from jcr.live.progress import Notation, progress_lines
from jcr.live.robot import RobotState
from jcr.live.server import LiveServer
from jcr.live.session import LiveSession
from jcr.records import NextPose
from scripted_capture import Scripted, a_capture, still_frames
from waiting import until


@pytest.fixture
def capture(tmp_path: Path, tabletop: Path) -> tuple[LiveSession, Scripted]:
    image = read_image(tabletop / "images" / "00.jpg")
    return a_capture(tmp_path / "<c>", still_frames(lambda: image), accurate_from=5)


def add(capture: LiveSession, scripted: Scripted, tabletop: Path, count: int) -> None:
    """Images, and the state of the calibration with them."""
    poses = jcr.read_capture(tabletop).base_from_gripper
    for k in range(len(capture.folder.names), count):
        capture.folder.add(read_image(tabletop / "images" / f"{k:02d}.jpg"), poses[k])
    capture._report(scripted.update())


@contextmanager
def asked(page: LiveServer, method: str, path: str, body: str = "", **headers: str) -> Iterator[Any]:
    connection = http.client.HTTPConnection("127.0.0.1", page.server_port, timeout=10)
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body or None, {"Host": f"127.0.0.1:{page.server_port}"} | names)
    yield connection.getresponse()
    connection.close()


def parts(page: LiveServer, version: int = -1) -> dict[str, Any]:
    with asked(page, "GET", f"/{page.key}/state?version={version}") as answer:
        return json.loads(answer.read())


def test_the_page_shows_each_state(capture: tuple[LiveSession, Scripted], tabletop: Path):
    live, scripted = capture
    with LiveServer(live) as page:
        with asked(page, "GET", f"/{page.key}/") as answer:
            whole = answer.read().decode()
        assert "&lt;c&gt;" in whole and "<c>" not in whole and "http" not in whole.replace("http-equiv", "")
        nothing = parts(page)
        assert "No image yet" in nothing["parts"]["head"] and not nothing["images"]
        assert "None yet" in nothing["parts"]["images"]
        assert parts(page, nothing["version"]) == {"version": nothing["version"]}

        add(live, scripted, tabletop, 3)
        three = parts(page)
        assert three["version"] > nothing["version"]
        assert "± 3.3 mm" in three["parts"]["head"] and "required 2 mm" in three["parts"]["head"]
        scene = json.loads(three["scene"])
        assert len(scene["views"]) == 3 and scene["views"][0]["camera"] is not None
        with asked(page, "GET", f"/{page.key}/image/images/000.png") as answer:
            assert answer.status == 200 and answer.read()[:2] == b"\xff\xd8"

        scripted.contradicted = "images/003.png"
        add(live, scripted, tabletop, 4)
        wrong = parts(page)["parts"]
        assert "verdict fair" in wrong["head"] and "The gripper pose of images/003.png" in wrong["head"]
        assert wrong["images"].count('class="rejected"') == 1
        assert "(retake 4, or remove 4)" in wrong["head"]
        assert any(
            "(retake 4, or remove 4)" in line for line in progress_lines(live.state.progress, Notation())
        )

        scripted.contradicted = None
        add(live, scripted, tabletop, 5)
        assert "verdict good" in parts(page)["parts"]["head"]
        live.finish()
        done = parts(page)["parts"]
        assert "<h2>Accepted</h2>" in done["head"] and "data-press" not in done["head"] + done["images"]
        assert (
            "± 1.0 mm" in done["head"]
            and str(live.folder.folder / "result").replace("<c>", "&lt;c&gt;") in done["head"]
        )


def test_the_page_says_when_the_requirement_is_met_and_stops_proposing(
    capture: tuple[LiveSession, Scripted], tabletop: Path
):
    live, scripted = capture
    poses = jcr.read_capture(tabletop).base_from_gripper
    proposed = NextPose(
        base_from_gripper=poses[11],
        expected_std=np.ones(7),
        within_95_mm=1.0,
        rotation_95_deg=0.1,
        like="images/000.png",
        moved_m=0.1,
        rotation_rad=0.5,
    )
    with LiveServer(live) as page:
        for count, is_met in ((4, False), (5, True)):
            add(live, scripted, tabletop, count)
            live._report(replace(scripted.progress, next_pose=proposed))
            shown = parts(page)
            assert ("verdict good" in shown["parts"]["head"]) is is_met
            assert ("Requirement met, press Finish" in shown["parts"]["head"]) is is_met
            assert ("100 mm and 29° from images/000.png" in shown["parts"]["next"]) is not is_met
            assert bool(json.loads(shown["scene"])["next"]) is not is_met


def test_a_capture_that_is_resumed_opens_without_a_red_message(
    capture: tuple[LiveSession, Scripted], tabletop: Path
):
    live, scripted = capture
    add(live, scripted, tabletop, 5)
    resumed, again = a_capture(live.folder.folder, live.camera.frames)
    with LiveServer(resumed) as page:
        head = parts(page)["parts"]["head"]
        assert "5 images" in head and "being calibrated" in head and "verdict bad" not in head
        resumed._report(again.update())
        assert "verdict bad" not in parts(page)["parts"]["head"]


def test_the_server_answers_until_the_page_has_the_result_and_its_report(
    capture: tuple[LiveSession, Scripted], tabletop: Path
):
    live, scripted = capture
    add(live, scripted, tabletop, 5)
    scripted.warns = True
    got: dict[str, Any] = {}

    def read() -> None:
        """Poll as the page does, slower than the end comes."""
        version = -1
        while "report" not in got:
            state = parts(page, version)
            if state["version"] == version:
                continue
            if state["has_report"]:
                with asked(page, "GET", f"/{page.key}/report.html") as answer:
                    got["report"] = answer.read().decode()
                got["head"] = state["parts"]["head"]
            version = state["version"]
            time.sleep(0.5)
        got["last"] = parts(page, version)["version"] == version

    (live.folder.folder / "result").mkdir()
    (live.folder.folder / "result" / "report.html").write_text("<p>the report</p>")
    with LiveServer(live) as page:
        reading = threading.Thread(target=read)
        reading.start()
        until(lambda: page._page_version >= 0 or page._page_s > 0)
        live.finish()
    reading.join()
    assert got["report"] == "<p>the report</p>" and got["last"]
    assert 'id="report"' in got["head"] and "images/000.png is blurred" in got["head"].lower()


def test_only_the_page_itself_commands(capture: tuple[LiveSession, Scripted], tabletop: Path):
    live, scripted = capture
    add(live, scripted, tabletop, 2)
    pressed: list[tuple[str, int | None]] = []
    live.press = lambda action, number=None: pressed.append((action, number))
    with LiveServer(live) as page:
        press, body = f"/{page.key}/press", json.dumps({"action": "remove", "number": 1})
        own = {"Origin": f"http://127.0.0.1:{page.server_port}", "Content_Type": "application/json"}

        def status(method: str = "POST", path: str = press, text: str = body, **headers: str) -> int:
            with asked(page, method, path, text, **(own | headers)) as answer:
                return answer.status

        assert status(Origin="http://evil.example") == status(Origin="null") == 403
        assert status(Host="evil.example") == status("GET", f"/{page.key}/", "", Host="evil.example") == 403
        assert status(Content_Type="text/plain") == 403
        assert status(path="/press") == status(path="/guess/press") == status("GET", "/", "") == 404
        assert status("GET", f"/{page.key}/image/../capture.json", "") == 404
        for text in ("{", "[]", '{"action": "rm"}', '{"action": "remove", "number": "1"}', "x" * 2000):
            assert status(text=text) == 400
        with asked(page, "POST", press, body, Content_Type="application/json") as answer:
            assert answer.status == 403
        assert pressed == []
        assert status() == 204 and pressed == [("remove", 1)]
        with asked(page, "GET", f"/{page.key}/") as answer:
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    other = LiveServer(live)
    assert other.key != page.key and len(other.key) >= 22
    with pytest.raises(jcr.InputError, match="--page-port"), other:
        LiveServer(live, port=other.server_port)


def test_the_camera_now_is_shown_with_its_features(capture: tuple[LiveSession, Scripted]):
    live, _ = capture
    frame = next(iter(live.camera.frames))
    with LiveServer(live) as page:
        with asked(page, "GET", f"/{page.key}/now.jpg") as answer:
            assert answer.status == 204
        object.__setattr__(live.camera, "latest", lambda: frame)
        with asked(page, "GET", f"/{page.key}/now.jpg") as answer:
            count = int(answer.headers["X-Features"].split()[0])
            assert count > 150 and answer.read()[:2] == b"\xff\xd8"
        blank = type(frame)(np.full_like(frame.image, 128), 1.0)
        object.__setattr__(live.camera, "latest", lambda: blank)
        with asked(page, "GET", f"/{page.key}/now.jpg") as answer:
            assert "Few" in answer.headers["X-Features"]


@pytest.mark.slow
def test_the_buttons_take_retake_remove_undo_and_finish_on_a_phone(
    chromium: Chromium, tmp_path: Path, tabletop: Path
):
    poses, at = jcr.read_capture(tabletop).base_from_gripper, [0]
    live, scripted = a_capture(
        tmp_path / ("a-long-name-of-a-folder-without-any-space" * 3),
        still_frames(lambda: read_image(tabletop / "images" / f"{at[0]:02d}.jpg")),
        gripper=lambda: RobotState(0.0, poses[at[0]]),
        accurate_from=3,
    )

    def shows(condition: str) -> None:
        until(lambda: bool(chromium.js(f"Boolean({condition})")))

    def press(selector: str, images: int) -> None:
        """Click on a button that is enabled, and wait until the page lists that number of images."""
        shows(f"document.querySelector('{selector}:not(:disabled)')")
        chromium.js(f"document.querySelector('{selector}:not(:disabled)').click()")
        shows(f"document.querySelectorAll('#images figure').length === {images}")

    taking = threading.Thread(target=live.run, daemon=True)
    with LiveServer(live) as page:
        taking.start()
        chromium.open(page.address, 390, 844, phone=True)
        chromium.js("window.confirm = question => { window.asked = question; return true; }")
        shows("document.querySelector('[data-press=take]')")
        disabled = "[...document.querySelectorAll('.commands :disabled')].map(b => b.dataset.press).join()"
        assert chromium.js(disabled) == "retake,remove,undo,finish"
        press("[data-press=take]", 1)
        press("[data-press=take]", 1)
        shows("document.querySelector('.verdict.bad')")
        assert "where images/000.png was taken" in chromium.js("document.querySelector('.verdict').innerText")
        for at[0] in (1, 2):
            press("[data-press=take]", at[0] + 1)
        press(".commands [data-press=retake]", 3)
        shows("document.querySelector('#images img[src$=\"003.png\"]')")
        assert live.folder.names == [f"images/00{k}.png" for k in (0, 1, 3)]
        press('#images [data-press=remove][data-number="1"]', 2)
        assert live.folder.names == ["images/001.png", "images/003.png"]
        press("[data-press=undo]", 3)
        shows("document.querySelector('.verdict.good')")
        # Nothing is wider than the window.
        assert chromium.js("document.documentElement.scrollWidth <= innerWidth")
        press(".commands [data-press=remove]", 2)
        assert live.folder.names == ["images/000.png", "images/001.png"]
        press("[data-press=finish]", 2)
        taking.join(60)
        assert live.state.is_over and chromium.js("asked") == "End the capture with 2 images?"
        live._show(result=scripted.finish(), is_done=True)
        shows("document.querySelector('.verdict h2')?.innerText === 'Accepted'")
        assert chromium.js("document.querySelector('[data-press]')") is None
        assert chromium.js("document.documentElement.scrollWidth <= innerWidth")
    assert not [event for event in chromium.events if event["method"] == "Runtime.exceptionThrown"]
