"""What every exported file states: its frame, its units, and why a calibration is rejected."""

from dataclasses import dataclass

from jcr import __version__


@dataclass(frozen=True)
class Provenance:
    """Whose frame a file's numbers are in, and why they are rejected, where they are not."""

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
