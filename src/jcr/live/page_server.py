"""The live page, served on this machine alone: whoever has its address sees the capture and commands it.

The address holds a key of the session. A command must come from that page: other sites in the same browser know neither
the key nor may they send the page's Origin, and a name that is made to lead here (DNS rebinding) is not its Host.
"""

import hmac
import json
import secrets
import sys
import threading
import time
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.errors import InputError
from jcr.live.collect import LiveCapture
from jcr.live.commands import Action, Command
from jcr.live.page import page_parts, whole_page

HOST = "127.0.0.1"
TIMEOUT_S = 10.0
"""For a request that has begun to be whole."""
MOST_BYTES = 1000
"""Of a command."""
LAST_S = 3.0
"""How long a page that is open is waited for at the end, so that it shows the end."""
NOW_PX, CARD_PX = 640, 330
"""Width of the camera's image and of those in the list."""
FEW_FEATURES = 150
"""SIFT features in an image of NOW_PX below which registration is at risk."""
POLICY = (
    "default-src 'none'; img-src 'self' blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class PageServer:
    """Serves the live page of a capture while it is entered."""

    def __init__(self, capture: LiveCapture, port: int = 0) -> None:
        """`port` 0: any free one. Raises InputError where it cannot listen there."""
        self.capture, self.key = capture, secrets.token_urlsafe(16)
        self.seen_version, self.asked_s = -1, -np.inf
        """The state that a page has, and when one asked last."""
        try:
            self._server = _Server((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"--page-port {port}: {error}; 0 takes any free port") from None
        self._server.page = self
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def address(self) -> str:
        """Where a browser on this machine finds the page."""
        return f"http://{HOST}:{self.port}/{self.key}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """What a browser calls this server."""
        return f"{HOST}:{self.port}", f"localhost:{self.port}"

    def __enter__(self) -> "PageServer":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        end = time.monotonic() + LAST_S
        while time.monotonic() < end and self._page_is_behind():
            time.sleep(0.05)
        self._server.shutdown()
        self._server.server_close()

    def _page_is_behind(self) -> bool:
        is_open = time.monotonic() - self.asked_s < LAST_S
        return is_open and self.seen_version < self.capture.shown.version


class _Server(ThreadingHTTPServer):
    """With the page that its requests are about."""

    page: PageServer

    def handle_error(self, request: object, client_address: object) -> None:
        """Nothing of a browser that has gone."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # pyright: ignore[reportArgumentType]


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    timeout = TIMEOUT_S
    server_version, sys_version = "jcr", ""

    @property
    def _page(self) -> PageServer:
        assert isinstance(self.server, _Server)
        return self.server.page

    def do_GET(self) -> None:
        path = self._path()
        if path is None:
            return
        path, _, query = path.partition("?")
        if path == "":
            self._send(whole_page(self._page.capture).encode(), "text/html; charset=utf-8")
        elif path == "state":
            self._send_state(query.removeprefix("version="))
        elif path == "now.jpg":
            self._send_now()
        elif path.removeprefix("image/") in self._page.capture.live.names:
            self._send(_card(self._page.capture.live.folder / path.removeprefix("image/")), "image/jpeg")
        else:
            self._refuse(404)

    def do_POST(self) -> None:
        path = self._path()
        if path is None:
            return
        origins = [f"http://{host}" for host in self._page.hosts]
        is_json = self.headers.get("Content-Type", "") == "application/json"
        if self.headers.get("Origin") not in origins or not is_json:
            self._refuse(403)
        elif path != "press" or (command := self._command()) is None:
            self._refuse(400)
        else:
            self._page.capture.press(command)
            self._send(b"", "text/plain", 204)

    def _path(self) -> str | None:
        """Behind the key; None, and an answer, where the address is not this server's."""
        if self.headers.get("Host") not in self._page.hosts:
            self._refuse(403)
            return None
        key, slash, path = self.path.removeprefix("/").partition("/")
        if not slash or not hmac.compare_digest(key.encode(), self._page.key.encode()):
            self._refuse(404)
            return None
        return path

    def _command(self) -> Command | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            return None
        try:
            found = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return None
        if not isinstance(found, dict) or found.get("action") not in get_args(Action):
            return None
        number = found.get("number")
        is_number = number is None or (isinstance(number, int) and not isinstance(number, bool))
        return Command(found["action"], number) if is_number else None

    def _send_state(self, version: str) -> None:
        shown = self._page.capture.shown
        self._page.asked_s = time.monotonic()
        if version == str(shown.version):
            self._page.seen_version = shown.version
            content = {"version": shown.version}
        else:
            content = page_parts(self._page.capture)
        self._send(json.dumps(content).encode(), "application/json")

    def _send_now(self) -> None:
        frame = self._page.capture.camera.latest()
        if frame is None:
            self._send(b"", "text/plain", 204)
            return
        image, count = with_features(frame.image)
        few = "" if count >= FEW_FEATURES else " Few: put textured things into view."
        self._send(_jpeg(image), "image/jpeg", features=f"{count} features.{few}")

    def _send(self, body: bytes, kind: str, status: int = 200, features: str | None = None) -> None:
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
        """Nothing: the terminal is the capture's."""


@lru_cache(maxsize=128)
def _card(file: Path) -> bytes:
    """A small copy of an image."""
    image = read_image(file)
    height = max(1, round(CARD_PX * image.shape[0] / image.shape[1]))
    return _jpeg(cv2.resize(image, (CARD_PX, height), interpolation=cv2.INTER_AREA))


def _jpeg(image: ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def with_features(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "h2 w2 3"], int]:
    """The image NOW_PX wide with a ring at each SIFT feature, and how many there are."""
    height = max(1, round(NOW_PX * image.shape[0] / image.shape[1]))
    small = cv2.resize(np.ascontiguousarray(image), (NOW_PX, height), interpolation=cv2.INTER_AREA)
    found = cv2.SIFT.create(2000).detect(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None)
    for feature in found:
        center = round(feature.pt[0]), round(feature.pt[1])
        cv2.circle(small, center, 3, (60, 235, 120), 1, cv2.LINE_AA)
    return small, len(found)
