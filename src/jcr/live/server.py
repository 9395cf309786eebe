"""HTTP server of a capture: the live page, and gripper poses and commands of a program (`POST /sample`, `/press`).

Every request needs the session key, in the path of the page or in the header `Authorization` of a program. The header
`Host` must name this server (protection against DNS rebinding), and the header `Origin` of a browser must be that of the
page. Other web sites can therefore not read the capture, send commands or add a pose.
"""

import hmac
import json
import re
import secrets
import sys
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, get_args
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, ValidationError

from jcr.errors import InputError, RejectedError
from jcr.live.page import camera_image, image_card, page_parts, whole_page
from jcr.live.robot import Action, RobotState, pose_of_numbers
from jcr.live.session import LiveSession

LOOPBACK = "127.0.0.1"
REQUEST_S = 10.0
"""Time (s) within which a request must be complete."""
MAX_COMMAND, MAX_SAMPLE = 1000, 65_536
"""Largest bodies (bytes) of a command and of a sample."""
OPEN_S, LAST_S = 4.0, 30.0
"""Time (s) after its last request for which a page counts as open, and longest time (s) that the server waits at the
end until an open page has the last state."""
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
    """Command of the page or of a program: an action, and the number of its image, counted from 1 (None: the last)."""

    model_config = ConfigDict(strict=True)
    action: Action
    number: int | None = None


class LiveServer(ThreadingHTTPServer):
    """HTTP server of a live capture's page; it serves inside its `with` statement, whose end waits for open requests."""

    daemon_threads = False

    def __init__(
        self,
        session: LiveSession,
        port: int = 0,
        token: str | None = None,
        takes_samples: bool = False,
    ) -> None:
        """Bind a port of the loopback address; raise InputError if that fails.

        `token` is the key that the addresses of all requests contain; None: a random key. `port` 0: any free port.
        `takes_samples`: other programs may post gripper poses, at which images are then taken.
        """
        if token is not None and not re.fullmatch(r"[\w.~-]+", token, re.ASCII):
            raise InputError("JCR_TOKEN: has characters that no address has; use letters, digits, - and _")
        self.session, self.key = session, token or secrets.token_urlsafe(16)
        self.takes_samples = takes_samples
        self.page_version, self.page_s = -1, -np.inf
        """Version of the state that the page shows, and time (s, monotonic clock) of the page's last request."""
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"--page-port {port}: {error}; choose a free port") from None
        self.hosts = tuple(f"{name}:{self.server_address[1]}" for name in (LOOPBACK, "localhost"))
        """Accepted values of the header `Host`: name and port of this server."""
        self.address = f"http://{self.hosts[0]}/{self.key}/"
        """URL of the page, which includes the key."""

    @property
    def report(self) -> Path | None:
        """File of the report on the final calibration; None if it does not exist."""
        result = self.session.state.result
        file = None if result is None else result.out / "report.html"
        return file if file is not None and file.is_file() else None

    def __enter__(self) -> "LiveServer":
        """Start to serve requests in a thread."""
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        """Wait, for LAST_S at most, until an open page has the last state; then stop the server.

        `error` is the exception of the `with` block, which is raised again.
        """
        end = time.monotonic() + LAST_S
        while time.monotonic() < end and (
            time.monotonic() - self.page_s < OPEN_S and self.page_version < self.session.state.version
        ):
            time.sleep(0.05)
        self.shutdown()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors of connections that the client closed; report all others."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]


