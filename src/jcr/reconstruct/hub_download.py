"""Published weights onto this machine: whole, checked, and only then where they are looked for.

Where files lie, HF_ENDPOINT (a mirror), HF_TOKEN and HF_HOME are as the hub's own client has them, HTTPS_PROXY as
everywhere. What comes first lies in a folder beside the cache, from where an interrupted download is resumed to the
byte (the client's own starts again: it writes in pieces of 10 MB and keeps none of a broken one); it is moved into the
cache when size and checksum are those that the hub publishes for the revision. The revision and the sums are kept
beside the cache and hold from then on: a file that changes under its name is refused.
"""

import hashlib
import http.client
import json
import os
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from jcr.errors import InputError
from jcr.extras import extra
from jcr.files import write_text
from jcr.progress import Progress, silent

ATTEMPTS = 5
"""At one file; each resumes where the one before broke off."""
PAUSE_S = 0.2
"""Before the second attempt, and twice as long before each later one."""
TIMEOUT_S = 30.0
BLOCK = 1 << 20
RESERVE = 200_000_000
"""Bytes of the disk that stay free."""


@dataclass(frozen=True)
class _File:
    """A file as the hub publishes it."""

    name: str
    size: int
    sha256: str | None
    blob_id: str
    """SHA-1 as git counts it, for small files that have no SHA-256."""


