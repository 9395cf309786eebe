"""The live server: its page in each state, poses that programs send, and that no other site reads or commands."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jcr
from chromium import Chromium
from jcr.capture.images import read_image
from jcr.live.progress import progress_lines
from jcr.live.robot import RobotState
from jcr.live.server import MAX_SAMPLE, LiveServer
from jcr.live.session import LiveSession
from jcr.pipeline.options import TOLERANCE
from jcr.pipeline.verify import Move, of_two_poses
from places import ROOT
from refusal import refused
from scripted_capture import Scripted, a_capture, poses, still_frames, video
from waiting import until


@pytest.fixture
def capture(tmp_path: Path, tabletop: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[LiveSession, Scripted]:
    monkeypatch.setattr("jcr.live.server.OPEN_S", 1.5)  # the server waits as long for a page that has gone
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
        with asked(page, "GET", f"/{page.key}/image/images/001.png") as answer:
            assert answer.status == 200 and answer.read()[:2] == b"\xff\xd8"

        scripted.contradicted = "images/004.png"
        add(live, scripted, tabletop, 4)
        wrong = parts(page)["parts"]
        assert "verdict fair" in wrong["head"] and "The gripper pose of images/004.png" in wrong["head"]
        assert wrong["images"].count('class="warned"') == 1
        assert "(retake 4, or remove 4)" in wrong["head"]
        assert any("(retake 4, or remove 4)" in line for line in progress_lines(live.state.progress))

        # A contradiction is a warning also if the requirement is met.
        add(live, scripted, tabletop, 5)
        warned = parts(page)["parts"]["head"]
        assert "verdict fair" in warned and "<h2>The gripper pose of images/004.png" in warned
        assert "requirement met" in warned.lower()
        scripted.contradicted = None
        add(live, scripted, tabletop, 5)
        assert "verdict good" in parts(page)["parts"]["head"]
        live.finish()
        done = parts(page)["parts"]
        assert "<h2>Accepted</h2>" in done["head"] and "data-press" not in done["head"] + done["images"]
        assert "0.012 mm, 0.0046°" in done["head"] and "0.079 px" in done["head"]
        assert "± 1.0 mm" in done["head"]
        assert str(live.folder.folder / "result").replace("<c>", "&lt;c&gt;") in done["head"]


def test_the_server_serves_until_the_report_is_sent(capture: tuple[LiveSession, Scripted], tabletop: Path):
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
        until(lambda: page.page_version >= 0 or page.page_s > 0)
        live.finish()
    reading.join()
    assert got["report"] == "<p>the report</p>" and got["last"]
    assert 'id="report"' in got["head"] and "images/001.png is blurred" in got["head"].lower()


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
        assert status(path="/press") == 403
        assert status(path="/undo") == status(path="/guess/press") == status("GET", "/", "") == 404
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
    with refused("--page-port"), other:
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
def test_buttons_take_retake_remove_undo_end_on_a_phone(chromium: Chromium, tmp_path: Path, tabletop: Path):
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
        assert "where images/001.png was taken" in chromium.js("document.querySelector('.verdict').innerText")
        for at[0] in (1, 2):
            press("[data-press=take]", at[0] + 1)
        press(".commands [data-press=retake]", 3)
        shows("document.querySelector('#images img[src$=\"004.png\"]')")
        assert live.folder.names == [f"images/00{k}.png" for k in (1, 2, 4)]
        press('#images [data-press=remove][data-number="1"]', 2)
        assert live.folder.names == ["images/002.png", "images/004.png"]
        press("[data-press=undo]", 3)
        shows("document.querySelector('.verdict.good')")
        # Nothing is wider than the window.
        assert chromium.js("document.documentElement.scrollWidth <= innerWidth")
        press(".commands [data-press=remove]", 2)
        assert live.folder.names == ["images/001.png", "images/002.png"]
        press("[data-press=finish]", 2)
        taking.join(60)
        assert live.state.is_over and chromium.js("asked") == "End the capture with 2 images?"
        live._show(result=scripted.finish(), is_done=True)
        shows("document.querySelector('.verdict h2')?.innerText === 'Accepted'")
        assert chromium.js("document.querySelector('[data-press]')") is None
        said = chromium.js("document.body.innerText").lower()
        assert "images used" in said and "the calibration uses" in said and "images registered" not in said
        assert chromium.js("document.documentElement.scrollWidth <= innerWidth")
        for width in (390, 820, 1400):
            chromium.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1,
                mobile=False,
            )  # fmt: skip
            wide = "[...document.querySelectorAll('.tile')].every(t => t.scrollWidth <= t.clientWidth)"
            assert chromium.js(wide), width
    assert not [event for event in chromium.events if event["method"] == "Runtime.exceptionThrown"]


CLIENT = ROOT / "examples" / "pose_client.py"
POSE = [0.4, 0.0, 0.5, 0.0, float(np.pi), 0.0]


@pytest.fixture
def serving(tmp_path: Path, tabletop: Path) -> Callable[..., Any]:
    """A server whose samples are all kept, and the samples that it took."""

    @contextmanager
    def served(verifies: Path | None = None) -> Iterator[tuple[LiveServer, list[RobotState]]]:
        image, taken = read_image(tabletop / "images" / "00.jpg"), []
        session, _ = a_capture(tmp_path / "c", still_frames(lambda: image), verifies=verifies)

        def take(state: RobotState, waits: bool) -> dict[str, Any]:
            taken.append(state)
            return {"accepted": True, "done": False}

        session.take = take  # pyright: ignore[reportAttributeAccessIssue]
        with LiveServer(session, takes_samples=True) as server:
            yield server, taken

    return served


def posted(
    server: LiveServer, content: Any, path: str = "/sample", **headers: str | None
) -> tuple[int, dict]:
    """Status and answer of a sample; a header that is None is not sent."""
    body = content if isinstance(content, str) else json.dumps(content)
    sent = {"Host": server.hosts[0], "Authorization": f"Bearer {server.key}"}
    sent |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    method, sent = "GET" if path == "/state" else "POST", {key: text for key, text in sent.items() if text}
    connection.request(method, path, body, sent)
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    return answer.status, json.loads(text) if text else {}


def test_a_web_page_on_the_same_machine_cannot_add_a_pose(serving: Callable[..., Any]):
    """A form or a script of another site sends text to any port of 127.0.0.1, with its own Origin and no key."""
    with serving() as (server, taken):
        sample, own = json.dumps({"base_from_gripper": POSE}) + "\n", f"http://{server.hosts[0]}"
        evil: dict[str, str | None] = {"Origin": "http://evil.example", "Content_Type": "text/plain"}
        for path in ("/", "/sample", f"/{server.key}/press", f"/{server.key}/sample", "/press"):
            assert posted(server, sample, path, Authorization=None, **evil)[0] in (403, 404), path
        # DNS rebinding: the name of the other site leads to this server.
        rebound: dict[str, str | None] = {"Host": f"evil.example:{server.server_port}", "Origin": None}
        assert "host evil.example" in posted(server, sample, **rebound)[1]["reason"]
        with asked(server, "PUT", "/sample", sample) as answer:
            assert answer.status == 405 and "PUT" in json.loads(answer.read())["reason"]
        alone: list[dict[str, str | None]] = [{"Authorization": None}, {"Authorization": "Bearer wrong"}]
        for headers in (*alone, {"Origin": "http://evil.example"}, {"Origin": "null"}, rebound):
            assert posted(server, sample, **headers)[0] == 403, headers
        # The lines of a request are no samples either.
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=60) as raw:
            raw.sendall(
                sample.encode() + f"POST / HTTP/1.1\r\nHost: {server.hosts[0]}\r\n\r\n{sample}".encode()
            )
            assert b"400" in raw.recv(4096)
        assert not taken
        assert posted(server, sample, Origin=own)[0] == 200 and len(taken) == 1


def test_bad_samples_are_answered_and_good_ones_taken(serving: Callable[..., Any], tabletop: Path):
    pose = poses(tabletop)[0]
    with serving() as (server, taken):
        for content, words in (
            ("hello", "not JSON"),
            ("[" * 50_000, "not JSON"),
            ({"pose": 1}, 'no "base_from_gripper"'),
            ({"base_from_gripper": "here"}, 'no "base_from_gripper"'),
            ({"base_from_gripper": [["a"]]}, "not numbers"),
            ({"base_from_gripper": (pose * 2).tolist()}, "last row"),
            ({"base_from_gripper": [400, 0, 500, 0, 0, 0]}, "millimetres"),
            ({"base_from_gripper": [0.4, 0, 0.5, 0, 0, float("nan")]}, "NaN"),
            ("x" * (MAX_SAMPLE + 1), "more than"),
        ):
            status, answer = posted(server, content)
            assert status == 400 and not answer["accepted"] and words in answer["reason"], content
        assert posted(server, POSE, Content_Length="9" * 5000)[0] == 400
        assert posted(server, {"base_from_gripper": pose.tolist()})[0] == 200
        assert posted(server, POSE)[0] == 200
    assert np.allclose(taken[0].base_from_gripper, pose)
    assert np.allclose(taken[1].base_from_gripper[:3, :3], np.diag([-1, 1, -1]))


def test_a_program_reads_the_state_and_removes_replaces_and_undoes(tmp_path: Path, tabletop: Path):
    images, at = [read_image(tabletop / "images" / f"{k:02d}.jpg") for k in range(3)], [0]
    session, _ = a_capture(tmp_path / "c", still_frames(lambda: images[at[0]]))
    with LiveServer(session, takes_samples=True) as server:
        for k in range(2):
            at[0] = k
            assert posted(server, {"base_from_gripper": poses(tabletop)[k].tolist()})[0] == 200
        names = session.folder.names
        status, state = posted(server, {"action": "remove", "number": 1}, "/press")
        assert status == 200 and state["accepted"] and state["images"] == names[1:]
        assert posted(server, {"action": "undo"}, "/press")[1]["images"] == names
        assert posted(server, {"action": "retake", "number": 2}, "/press")[0] == 200
        at[0] = 2
        assert posted(server, {"base_from_gripper": poses(tabletop)[2].tolist()})[0] == 200
        assert len(session.folder.names) == 2 and session.folder.names[1] != names[1]
        refused, answer = posted(server, {"action": "remove", "number": 9}, "/press")
        assert refused == 422 and "no image 9" in answer["reason"]
        status, answer = posted(server, {"action": "jump"}, "/press")
        assert status == 400 and "remove, undo, finish" in answer["reason"]
        assert posted(server, {"action": "undo"}, "/press", Authorization=None)[0] == 403
        status, answer = posted(server, {}, "/undo")
        assert status == 404 and "GET /state" in answer["reason"]
        assert posted(server, {"action": "finish"}, "/press")[1]["done"]
        assert posted(server, {"action": "undo"}, "/press")[0] == 422
        status, state = posted(server, "", "/state")
        assert status == 200 and state["images"] == session.folder.names and state["done"]
        assert posted(server, "", "/state", Authorization=None)[0] == 403


def test_an_unexpected_error_of_the_calibration_answers_500(tmp_path: Path, tabletop: Path):
    image = read_image(tabletop / "images" / "00.jpg")
    session, scripted = a_capture(tmp_path / "c", still_frames(lambda: image))
    with LiveServer(session, takes_samples=True) as server:
        scripted.fault = NameError("name 'remedy' is not defined")
        status, answer = posted(server, POSE)
    assert status == 500 and "NameError: name 'remedy'" in answer["reason"]
    assert not answer["accepted"] and "done" not in answer
    with pytest.raises(NameError):
        session.run()


def test_a_run_is_verified_when_a_program_asks(serving: Callable[..., Any], monkeypatch: pytest.MonkeyPatch):
    step = np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    moves = (Move(("camera",), 0, "today", step),)
    moved = replace(of_two_poses(step, 1e-8 * np.eye(6), TOLERANCE, ["images/001.png"], ()), moves=moves)
    outcomes: list[Any] = [moved, jcr.RejectedError("cannot tell: no images"), moved]

    def verify(run: Path, capture: Path) -> Any:
        if isinstance(outcome := outcomes.pop(0), Exception):
            raise outcome
        return outcome

    monkeypatch.setattr("jcr.pipeline.verify.verify_run", verify)
    with serving() as (server, _):
        assert posted(server, "", "/verify")[0] == 409
    with serving(verifies=Path("out/table")) as (server, taken):
        assert posted(server, "", "/verify", Authorization="Bearer wrong")[0] == 403
        status, answer = posted(server, "", "/verify")
        assert status == 200 and answer["moved"] and answer["drift_mm"] == pytest.approx([10, 0, 0])
        shown = parts(server)["parts"]["head"]
        assert "verdict bad" in shown and "moved by 10.00 mm" in shown
        assert posted(server, "{}", "/verify") == (422, {"reason": "cannot tell: no images"})
        assert "cannot tell: no images" in parts(server)["parts"]["head"] and not taken


def test_a_capture_that_verifies_states_what_is_missing_and_the_verdict(
    tmp_path, tabletop: Path, monkeypatch
):
    """Page and terminal speak of the images to verify, and not of the requirement of a calibration."""
    still = of_two_poses(np.zeros(6), 1e-8 * np.eye(6), TOLERANCE, ["images/001.png"], ())
    monkeypatch.setattr("jcr.pipeline.verify.verify_run", lambda run, capture: still)
    said, image = list[str](), read_image(tabletop / "images" / "00.jpg")
    session, scripted = a_capture(
        tmp_path / "c", still_frames(lambda: image), lambda answer, lines: said.extend(lines),
        verifies=Path("out/table"), images=2,
    )  # fmt: skip
    with LiveServer(session, takes_samples=True) as server:
        assert posted(server, {"base_from_gripper": poses(tabletop)[0].tolist()})[0] == 200
        until(lambda: "1 of 2 images to verify" in parts(server)["parts"]["head"])
        assert any("1 more image" in line for line in said) and not any("accuracy" in line for line in said)
        assert session.finish() is None and not scripted.finished
        shown = parts(server)["parts"]
        assert "verdict good" in shown["head"] and "Verification: accepted" in shown["head"]
        assert "<span>used</span>" in shown["images"]


def test_numbers_of_images_are_of_one_state_until_they_are_calibrated(
    capture: tuple[LiveSession, Scripted], tabletop: Path
):
    live, scripted = capture
    add(live, scripted, tabletop, 4)
    live.folder.remove("images/002.png")
    live._show("removed images/002.png")
    with LiveServer(live) as page:
        assert "3 of 3" in parts(page)["parts"]["head"]
        live._report(scripted.update())
        live.folder.undo()
        live._show("undone: 4 images")
        assert "3 of 3" in parts(page)["parts"]["head"] and "1 new" in parts(page)["parts"]["head"]


def test_the_page_states_the_final_calibration_as_soon_as_the_capture_ends(
    capture: tuple[LiveSession, Scripted], tabletop: Path
):
    live, scripted = capture
    add(live, scripted, tabletop, 5)
    running = threading.Thread(target=live.run)
    running.start()
    until(lambda: not live.state.event)
    live.press("finish")
    running.join(60)
    with LiveServer(live) as page:
        assert "final calibration of all 5 images" in parts(page)["parts"]["head"]


def test_samples_of_a_watched_arm_are_refused(tmp_path: Path, tabletop: Path):
    image = read_image(tabletop / "images" / "00.jpg")
    capture, _ = a_capture(tmp_path / "c", still_frames(lambda: image))
    with refused("letters, digits"):
        LiveServer(capture, token="a key")
    with LiveServer(capture) as server:
        assert posted(server, POSE)[0] == 409


def start(out: Path, camera: Path) -> tuple[subprocess.Popen[str], str]:
    """`jcr capture` running, and the address at which it waits for poses."""
    command = [sys.executable, "-m", "jcr", "capture", out, "--camera", camera, "--poses", "http"]
    environment = os.environ | {"JCR_TOKEN": "sesame"}
    running = subprocess.Popen(
        [str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment,
    )  # fmt: skip
    assert running.stderr is not None
    line = next(line for line in running.stderr if "waiting for POST" in line)
    return running, line.split()[3].removesuffix("/sample")


@pytest.mark.long
def test_an_interrupted_command_goes_on_and_the_example_client_talks_to_it(tmp_path: Path, tabletop: Path):
    out = tmp_path / "c"
    running, address = start(out, video(tmp_path / "a.avi", tabletop, range(1)))
    connection = http.client.HTTPConnection(address.removeprefix("http://"), timeout=60)
    sample = json.dumps({"base_from_gripper": poses(tabletop)[0].tolist()})
    connection.request("POST", "/sample", sample, {"Authorization": "Bearer sesame"})
    answer = json.loads(connection.getresponse().read())
    assert answer["accepted"] and answer["image"] == "images/001.png", answer
    second = [sys.executable, "-m", "jcr", "capture", str(out), "--camera", str(tmp_path / "a.avi")]
    refused = subprocess.run(second, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2 and "another jcr is writing there" in refused.stderr.splitlines()[-1]
    running.send_signal(signal.SIGTERM)
    printed = running.communicate(timeout=60)[1]
    assert running.returncode == 130
    assert printed.splitlines()[-1].startswith("error: interrupted") and "Traceback" not in printed
    assert "Aborted at" not in printed

    running, address = start(out, video(tmp_path / "b.avi", tabletop, range(1, 4)))
    talked = subprocess.run(
        [sys.executable, CLIENT, address, "sesame"], capture_output=True, text=True, timeout=120
    )
    result, printed = running.communicate(timeout=60)
    # The poses are not those of the images.
    assert running.returncode == 3, printed
    assert result.splitlines()[0].startswith("REJECTED ")
    assert result.splitlines()[-1] == f"Next        jcr check {out}"
    assert talked.returncode == 0 and talked.stdout.count("images/00") == 3, talked.stdout + talked.stderr
    # The client prints the accuracy that each image leads to.
    assert "images/004.png 95 %, mm: " in talked.stdout.splitlines()[-1]
    assert jcr.read_capture(out).images == tuple(f"images/00{k}.png" for k in range(1, 5))
