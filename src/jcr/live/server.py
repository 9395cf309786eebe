"""HTTP server of a capture: the live page with its commands, and gripper poses from a program (`POST /sample`).

Every request needs the session key, in the path of the page or in the header `Authorization` of a sample. The header
`Host` must name this server (DNS rebinding), and a browser's `Origin` must be the page's own: no other web site can
read the capture, command it or add a pose.
"""

import hmac
import ipaddress
import json
import re
import secrets
import sys
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.errors import InputError
from jcr.live.page import camera_image, image_card, page_parts, whole_page
from jcr.live.robot import Action, RobotState, pose_of_numbers
from jcr.live.session import LiveSession

LOOPBACK = "127.0.0.1"
TIMEOUT_S = 10.0
"""Longest time in which a request must be complete."""
MAX_COMMAND, MAX_SAMPLE = 1000, 65_536
"""Largest body in bytes."""
OPEN_S, LAST_S = 4.0, 30.0
"""Time since its last request in which a page counts as open, and longest time in which it can fetch the result."""
HTML = "text/html; charset=utf-8"
POLICY = (
    "default-src 'none'; img-src 'self' blob: data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page, and of the report that it opens."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class _Command(BaseModel):
    """Command of the page."""

    model_config = ConfigDict(strict=True)
    action: Action
    number: int | None = None


class LiveServer(ThreadingHTTPServer):
    """HTTP server of a session while it is entered; closing waits for requests that are being answered."""

    daemon_threads = False

    def __init__(
        self,
        session: LiveSession,
        host: str = LOOPBACK,
        port: int = 0,
        token: str | None = None,
        takes_samples: bool = False,
    ) -> None:
        """Bind the address; raise InputError where that fails, or the address would be open to others.

        `host` is loopback, or the one host name that is answered, which needs a `token`, the key of the session; None:
        a random one. `port` 0 is any free one. `takes_samples`: programs post gripper poses.
        """
        if token is not None and not re.fullmatch(r"[\w.~-]+", token, re.ASCII):
            raise InputError(
                "--token: has characters that an address cannot have; use letters, digits, - and _"
            )
        where = f"{'--page-port' if host == LOOPBACK else '--listen'} {host}:{port}"
        is_any_host = host == ""
        with suppress(ValueError):
            is_any_host |= ipaddress.ip_address(host).is_unspecified
        if is_any_host:
            raise InputError(f"{where}: names no host; give the address of this machine that the robot uses")
        if host != LOOPBACK and token is None:
            raise InputError(f"{where}: others can reach that address; set a token (JCR_TOKEN)")
        self.session, self.key, self.host = session, token or secrets.token_urlsafe(16), host
        self.takes_samples = takes_samples
        self.sampled_s = time.monotonic()
        """Time of the last sample; infinite while one is answered."""
        self._page_version, self._page_s = -1, -np.inf
        """Version of the state that the page has, and the time of its last request."""
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"{where}: {error}; choose an address of this machine and a free port") from None
        names = (LOOPBACK, "localhost") if self.host == LOOPBACK else (self.host,)
        self.hosts = tuple(f"{name}:{self.server_address[1]}" for name in names)
        """Accepted values of the header Host."""
        self.address = f"http://{self.hosts[0]}/{self.key}/"
        """Address of the page, key included."""

    @property
    def report(self) -> Path | None:
        """Report of the calibration at the end; None while there is none."""
        result = self.session.state.result
        file = None if result is None else result.out / "report.html"
        return file if file is not None and file.is_file() else None

    def await_samples(self, timeout_s: float) -> None:
        """Return when the session is over; raise InputError after `timeout_s` without a sample."""
        while not self.session.state.is_over:
            if time.monotonic() - self.sampled_s > timeout_s:
                raise InputError(
                    f"--poses http: no sample for {timeout_s:.0f} s; the images taken are kept and the same command "
                    "resumes"
                )
            time.sleep(0.1)

    def page_has(self, version: int) -> None:
        """Note the version of the state that the page has."""
        self._page_version, self._page_s = max(self._page_version, version), time.monotonic()

    def __enter__(self) -> "LiveServer":
        """Serve in a thread."""
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        """Let an open page fetch the last state and send the last answers, then stop."""
        end = time.monotonic() + LAST_S
        while time.monotonic() < end and (
            time.monotonic() - self._page_s < OPEN_S and self._page_version < self.session.state.version
        ):
            time.sleep(0.05)
        self.shutdown()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections that the client closed; report anything else."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]