class _Handler(BaseHTTPRequestHandler):
    """Handler of one HTTP request to a LiveServer."""

    timeout = REQUEST_S
    server_version, sys_version = "jcr", ""
    server: LiveServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        """Answer a GET request of a program for the state, or of the page: page, state, images, or report."""
        if self.path == "/state":
            refused = self._refused()
            self._send_json(*((self._state(), 200) if refused is None else ({"reason": refused}, 403)))
            return
        if (path := self._path()) is None:
            return
        path, _, query = path.partition("?")
        server, session, state = self.server, self.server.session, self.server.session.state
        name = unquote(path.removeprefix("image/"))
        if path == "":
            self._send(whole_page(session).encode(), HTML)
        elif path == "state":
            server.page_s, content = time.monotonic(), {"version": state.version}
            if query.removeprefix("version=") == str(state.version):  # the page has the newest state
                server.page_version = state.version
            else:
                content = page_parts(session, state, server.report is not None)
            self._send_json(content)
        elif path == "now.jpg" and (frame := session.camera.latest()) is not None:
            jpeg, features = camera_image(frame.image)
            self._send(jpeg, "image/jpeg", X_Features=features)
        elif path == "now.jpg":
            self._send(status=204)
        elif path == "report.html" and (report := server.report) is not None:
            self._send(report.read_bytes(), HTML)
        elif path.startswith("image/") and name in state.names:
            self._send(image_card(session.folder.folder / name), "image/jpeg")
        else:
            self._send(status=404)

    def do_POST(self) -> None:
        """Execute a command of the page or of a program, or take an image at the gripper pose of a posted sample."""
        programs = {"/sample": self._sampled, "/press": self._pressed, "/verify": self._verified}
        if (answered := programs.get(self.path)) is not None:
            if (refused := self._refused()) is not None:
                answer, status = {"accepted": False, "reason": refused}, 403
            else:
                try:
                    answer, status = answered()
                except Exception as error:  # a fault of jcr, which the terminal prints in full
                    why = " ".join(f"{type(error).__name__}: {error}".split())
                    reason = f"unexpected error, {why}; the capture keeps its images"
                    answer, status = {"accepted": False, "reason": reason}, 500
            self._send_json(answer, status)
        elif (path := self._path()) is not None:
            is_json = self.headers.get("Content-Type", "") == "application/json"
            is_own, command = is_json and self._is_own_origin(), self._command()
            if is_own and path == "press" and command is not None:
                self.server.session.press(command.action, command.number)
                self._send(status=204)
            else:
                self._send(status=400 if is_own else 403)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer another method than GET and POST with the reason as JSON, and other errors as the base class does."""
        if code != HTTPStatus.NOT_IMPLEMENTED:
            super().send_error(code, message, explain)
            return
        reason = f"the method {self.command} is not allowed; use GET or POST"
        self._send_json({"accepted": False, "reason": reason}, HTTPStatus.METHOD_NOT_ALLOWED)

    def _command(self) -> _Command | None:
        """Return the command in the request's body; None if it is none."""
        with suppress(ValidationError):
            return _Command.model_validate_json(self._body(MAX_COMMAND) or b"")
        return None

    def _pressed(self) -> tuple[dict[str, Any], int]:
        """Execute a program's command; return the state after it and the HTTP status, 422 if it is refused."""
        if (command := self._command()) is None:
            listed = ", ".join(get_args(Action))
            return {"accepted": False, "reason": f'send {{"action": …, "number": …}}; actions: {listed}'}, 400
        session = self.server.session
        if session.state.is_over:
            return self._state() | {"accepted": False, "reason": "the capture has ended"}, 422
        session.press(command.action, command.number)
        state = session.state
        answer = self._state() | {"accepted": not state.is_refusal}
        return (answer | {"reason": state.event}, 422) if state.is_refusal else (answer, 200)

    def _state(self) -> dict[str, Any]:
        """Return the state of the capture for programs: its images, last event, and last calibration."""
        state = self.server.session.state
        return state.progress.as_json() | {
            "images": state.names,
            "event": state.event,
            "done": state.is_over,
        }

    def _refused(self) -> str | None:
        """Return the reason why a request of a program is refused; None if its key, host and origin are right."""
        key = self.headers.get("Authorization", "").removeprefix("Bearer ").strip()
        if (foreign := self._foreign_host()) is not None:
            return foreign
        if not self._is_key(key):
            return "no or a wrong key; send the header Authorization: Bearer KEY"
        if "Origin" in self.headers and not self._is_own_origin():
            return "a request from another web site"
        return None

    def _verified(self) -> tuple[dict[str, Any], int]:
        """Verify the run with the images taken so far; return the answer and the HTTP status."""
        if self._body(MAX_COMMAND) is None:
            return {"reason": f"no Content-Length, or more than {MAX_COMMAND} bytes"}, 400
        session = self.server.session
        try:
            return session.verify().as_json(), 200
        except (InputError, RejectedError) as error:
            return {"reason": str(error)}, 409 if session.state.verifies is None else 422

    def _sampled(self) -> tuple[dict[str, Any], int]:
        """Take an image at the gripper pose in the request's body; return the answer and the HTTP status."""
        server, why, status = self.server, None, 400
        if not server.takes_samples:
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
                answer = server.session.take(RobotState(time.monotonic(), pose), waits=True)
                # Programs that do not parse the body see from the status whether the image is kept.
                return answer, 200 if answer["accepted"] else 422
        return {"accepted": False, "reason": why}, status

    def _foreign_host(self) -> str | None:
        """Return the reason why the header `Host` is refused; None if it names this server."""
        if (host := self.headers.get("Host")) in self.server.hosts:
            return None
        return f"the host {host} is not allowed in the header Host; address {' or '.join(self.server.hosts)}"

    def _is_own_origin(self) -> bool:
        """Test whether the header `Origin` is that of this server's page."""
        return self.headers.get("Origin") in [f"http://{host}" for host in self.server.hosts]

    def _path(self) -> str | None:
        """Return the request's path after the key; None if host or key are wrong, after an error was sent."""
        key, slash, path = self.path.removeprefix("/").partition("/")
        if (foreign := self._foreign_host()) is not None:
            self._send_json({"reason": foreign}, 403)
        elif not slash or not self._is_key(key):
            self._send_json(
                {"reason": "not found; programs use GET /state and POST /sample, /press, /verify"}, 404
            )
        else:
            return path
        return None

    def _is_key(self, given: str) -> bool:
        """Test whether a key is that of the session, in a time that does not depend on the key."""
        return hmac.compare_digest(given.encode(), self.server.key.encode())

    def _body(self, most: int) -> bytes | None:
        """Return the request's body; None if its length is not stated or exceeds `most` bytes."""
        length = self.headers.get("Content-Length", "")
        is_stated = length.isdecimal() and len(length) < 10 and int(length) <= most
        return self.rfile.read(int(length)) if is_stated else None

    def _send_json(self, content: dict[str, Any], status: int = 200) -> None:
        """Send a response with JSON content."""
        text = json.dumps(content, default=lambda array: array.tolist())
        self._send(text.encode() + b"\n", "application/json", status)

    def _send(self, body: bytes = b"", kind: str = "text/plain", status: int = 200, **headers: str) -> None:
        """Send a response with MIME type `kind`, HTTP `status`, and the security headers HEADERS.

        `headers` are further headers by name; an underscore in a name becomes a hyphen.
        """
        self.send_response(status)
        own = {"Content-Type": kind, "Content-Length": str(len(body))} | headers
        for name, value in (own | HEADERS).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Log nothing, because the terminal shows the progress of the capture."""


def sample_pose(body: bytes) -> Float[ndarray, "4 4"] | None:
    """Return base_from_gripper (4,4) from the body of a sample; None if the client ends the capture.

    The body is JSON: `{"base_from_gripper": …}`, or the 6, 7 or 16 numbers of the pose alone, or `{"done": true}`.
    Raises InputError for anything else.
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
        raise InputError('no "base_from_gripper" in the body; send 4 rows of 4, or 6, 7 or 16 numbers')
    try:
        numbers = np.array(message, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError, OverflowError):
        raise InputError("base_from_gripper: not numbers; send 4 rows of 4, or 6, 7 or 16 numbers") from None
    return pose_of_numbers(numbers, "base_from_gripper")
