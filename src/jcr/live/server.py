"""HTTP server of a capture: the live page with its commands, and gripper poses from a program (`POST /sample`).

Every request needs the session key, in the path of the page or in the header `Authorization` of a sample. The header
`Host` must name this server (DNS rebinding), and a browser's `Origin` must be the page's own: no other web site can
read the capture, command it or add a pose.
"""

import hmac
import ipaddress
import json
import queue
import re
import secrets
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.errors import InputError
from jcr.live.asks import Answer, Ask, pose_of_numbers
from jcr.live.collect import LiveCapture
from jcr.live.commands import Action, Command
from jcr.live.page import page_parts, whole_page

LOOPBACK = "127.0.0.1"
TIMEOUT_S = 10.0
"""Longest time in which a request must be complete."""
ANSWER_S = 600.0
"""Longest time that the answer to a sample may take."""
MAX_COMMAND, MAX_SAMPLE = 1000, 65_536
"""Largest body in bytes."""
LAST_S = 3.0
"""Time at the end of a capture in which an open page can fetch the result."""
NOW_PX, CARD_PX = 640, 330
"""Width of the camera's image and of the images in the list."""
FEW_FEATURES = 150
"""Number of SIFT features in an image of NOW_PX below which registration is at risk."""
POLICY = (
    "default-src 'none'; img-src 'self' blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


@dataclass(frozen=True)
class Listen:
    """Address, port and key of the server."""

    host: str = LOOPBACK
    """Loopback, or the one host name that is answered; any other than loopback needs a token."""
    port: int = 0
    """0: any free port."""
    token: str | None = None
    """The key of the session; None: a random one."""
    option: str = "--page-port"
    """Option that the user gave, for messages."""


def checked_listen(listen: Listen) -> Listen:
    """Return `listen`, or raise InputError where the address would be open to others or cannot be named."""
    where = f"{listen.option} {listen.host}:{listen.port}"
    if listen.token is not None and not re.fullmatch(r"[\w.~-]+", listen.token, re.ASCII):
        raise InputError("--token: has characters that an address cannot have; use letters, digits, - and _")
    if _is_any_address(listen.host):
        raise InputError(f"{where}: names no host; give the address of this machine that the robot uses")
    if listen.option == "--listen" and listen.token is None:
        raise InputError(f"{where}: others can reach that address; set a token (JCR_TOKEN)")
    return listen


class Server:
    """Serves the page of a capture and takes samples while it is entered."""

    def __init__(self, capture: LiveCapture, listen: Listen | None = None) -> None:
        """Bind the address; raise InputError where that fails."""
        listen = checked_listen(listen or Listen())
        self.capture, self.key, self.host = capture, listen.token or secrets.token_urlsafe(16), listen.host
        self.seen_version, self.asked_s = -1, -np.inf
        """Version of the state that a page has, and the time of its last request."""
        self.samples: queue.SimpleQueue[Ask | None] = queue.SimpleQueue()
        self.takes_samples = False
        self.unanswered: set[int] = set()
        """Requests for samples whose answers are not sent yet."""
        try:
            self._server = _HttpServer((self.host, listen.port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(
                f"{listen.option} {listen.host}:{listen.port}: {error}; choose an address of this machine "
                "and a free port"
            ) from None
        self._server.owner = self
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def address(self) -> str:
        """Address of the page, key included."""
        return f"http://{self.host}:{self.port}/{self.key}/"

    @property
    def hosts(self) -> tuple[str, ...]:
        """Accepted values of the header Host."""
        names = (LOOPBACK, "localhost") if self.host == LOOPBACK else (self.host,)
        return tuple(f"{name}:{self.port}" for name in names)

    def sampled_poses(self, timeout_s: float) -> Iterator[Ask]:
        """Return a request per sample until a client is done; raise InputError after `timeout_s` without one."""
        self.takes_samples = True
        return self._sampled_poses(timeout_s)

    def _sampled_poses(self, timeout_s: float) -> Iterator[Ask]:
        """Yield the samples of `sampled_poses`."""
        try:
            while (ask := self.samples.get(timeout=timeout_s)) is not None:
                yield ask
        except queue.Empty:
            raise InputError(
                f"--poses http: no sample for {timeout_s:.0f} s; the images taken are kept and the same command resumes"
            ) from None

    def __enter__(self) -> "Server":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        end = time.monotonic() + LAST_S
        while time.monotonic() < end and (self.unanswered or self._page_is_behind()):
            time.sleep(0.05)
        self._server.shutdown()
        self._server.server_close()

    def _page_is_behind(self) -> bool:
        """Test whether an open page has not fetched the newest state."""
        is_open = time.monotonic() - self.asked_s < LAST_S
        return is_open and self.seen_version < self.capture.shown.version


class _HttpServer(ThreadingHTTPServer):
    """Socket server with a reference to the `Server` that owns it."""

    owner: Server

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections that the client closed; report anything else."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]


class _Handler(BaseHTTPRequestHandler):
    """Handler of one request."""

    timeout = TIMEOUT_S
    server_version, sys_version = "jcr", ""

    @property
    def _owner(self) -> Server:
        assert isinstance(self.server, _HttpServer)
        return self.server.owner

    def do_GET(self) -> None:
        """Answer a request of the page."""
        path = self._path()
        if path is None:
            return
        path, _, query = path.partition("?")
        if path == "":
            self._send(whole_page(self._owner.capture).encode(), "text/html; charset=utf-8")
        elif path == "state":
            self._send_state(query.removeprefix("version="))
        elif path == "now.jpg":
            self._send_now()
        elif path.removeprefix("image/") in self._owner.capture.live.names:
            self._send(_card(self._owner.capture.live.folder / path.removeprefix("image/")), "image/jpeg")
        else:
            self._refuse(404)

    def do_POST(self) -> None:
        """Obey a command of the page, or take a sample."""
        if self.path == "/sample":
            self._take_sample()
            return
        path = self._path()
        if path is None:
            return
        is_json = self.headers.get("Content-Type", "") == "application/json"
        if not self._is_own_origin(self.headers.get("Origin")) or not is_json:
            self._refuse(403)
        elif path != "press" or (command := self._command()) is None:
            self._refuse(400)
        else:
            self._owner.capture.press(command)
            self._send(b"", "text/plain", 204)

    def _is_own_origin(self, origin: str | None) -> bool:
        return origin in [f"http://{host}" for host in self._owner.hosts]

    def _take_sample(self) -> None:
        """Take an image at the pose in the body, and answer when it is calibrated or refused."""
        origin, given = self.headers.get("Origin"), self.headers.get("Authorization", "")
        key = given.removeprefix("Bearer ").strip()
        if self.headers.get("Host") not in self._owner.hosts or not self._is_key(key):
            self._send_json(_refusal("no or a wrong key; send the header Authorization: Bearer KEY"), 403)
            return
        if origin is not None and not self._is_own_origin(origin):
            self._send_json(_refusal("a sample from another web site"), 403)
            return
        if not self._owner.takes_samples:
            self._send_json(_refusal("the poses of this capture come from elsewhere (--poses)"), 409)
            return
        body = self._body(MAX_SAMPLE)
        if body is None:
            self._send_json(_refusal(f"no Content-Length, or more than {MAX_SAMPLE} bytes"), 400)
            return
        try:
            pose = sample_pose(body)
        except InputError as error:
            self._send_json(_refusal(str(error)), 400)
            return
        self._answer_sample(pose)

    def _answer_sample(self, pose: Float[ndarray, "4 4"] | None) -> None:
        """Hand a pose to the capture, None where the client ends it, and send the answer.

        The status tells whether the image is kept, for programs that read a line only.
        """
        owner = self._owner
        if pose is None:
            owner.samples.put(None)
            self._send_json({"accepted": True, "done": True})
            return
        answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        owner.unanswered.add(id(answers))
        try:
            owner.samples.put(Ask(pose, answer=answers.put, waits=True))
            answer = answers.get(timeout=ANSWER_S)
            self._send_json(answer, 200 if answer["accepted"] else 422)
        except queue.Empty:
            self._send_json(_refusal(f"no answer within {ANSWER_S:.0f} s"), 503)
        finally:
            owner.unanswered.discard(id(answers))

    def _path(self) -> str | None:
        """Return the path behind the key; None, after an answer, where host or key are wrong."""
        if self.headers.get("Host") not in self._owner.hosts:
            self._refuse(403)
            return None
        key, slash, path = self.path.removeprefix("/").partition("/")
        if not slash or not self._is_key(key):
            self._refuse(404)
            return None
        return path

    def _is_key(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._owner.key.encode())

    def _body(self, most: int) -> bytes | None:
        """Return the body; None where its length is not stated or above `most`."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > most:
            return None
        return self.rfile.read(int(length))

    def _command(self) -> Command | None:
        """Return the command in the body; None where there is no valid one."""
        try:
            found = json.loads(self._body(MAX_COMMAND) or b"")
        except (ValueError, RecursionError):
            return None
        if not isinstance(found, dict) or found.get("action") not in get_args(Action):
            return None
        number = found.get("number")
        is_number = number is None or (isinstance(number, int) and not isinstance(number, bool))
        return Command(found["action"], number) if is_number else None

    def _send_state(self, version: str) -> None:
        """Send the state; only its version where the page has it."""
        shown = self._owner.capture.shown
        self._owner.asked_s = time.monotonic()
        if version == str(shown.version):
            self._owner.seen_version = shown.version
            content = {"version": shown.version}
        else:
            content = page_parts(self._owner.capture)
        self._send_json(content)

    def _send_now(self) -> None:
        """Send the newest image of the camera with its features."""
        frame = self._owner.capture.camera.latest()
        if frame is None:
            self._send(b"", "text/plain", 204)
            return
        image, count = with_features(frame.image)
        few = "" if count >= FEW_FEATURES else " Few: put textured things into view."
        self._send(_jpeg(image), "image/jpeg", features=f"{count} features.{few}")

    def _send_json(self, content: dict[str, Any], status: int = 200) -> None:
        self._send(json.dumps(content).encode() + b"\n", "application/json", status)

    def _send(self, body: bytes, kind: str, status: int = 200, features: str | None = None) -> None:
        """Send a response with the headers that keep other sites out."""
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": POLICY,
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        if features is not None:
            headers["X-Features"] = features
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _refuse(self, status: int) -> None:
        self._send(b"", "text/plain", status)

    def log_message(self, format: str, *arguments: object) -> None:
        """Log nothing: the terminal shows the capture."""


def sample_pose(body: bytes) -> Float[ndarray, "4 4"] | None:
    """Return base_from_gripper of a sample, None where the client is done; raise InputError where there is neither.

    A sample is `{"base_from_gripper": …}`, `{"done": true}`, or the 6, 7 or 16 numbers of the pose alone.
    """
    try:
        message = json.loads(body)
    except (ValueError, RecursionError):
        raise InputError('not JSON; send {"base_from_gripper": [[…], […], […], […]]}') from None
    if isinstance(message, dict):
        if message.get("done") is True:
            return None
        message = message.get("base_from_gripper")
    if not isinstance(message, list):
        raise InputError('no "base_from_gripper" in the body; send 4 rows of 4 numbers in metres')
    try:
        numbers = np.array(message, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError, OverflowError):
        raise InputError("base_from_gripper: not numbers; send 4 rows of 4 in metres") from None
    return pose_of_numbers(numbers, "base_from_gripper")


def _refusal(reason: str) -> Answer:
    return {"accepted": False, "reason": reason}


def _is_any_address(host: str) -> bool:
    """Test whether a host stands for all addresses of this machine."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return host == ""


@lru_cache(maxsize=128)
def _card(file: Path) -> bytes:
    """Return a small copy of an image, JPEG."""
    image = read_image(file)
    height = max(1, round(CARD_PX * image.shape[0] / image.shape[1]))
    return _jpeg(cv2.resize(image, (CARD_PX, height), interpolation=cv2.INTER_AREA))


def _jpeg(image: ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def with_features(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "h2 w2 3"], int]:
    """Return the image NOW_PX wide with a ring at each SIFT feature, and the number of features."""
    height = max(1, round(NOW_PX * image.shape[0] / image.shape[1]))
    small = cv2.resize(np.ascontiguousarray(image), (NOW_PX, height), interpolation=cv2.INTER_AREA)
    found = cv2.SIFT.create(2000).detect(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None)
    for feature in found:
        center = round(feature.pt[0]), round(feature.pt[1])
        cv2.circle(small, center, 3, (60, 235, 120), 1, cv2.LINE_AA)
    return small, len(found)