class _Handler(BaseHTTPRequestHandler):
    """Handler of one request."""

    timeout = TIMEOUT_S
    server_version, sys_version = "jcr", ""
    server: LiveServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        """Answer a request of the page."""
        if (path := self._path()) is None:
            return
        path, _, query = path.partition("?")
        server, session, state = self.server, self.server.session, self.server.session.state
        name = path.removeprefix("image/")
        if path == "":
            self._send(whole_page(session).encode(), HTML)
        elif path == "state":
            # Only the version where the page has the state.
            has_it = query.removeprefix("version=") == str(state.version)
            server.page_has(state.version if has_it else -1)
            has_report = server.report is not None
            self._send_json({"version": state.version} if has_it else page_parts(session, state, has_report))
        elif path == "now.jpg" and (frame := session.camera.latest()) is not None:
            jpeg, features = camera_image(frame.image)
            self._send(jpeg, "image/jpeg", X_Features=features)
        elif path == "now.jpg":
            self._send(status=204)
        elif path == "report.html" and (report := server.report) is not None:
            self._send(report.read_bytes(), HTML)
        elif name != path and name in state.names:
            self._send(image_card(session.folder.folder / name), "image/jpeg")
        else:
            self._send(status=404)

    def do_POST(self) -> None:
        """Obey a command of the page, or take a sample."""
        if self.path == "/sample":
            self._send_json(*self._sampled())
        elif (path := self._path()) is not None:
            is_json = self.headers.get("Content-Type", "") == "application/json"
            is_own, command = is_json and self._is_own_origin(), None
            with suppress(ValidationError):
                command = _Command.model_validate_json(self._body(MAX_COMMAND) or b"")
            if is_own and path == "press" and command is not None:
                self.server.session.press(command.action, command.number)
                self._send(status=204)
            else:
                self._send(status=400 if is_own else 403)

    def _sampled(self) -> tuple[dict[str, Any], int]:
        """Take an image at the pose in the body; return the answer and the status."""
        server, why, status = self.server, None, 400
        key = self.headers.get("Authorization", "").removeprefix("Bearer ").strip()
        if self.headers.get("Host") not in server.hosts or not self._is_key(key):
            why, status = "no or a wrong key; send the header Authorization: Bearer KEY", 403
        elif "Origin" in self.headers and not self._is_own_origin():
            why, status = "a sample from another web site", 403
        elif not server.takes_samples:
            why, status = "the poses of this capture come from elsewhere (--poses)", 409
        elif (body := self._body(MAX_SAMPLE)) is None:
            why = f"no Content-Length, or more than {MAX_SAMPLE} bytes"
        else:
            try:
                pose = sample_pose(body)
            except InputError as error:
                why = str(error)
            else:
                if pose is None:
                    server.session.end()
                    return {"accepted": True, "done": True}, 200
                server.sampled_s = np.inf
                answer = server.session.take(RobotState(time.monotonic(), pose), waits=True)
                server.sampled_s = time.monotonic()
                # The status tells whether the image is kept, for programs that read a line only.
                return answer, 200 if answer["accepted"] else 422
        return {"accepted": False, "reason": why}, status

    def _is_own_origin(self) -> bool:
        """Test whether a browser's request comes from the page."""
        return self.headers.get("Origin") in [f"http://{host}" for host in self.server.hosts]

    def _path(self) -> str | None:
        """Return the path behind the key; None, after an answer, where host or key are wrong."""
        key, slash, path = self.path.removeprefix("/").partition("/")
        if self.headers.get("Host") not in self.server.hosts:
            self._send(status=403)
        elif not slash or not self._is_key(key):
            self._send(status=404)
        else:
            return path
        return None

    def _is_key(self, given: str) -> bool:
        """Compare a key in constant time."""
        return hmac.compare_digest(given.encode(), self.server.key.encode())

    def _body(self, most: int) -> bytes | None:
        """Return the body; None where its length is not stated or above `most`."""
        length = self.headers.get("Content-Length", "")
        return self.rfile.read(int(length)) if length.isdecimal() and int(length) <= most else None

    def _send_json(self, content: dict[str, Any], status: int = 200) -> None:
        """Send a response of JSON."""
        self._send(json.dumps(content).encode() + b"\n", "application/json", status)

    def _send(self, body: bytes = b"", kind: str = "text/plain", status: int = 200, **headers: str) -> None:
        """Send a response with the headers that keep other sites out."""
        self.send_response(status)
        own = {"Content-Type": kind, "Content-Length": str(len(body))} | headers
        for name, value in (own | HEADERS).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

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