def download(
    hub_id: str, names: Sequence[str], revision: str | None = None, progress: Progress | None = None
) -> Path:
    """The folder of the files of a hub id, downloaded unless they are there; (a commit) `revision` or the one pinned.

    Raises InputError, and leaves the cache as it was, where the hub cannot be reached, has no such files, sends others
    than it publishes, or others than were pinned here.
    """
    extra("huggingface_hub", "networks", "jcr models get")
    from huggingface_hub import constants

    cache = Path(constants.HF_HUB_CACHE)
    pinned = pins().get(hub_id, {})
    commit, files = _published(hub_id, names, revision or pinned.get("revision"))
    if pinned.get("revision") == commit:
        for file in files:
            if pinned["files"].get(file.name, _sum(file)) != _sum(file):
                raise InputError(
                    f"{hub_id}: {file.name} of revision {commit[:12]} has another checksum than it had when it was "
                    "first downloaded; do not use it, or delete its entry in "
                    f"{_pins_path()} where you trust the hub more"
                )
    folder = cache / f"models--{hub_id.replace('/', '--')}"
    snapshot = folder / "snapshots" / commit
    missing = [file for file in files if not _is_there(snapshot / file.name, file)]
    _require_space(cache, sum(file.size for file in missing))
    parts = [_fetched(hub_id, file, commit, cache / ".jcr-incoming", progress or silent) for file in missing]
    for file, part in zip(missing, parts, strict=True):
        (snapshot / file.name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(part, snapshot / file.name)
    # Last: by this name all others are found.
    write_text(folder / "refs" / "main", commit)
    keep_pin(hub_id, {"revision": commit, "files": {file.name: _sum(file) for file in files}})
    return snapshot


def pins() -> dict[str, Any]:
    """What was downloaded before, by hub id: revision, checksums, and licences accepted."""
    try:
        return json.loads(_pins_path().read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def keep_pin(hub_id: str, values: dict[str, Any]) -> None:
    """Add to what is kept of a hub id."""
    kept = pins()
    kept[hub_id] = kept.get(hub_id, {}) | values
    write_text(_pins_path(), json.dumps(kept, indent=1) + "\n")


def _pins_path() -> Path:
    from huggingface_hub import constants

    return Path(constants.HF_HUB_CACHE) / "jcr-pins.json"


def _published(hub_id: str, names: Sequence[str], revision: str | None) -> tuple[str, list[_File]]:
    """The commit that a revision is, and the files as it has them."""
    from huggingface_hub import HfApi
    from huggingface_hub.errors import OfflineModeIsEnabled

    try:
        info = HfApi().model_info(hub_id, revision=revision, files_metadata=True, timeout=30)
    except OfflineModeIsEnabled:
        raise InputError(f"{hub_id}: HF_HUB_OFFLINE is set, so nothing is downloaded; unset it") from None
    except Exception as error:
        if not _of_the_network(error):
            raise
        raise InputError(f"{hub_id}: the hub did not answer ({_line(error)}); {_network_advice()}") from None
    files = {sibling.rfilename: sibling for sibling in info.siblings or ()}
    found = []
    for name in names:
        file = files.get(name)
        if file is None or file.size is None or info.sha is None:
            raise InputError(f"{hub_id}: the hub has no {name} of it; ask for another --revision")
        found.append(_File(name, file.size, file.lfs.sha256 if file.lfs else None, file.blob_id or ""))
    assert info.sha is not None
    return info.sha, found


def _fetched(hub_id: str, file: _File, commit: str, incoming: Path, report: Progress) -> Path:
    """A file, whole and checked, resumed as often as its connection breaks; not where it is looked for yet."""
    incoming.mkdir(parents=True, exist_ok=True)
    part = incoming / _sum(file)
    trouble = ""
    for attempt in range(ATTEMPTS):
        if attempt:
            time.sleep(PAUSE_S * 2 ** (attempt - 1))
        try:
            _append(hub_id, file, commit, part, report)
        except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
            trouble = _line(error)
        if part.is_file() and part.stat().st_size >= file.size:
            if _is_there(part, file):
                return part
            part.unlink()
            raise InputError(
                f"{hub_id}: {file.name} has not the checksum that the hub publishes for it; it was deleted: try again, "
                "and ask who runs the mirror or proxy in between"
            )
    raise InputError(
        f"{hub_id}: {file.name} broke off {ATTEMPTS} times ({trouble or 'too short'}); what came is kept, and the same "
        f"command resumes; {_network_advice()}"
    )


def _append(hub_id: str, file: _File, commit: str, part: Path, report: Progress) -> None:
    """What is missing of a file, to the end of what came before; never more than its size."""
    from huggingface_hub import constants, get_token

    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(f"{constants.ENDPOINT}/{hub_id}/resolve/{commit}/{file.name}")
    request.add_header("User-Agent", "jcr")
    if have:
        request.add_header("Range", f"bytes={have}-")
    if token := get_token():
        # Not sent on to where the hub refers us.
        request.add_unredirected_header("Authorization", f"Bearer {token}")
    if urlsplit(request.full_url).scheme not in ("http", "https"):
        raise InputError(f"HF_ENDPOINT {constants.ENDPOINT}: give an http or https address")
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:  # nosec B310
        if have and answer.status != 206:
            have = 0
        with part.open("r+b" if have else "wb") as kept:
            kept.seek(have)
            while have < file.size and (block := answer.read(min(BLOCK, file.size - have))):
                kept.write(block)
                have += len(block)
                report(f"{hub_id} {file.name}", have / file.size)


def _of_the_network(error: Exception) -> bool:
    """Whether the connection or the hub is at fault; the client's transport (requests, httpx) differs by its version."""
    from huggingface_hub.errors import HfHubHTTPError

    transport = (
        type(error).__module__.partition(".")[0].startswith(("httpx", "httpcore", "requests", "urllib3"))
    )
    return transport or isinstance(error, HfHubHTTPError | OSError | RuntimeError | ValueError)


def _is_there(path: Path, file: _File) -> bool:
    """Whether a file has the size and the checksum that were published."""
    if not path.is_file() or path.stat().st_size != file.size:
        return False
    if file.sha256 is not None:
        digest = hashlib.sha256()
    else:
        digest = hashlib.sha1(f"blob {file.size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as content:
        while block := content.read(1 << 22):
            digest.update(block)
    return digest.hexdigest() == _sum(file)


def _sum(file: _File) -> str:
    return file.sha256 or file.blob_id


def _require_space(cache: Path, size: int) -> None:
    cache.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(cache).free < size + RESERVE:
        raise InputError(
            f"{cache}: {size / 1e9:.2g} GB do not fit on its disk; free some, or set HF_HOME to another"
        )


def _network_advice() -> str:
    return "check the network, HTTPS_PROXY, or set HF_ENDPOINT to a mirror"


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
