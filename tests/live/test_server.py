"""Poses that a program sends over HTTP: who may send them, what is refused, and that every answer arrives."""

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jcr
from jcr.capture.images import read_image
from jcr.live.robot import RobotState
from jcr.live.server import MAX_SAMPLE, LiveServer
from places import ROOT
from scripted_capture import a_capture, poses, still_frames, video

CLIENT = ROOT / "examples" / "pose_client.py"
SCRIPT = ROOT / "examples" / "pose_client.script"
POSE = [0.4, 0.0, 0.5, 0.0, float(np.pi), 0.0]


@pytest.fixture
def serving(tmp_path: Path, tabletop: Path) -> Callable[..., Any]:
    """A server whose samples are all kept, and the samples that it took."""

    @contextmanager
    def served(**listen: Any) -> Iterator[tuple[LiveServer, list[RobotState]]]:
        image, taken = read_image(tabletop / "images" / "00.jpg"), []
        session, _ = a_capture(tmp_path / "c", still_frames(lambda: image))

        def take(state: RobotState, waits: bool) -> dict[str, Any]:
            taken.append(state)
            return {"accepted": True, "done": False}

        session.take = take  # pyright: ignore[reportAttributeAccessIssue]
        with LiveServer(session, **listen, takes_samples=True) as server:
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
    connection.request("POST", path, body, {name: value for name, value in sent.items() if value is not None})
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    return answer.status, json.loads(text) if text else {}


def test_a_web_page_on_the_same_machine_cannot_add_a_pose(serving: Callable[..., Any]):
    """A form or a script of another site sends text to any port of 127.0.0.1, with its own Origin and no key."""
    with serving() as (server, taken):
        sample = json.dumps({"base_from_gripper": POSE}) + "\n"
        own = f"http://{server.hosts[0]}"
        for path in ("/", "/sample", f"/{server.key}/press", f"/{server.key}/sample", "/press"):
            status, _ = posted(
                server,
                sample,
                path,
                Authorization=None,
                Origin="http://evil.example",
                Content_Type="text/plain",
            )
            assert status in (403, 404), path
        assert posted(server, sample, Authorization=None)[0] == 403
        assert posted(server, sample, Authorization="Bearer wrong")[0] == 403
        assert posted(server, sample, Origin="http://evil.example")[0] == 403
        assert posted(server, sample, Origin="null")[0] == 403
        # DNS rebinding: the name of the other site leads to this server.
        assert posted(server, sample, Host=f"evil.example:{server.server_port}", Origin=None)[0] == 403
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
        assert posted(server, {"base_from_gripper": pose.tolist()})[0] == 200
        assert posted(server, POSE)[0] == 200
    assert np.allclose(taken[0].base_from_gripper, pose)
    assert np.allclose(taken[1].base_from_gripper[:3, :3], np.diag([-1, 1, -1]))


def test_other_machines_need_a_token_and_the_name_of_the_host(serving: Callable[..., Any]):
    for words, listen in (
        ("set a token", {"host": "192.168.0.5", "port": 7464}),
        *(("names no host", {"host": host, "token": "sesame"}) for host in ("0.0.0.0", "::", "")),
        ("letters, digits", {"token": "a key"}),
    ):
        with pytest.raises(jcr.InputError, match=words), serving(**listen):
            pass
    with serving(host="127.0.0.2", token="sesame") as (server, taken):

        def status(host: str, key: str = "sesame") -> int:
            connection = http.client.HTTPConnection("127.0.0.2", server.server_port, timeout=60)
            connection.request(
                "POST", "/sample", json.dumps(POSE), {"Host": host, "Authorization": f"Bearer {key}"}
            )
            return connection.getresponse().status

        assert status(f"127.0.0.1:{server.server_port}") == status(f"localhost:{server.server_port}") == 403
        assert status(f"127.0.0.2:{server.server_port}", "wrong") == 403 and not taken
        assert status(f"127.0.0.2:{server.server_port}") == 200 and len(taken) == 1


