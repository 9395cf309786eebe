"""Weights of networks in the local cache of the Hugging Face hub, and their download by `jcr models get`."""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from jcr.errors import InputError
from jcr.extras import extra, is_installed

HUB_FILES = ("config.json", "model.safetensors")
"""Files of the weights of every network."""
HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class Weights:
    """Weights of a network on this machine."""

    path: Path
    """File of the weights, or folder of their files."""
    name: str
    """Path or hub id that the user named."""
    licence: str

    @property
    def note(self) -> str:
        """Note on the weights and their licence for the result."""
        return f"weights {self.name}: licence {self.licence}"


def cached_files(hub_id: str, revision: str | None = None) -> list[Path]:
    """Return the HUB_FILES of a hub id from the cache of this machine: of one commit, or of the newest downloaded one.

    The network is not asked. The list is empty unless all files are there.
    """
    if not is_installed("huggingface_hub"):
        return []
    from huggingface_hub import constants

    # Its client for the network takes a tenth of a second to import, which most machines can spare.
    if not (Path(constants.HF_HUB_CACHE) / f"models--{hub_id.replace('/', '--')}").is_dir():
        return []
    from huggingface_hub import try_to_load_from_cache

    found = [
        try_to_load_from_cache(hub_id, name, constants.HF_HUB_CACHE, revision=revision) for name in HUB_FILES
    ]
    # The result is no path where a file is missing here, or known to be missing on the hub.
    paths = [Path(path) for path in found if isinstance(path, str)]
    return paths if len(paths) == len(HUB_FILES) else []


def download(hub_id: str, revision: str | None = None, quiet: bool = False) -> Path:
    """Download the HUB_FILES of a hub id, of a commit or of the newest one, and return their folder in the cache.

    Files in the cache are not downloaded again; every file is compared with its published checksum. Raises InputError
    where the hub cannot be reached, has no such files, or sent other bytes than it publishes; these are deleted.
    """
    extra("huggingface_hub", "networks", "jcr models get")
    from huggingface_hub import constants, snapshot_download
    from huggingface_hub.utils import disable_progress_bars

    if constants.HF_HUB_OFFLINE:
        raise InputError(f"{hub_id}: HF_HUB_OFFLINE is set, so nothing is downloaded; unset it")
    if quiet:
        disable_progress_bars()
    try:
        folder = Path(snapshot_download(hub_id, revision=revision, allow_patterns=list(HUB_FILES)))
    except Exception as error:  # those of its transport (requests, httpx) differ by its version
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(
            f"{hub_id}: not downloaded ({reason}); try again, check the network, HTTPS_PROXY, or set HF_ENDPOINT to a "
            "mirror"
        ) from None
    for name in HUB_FILES:
        path = folder / name
        if not path.is_file():
            raise InputError(f"{hub_id}: the hub has no {name} of it; ask for another --revision")
        if not _is_as_published(path):
            path.resolve().unlink()
            path.unlink()
            raise InputError(
                f"{hub_id}: {name} has not the checksum that the hub publishes for it; it was deleted: try again, and "
                "ask who runs the mirror or proxy in between"
            )
    return folder


def _is_as_published(path: Path) -> bool:
    """Test whether a file has the checksum by which the hub's cache names it: SHA-256, or git's SHA-1 of a small file.

    The result is true where a system without symbolic links keeps no such name.
    """
    published = path.resolve().name
    if re.fullmatch("[0-9a-f]{64}", published):
        digest = hashlib.sha256()
    elif re.fullmatch("[0-9a-f]{40}", published):
        digest = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
    else:
        return True
    with path.open("rb") as content:
        while block := content.read(1 << 22):
            digest.update(block)
    return digest.hexdigest() == published
