"""Options of the COLMAP back end."""

from dataclasses import dataclass

from jcr.features.matchers import FeatureName


@dataclass(frozen=True, kw_only=True)
class ColmapOptions:
    """Structure from motion without a network."""

    working_size_px: int = 1600
    """Images whose long side is larger are reduced to this before features are extracted."""
    seed: int = 0
    """Same seed, same result, bit for bit."""
    features: FeatureName = "sift"
    """Kind of features that are matched between images."""
