"""`jcr models get` by huggingface_hub against a hub on the loopback address that sends wrong bytes."""

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

from jcr.backends import BACKENDS

pytestmark = pytest.mark.slow  # processes
COMMIT = BACKENDS["da3-small"].revision


@dataclass
class Hub:
    """What the server has, how it misbehaves, and what it was asked."""

    weights: bytes
    config: bytes = b'{"model_name": "da3-small"}'
    fault: str = ""
    requests: list[str] = field(default_factory=list)
    """METHOD path."""
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
            made.requests.append(f"{self.command} {self.path}")
            if self.path.startswith("/api/models/"):
                self.send_json(tree(made) if "/tree/" in self.path else {"id": "any", "sha": "5" * 40})
                return
            content = made.file(self.path.rpartition("/")[2])
            lfs = content is made.weights
            etag = hashlib.sha256(content).hexdigest() if lfs else git_sum(content)
            sent = content
            if lfs and made.fault == "wrong bytes":
                sent = content[:1000] + bytes(1000) + content[2000:]
            self.send_response(200)
            self.send_header("ETag", f'"{etag}"')
            self.send_header("X-Repo-Commit", self.path.split("/")[-2])
            self.send_header("Content-Length", str(len(sent)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(sent)

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


def tree(hub: Hub) -> list[dict[str, object]]:
    """The files of the repository, as the hub lists them."""
    size = len(hub.weights)
    lfs = {"oid": hashlib.sha256(hub.weights).hexdigest(), "size": size, "pointerSize": 134}
    return [
        {"type": "file", "path": "config.json", "size": len(hub.config), "oid": git_sum(hub.config)},
        {"type": "file", "path": "model.safetensors", "size": size, "oid": "0" * 40, "lfs": lfs},
    ]


GET = """
import sys
from jcr.cli import dispatch
from jcr.hub import cached_files
*arguments, hub_id = sys.argv[1:]
status = dispatch(["models", "get", *arguments])
print(*(cached_files(hub_id) if hub_id else ()))
sys.exit(status)
"""
"""`jcr models get`; then the files as a run looks for them."""


def get(hub: Hub, home: Path, *arguments: str, look_for: str = "") -> subprocess.CompletedProcess[str]:
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.lower().endswith("_proxy") and name[:3] != "HF_"
    }
    return subprocess.run(
        [sys.executable, "-c", GET, *arguments, look_for], capture_output=True, text=True,
        stdin=subprocess.DEVNULL, timeout=120,
        env=environment | {"HF_ENDPOINT": hub.url, "HF_HOME": str(home), "HF_HUB_DISABLE_TELEMETRY": "1"},
    )  # fmt: skip


def test_weights_come_whole_and_not_twice(hub: Hub, tmp_path: Path) -> None:
    done = get(hub, tmp_path, "da3-small", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    folder = Path(facts["folder"])
    assert facts["revision"] == COMMIT and (folder / "config.json").read_bytes() == hub.config
    assert (folder / "model.safetensors").read_bytes() == hub.weights
    assert any(COMMIT in request for request in hub.requests), "the pinned revision is asked for"
    before = len(hub.requests)
    assert get(hub, tmp_path, "da3-small").returncode == 0
    assert not any("resolve" in request for request in hub.requests[before:])


def test_weights_of_another_checksum_are_deleted(hub: Hub, tmp_path: Path) -> None:
    hub.fault = "wrong bytes"
    done = get(hub, tmp_path, "owner/any", look_for="owner/any")
    assert done.returncode == 2 and done.stdout.split() == []
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("error: owner/any") and "not the checksum that the hub publishes" in line
    assert "Traceback" not in done.stderr
    hub.fault = ""
    again = get(hub, tmp_path, "owner/any", look_for="owner/any")
    assert again.returncode == 0
    assert Path(again.stdout.split()[-1]).read_bytes() == hub.weights


def test_a_non_commercial_licence_is_accepted_first_and_once(hub: Hub, tmp_path: Path) -> None:
    asked = get(hub, tmp_path, "mast3r")
    assert asked.returncode == 2 and "--accept-licence" in asked.stderr and not hub.requests
    accepted = get(hub, tmp_path, "mast3r", "--accept-licence")
    assert accepted.returncode == 0, accepted.stderr
    assert get(hub, tmp_path, "mast3r").returncode == 0