def test_silence_ends_the_wait_and_samples_of_a_watched_arm_are_refused(tmp_path: Path, tabletop: Path):
    image = read_image(tabletop / "images" / "00.jpg")
    capture, _ = a_capture(tmp_path / "c", still_frames(lambda: image))
    with LiveServer(capture) as server:
        assert posted(server, POSE)[0] == 409
        with pytest.raises(jcr.InputError, match="no sample for 0 s"):
            server.await_samples(0.1)


def test_the_last_answer_is_sent_before_the_server_ends(serving: Callable[..., Any]):
    got: list[tuple[int, dict]] = []
    with serving() as (server, taken):
        begun, real = threading.Event(), server.session.take

        def slow(state: RobotState, waits: bool) -> dict[str, Any]:
            begun.set()
            time.sleep(0.5)
            return real(state, waits)

        server.session.take = slow
        client = threading.Thread(target=lambda: got.append(posted(server, POSE)))
        client.start()
        assert begun.wait(60)
    client.join()
    assert got == [(200, {"accepted": True, "done": False})] and len(taken) == 1


def played_script(address: str, port: int, token: str, pose: list[float]) -> list[str]:
    """Run the URScript example: its grammar is that of Python but for `end`; return what it logs."""
    code = SCRIPT.read_text().replace('"192.168.0.5"', repr(address)).replace("7464", str(port))
    code = re.sub(r"^\s*end$", "", code.replace('"secret"', repr(token)), flags=re.MULTILINE)
    sockets: dict[str, socket.socket] = {}
    logged: list[str] = []

    def socket_open(host: str, port: int, name: str) -> bool:
        sockets[name] = socket.create_connection((host, port), timeout=60)
        return True

    functions: dict[str, Any] = {
        "get_actual_tcp_pose": lambda: pose,
        "str_cat": lambda a, b: a + b,
        "to_str": str,
        "str_len": len,
        "socket_open": socket_open,
        "socket_send_line": lambda text, name: sockets[name].sendall(f"{text}\n".encode()),
        "socket_send_string": lambda text, name: sockets[name].sendall(text.encode()),
        "socket_read_line": lambda name, timeout: sockets[name].makefile("r").readline().rstrip(),
        "socket_close": lambda name: sockets[name].close(),
        "textmsg": lambda a, b: logged.append(a + b),
    }
    exec(code, functions)
    functions["jcr_sample"]()
    return logged


def test_the_urscript_example_sends_a_pose(serving: Callable[..., Any]):
    with serving(token="sesame") as (server, taken):
        assert played_script("127.0.0.1", server.server_port, "sesame", POSE) == [
            "jcr capture: HTTP/1.0 200 OK"
        ]
        assert "403" in played_script("127.0.0.1", server.server_port, "guess", POSE)[0]
    assert len(taken) == 1 and np.allclose(taken[0].base_from_gripper[:3, 3], POSE[:3])


def start(out: Path, camera: Path) -> tuple[subprocess.Popen[str], str]:
    """`jcr capture` running, and the address at which it waits for poses."""
    command = [sys.executable, "-m", "jcr", "capture", out, "--camera", camera, "--poses", "http"]
    environment = os.environ | {"JCR_TOKEN": "sesame"}
    running = subprocess.Popen(
        [str(word) for word in command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
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
    assert answer["accepted"] and answer["image"] == "images/000.png", answer
    second = [sys.executable, "-m", "jcr", "capture", str(out), "--camera", str(tmp_path / "a.avi")]
    refused = subprocess.run(second, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2 and "another jcr is writing there" in refused.stderr.splitlines()[-1]
    running.send_signal(signal.SIGINT)
    printed = running.communicate(timeout=60)[1]
    assert running.returncode == 130
    assert printed.splitlines()[-1].startswith("error: interrupted") and "Traceback" not in printed

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
    # From the second image on there is a pose to go to.
    assert "next: [[" in talked.stdout.splitlines()[-1]
    assert jcr.read_capture(out).images == tuple(f"images/00{k}.png" for k in range(4))
