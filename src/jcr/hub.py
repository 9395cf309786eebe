"""Access to weights of networks in the local cache of the Hugging Face hub, and download for `jcr models get`."""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from jcr.errors import InputError
from jcr.extras import extra, is_installed

HUB_FILES = ("config.json", "model.safetensors")
"""Names of the files that the weights of every network consist of."""
HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
"""Pattern of a hub id: owner/name."""


@dataclass(frozen=True)
class Weights:
    """Location, name and licence of a network's weights on this machine."""

    path: Path
    """File with the weights, or folder with their files."""
    name: str
    """Path or hub id that the user gave, or the hub id of the published weights."""
    licence: str

    @property
    def note(self) -> str:
        """Note for the result that names the weights and their licence."""
        return f"weights {self.name}: licence {self.licence}"


def cached_files(hub_id: str, revision: str | None = None) -> list[Path]:
    """Return the paths of the HUB_FILES (settings and weights) of a hub id in the local cache; empty unless all exist.

    `revision` is a commit; None: the newest downloaded one. The internet is not accessed.
    """
    if not is_installed("huggingface_hub"):
        return []
    from huggingface_hub import constants

    # The import of the hub's client takes 0.1 s, so it is skipped if the cache has no folder for the hub id.
    if not (Path(constants.HF_HUB_CACHE) / f"models--{hub_id.replace('/', '--')}").is_dir():
        return []
    from huggingface_hub import try_to_load_from_cache

    found = [
        try_to_load_from_cache(hub_id, name, constants.HF_HUB_CACHE, revision=revision) for name in HUB_FILES
    ]
    # try_to_load_from_cache returns no text for a file that is missing in the cache or on the hub.
    paths = [Path(path) for path in found if isinstance(path, str)]
    return paths if len(paths) == len(HUB_FILES) else []


def download(hub_id: str, revision: str | None = None, quiet: bool = False) -> Path:
    """Download the HUB_FILES (settings and weights) of a hub id to the local cache and return their folder.

    `revision` is a commit; None: the newest one. Files in the cache are not downloaded again, but compared with their
    published checksums. Raises InputError if the hub cannot be reached, lacks a file, or if a checksum differs; that
    file is then deleted.
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
    except Exception as error:  # network errors depend on the client's version
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(
            f"{hub_id}: not downloaded ({reason}); try again, check the network, HTTPS_PROXY, or set HF_ENDPOINT to a "
            "mirror"
        ) from None
    for name in HUB_FILES:
        path = folder / name
        if not path.is_file():
            raise InputError(f"{hub_id}: the hub has no {name} of it; ask for another --revision")
        # The hub's client names a file by its checksum (SHA-256, or git's SHA-1 for a small file), but not on systems
        # without symbolic links.
        published, blob = path.resolve().name, f"blob {path.stat().st_size}\0".encode()
        digest = hashlib.sha256() if len(published) == 64 else hashlib.sha1(blob, usedforsecurity=False)
        with path.open("rb") as content:
            found = hashlib.file_digest(content, digest.copy).hexdigest()
        if found != published and re.fullmatch("[0-9a-f]{64}|[0-9a-f]{40}", published):
            path.resolve().unlink()
            path.unlink()
            raise InputError(
                f"{hub_id}: {name} has not the checksum that the hub publishes for it; it was deleted: try again, and "
                "ask who runs the mirror or proxy in between"
            )
    return folder
