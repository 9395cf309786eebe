"""Provenance that every exported file states: frame, units, and the reason of a rejection."""

from dataclasses import dataclass

from jcr import __version__


@dataclass(frozen=True)
class Provenance:
    """Frame of a file's numbers, and the reason of a rejection."""

    frame: str
    doubt: str | None = None
    """The reason the calibration gives; None when it converged."""

    @property
    def notes(self) -> dict[str, str]:
        """Frame, unit, version, and a warning where there is a doubt: each one line."""
        about = {"frame": self.frame, "unit": "m", "made_by": f"jcr {__version__}"}
        if self.doubt is None:
            return about
        return about | {"warning": f"REJECTED: {' '.join(self.doubt.split())}"}
