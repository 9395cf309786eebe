"""`jcr models get` against a hub on the loopback address that breaks off, lies about lengths, and sends wrong bytes."""

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from jcr.reconstruct.backends import BACKENDS

pytestmark = pytest.mark.slow  # processes
COMMIT = "5" * 40


@dataclass
class Hub:
    """What the server has, how it misbehaves, and what it was asked."""

    weights: bytes
    config: bytes = b'{"model_name": "da3-small"}'
    fault: str = ""
    requests: list[str] = field(default_factory=list)
    """METHOD path range."""
    broken: int = 0
    """Answers that broke off so far."""
    url: str = ""

    def file(self, name: str) -> bytes:
        return self.config if name == "config.json" else self.weights


@pytest.fixture
def hub() -> Iterator[Hub]:
    made = Hub(os.urandom(3_000_000))

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, format: str, *args: object) -> None: ...

        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "")
            made.requests.append(f"{self.command} {self.path} {wanted}".strip())
            if self.path.startswith("/api/models/"):
                self.send_json(published(made))
                return
            content = made.file(self.path.rpartition("/")[2])
            lfs = content is made.weights
            etag = hashlib.sha256(content).hexdigest() if lfs else git_sum(content)
            sent = content
            if lfs and made.fault == "wrong bytes":
                sent = content[:1000] + bytes(1000) + content[2000:]
            start = int(wanted.removeprefix("bytes=").partition("-")[0]) if wanted else 0
            length = len(sent) - start
            claimed = max(length - 1_000_000, 0) if lfs and made.fault == "lies about the length" else length
            self.send_response(206 if wanted else 200)
            self.send_header("ETag", f'"{etag}"')
            self.send_header("X-Repo-Commit", COMMIT)
            self.send_header("Accept-Ranges", "bytes")
            if wanted:
                self.send_header("Content-Range", f"bytes {start}-{len(sent) - 1}/{len(sent)}")
            self.send_header("Content-Length", str(claimed))
            self.end_headers()
            if self.command == "HEAD":
                return
            often = {"breaks off": 2, "breaks off for ever": 10**9}.get(made.fault, 0)
            if lfs and made.broken < often:
                made.broken += 1
                self.wfile.write(sent[start : start + (1_000_000 if often == 2 else 100_000)])
                self.wfile.flush()
                self.connection.close()
                self.close_connection = True
                return
            self.wfile.write(sent[start : start + claimed])

        def send_json(self, facts: object) -> None:
            body = json.dumps(facts).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    made.url = f"http://127.0.0.1:{server.server_port}"
    yield made
    server.shutdown()
    server.server_close()
    thread.join()


def git_sum(content: bytes) -> str:
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


def published(hub: Hub) -> dict[str, object]:
    lfs = {"sha256": hashlib.sha256(hub.weights).hexdigest(), "size": len(hub.weights), "pointerSize": 134}
    return {
        "id": "depth-anything/DA3-SMALL",
        "sha": COMMIT,
        "siblings": [
            {"rfilename": "config.json", "size": len(hub.config), "blobId": git_sum(hub.config)},
            {"rfilename": "model.safetensors", "size": len(hub.weights), "blobId": "0" * 40, "lfs": lfs},
        ],
    }


def get(hub: Hub, home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.lower().endswith("_proxy") and name[:3] != "HF_"
    }
    return subprocess.run(
        [sys.executable, "-m", "jcr", "models", "get", *arguments],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=120,
        env=environment | {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), "HF_HUB_DISABLE_TELEMETRY": "1"},
    )


def found(home: Path, name: str) -> bytes | None:
    """A file as back ends look for it."""
    repository = home / "hub" / "models--depth-anything--DA3-SMALL"
    main = repository / "refs" / "main"
    path = repository / "snapshots" / (main.read_text() if main.is_file() else "") / name
    return path.read_bytes() if path.is_file() else None


def test_weights_come_whole_though_the_connection_breaks_and_not_twice(hub: Hub, tmp_path: Path) -> None:
    hub.fault = "breaks off"
    done = get(hub, tmp_path, "da3-small", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["revision"] == COMMIT and Path(facts["folder"], "config.json").read_bytes() == hub.config
    assert found(tmp_path, "model.safetensors") == hub.weights
    resumed = [request for request in hub.requests if "bytes=" in request and "safetensors" in request]
    assert resumed, "what came before the break is not asked for again"
    assert not list((tmp_path / "hub" / ".jcr-incoming").iterdir())

    before = len(hub.requests)
    assert get(hub, tmp_path, "da3-small").returncode == 0
    assert not any("resolve" in request for request in hub.requests[before:])

    # Other bytes under the pinned revision.
    hub.weights = os.urandom(3_000_000)
    changed = get(hub, tmp_path, "da3-small")
    assert changed.returncode == 2 and "another checksum" in changed.stderr
    assert found(tmp_path, "model.safetensors") is not None


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("wrong bytes", "not the checksum that the hub publishes"),
        ("lies about the length", "model.safetensors broke off 5 times (too short)"),
        ("breaks off for ever", "broke off 5 times"),
    ],
)
def test_what_is_not_whole_and_right_is_not_there(hub: Hub, tmp_path: Path, fault: str, words: str) -> None:
    hub.fault = fault
    done = get(hub, tmp_path, "da3-small")
    assert done.returncode == 2
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("error: depth-anything/DA3-SMALL") and words in line
    assert "Traceback" not in done.stderr
    assert found(tmp_path, "model.safetensors") is None and found(tmp_path, "config.json") is None
    if fault == "breaks off for ever":
        # What came is kept: the next attempt has less to ask for.
        hub.fault, before = "", len(hub.requests)
        assert get(hub, tmp_path, "da3-small").returncode == 0
        assert any("bytes=" in request for request in hub.requests[before:])
        assert found(tmp_path, "model.safetensors") == hub.weights


def test_a_non_commercial_licence_is_accepted_first_and_once(hub: Hub, tmp_path: Path) -> None:
    asked = get(hub, tmp_path, "mast3r")
    assert asked.returncode == 2 and "--accept-licence" in asked.stderr and not hub.requests
    accepted = get(hub, tmp_path, "mast3r", "--accept-licence")
    assert accepted.returncode == 0, accepted.stderr
    assert get(hub, tmp_path, "mast3r").returncode == 0


def test_no_hub_and_no_such_model_are_a_line(hub: Hub, tmp_path: Path) -> None:
    hub.url = "http://127.0.0.1:9"
    done = get(hub, tmp_path, "da3-small")
    assert done.returncode == 2 and "the hub did not answer" in done.stderr and "HF_ENDPOINT" in done.stderr
    unknown = get(hub, tmp_path, "colmap")
    assert unknown.returncode == 2 and "colmap has none to get" in unknown.stderr
    assert all(row.commercial or "non-commercial" in row.licence for row in BACKENDS.values())
