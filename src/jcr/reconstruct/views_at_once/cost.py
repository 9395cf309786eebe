"""What a pass of an any-view model takes, estimated before it is begun."""

from dataclasses import dataclass

from jcr.memory import GB


@dataclass(frozen=True)
class Cost:
    """Linear in the number of views for memory, quadratic for time: attention over all views at once."""

    base_gb: float
    """Weights, in main memory, and what their library takes."""
    view_gb: float
    """Of each view."""
    view_s: float
    """Of each view on one core of a desktop's processor."""
    pair_s: float
    """Of each pair of views, likewise."""

    def bytes(self, views: int) -> float:
        """Peak of main memory on a CPU, over what the program takes without it."""
        return GB * (self.base_gb + self.view_gb * views)

    def seconds(self, views: int) -> float:
        """On one core of a CPU."""
        return self.view_s * views + self.pair_s * views * (views - 1) / 2

    def told(self, views: int, device: str) -> str:
        """For the line that announces the work."""
        if device != "cpu":
            return f", and {self.bytes(views) / GB:.1f} GB of the GPU's"
        return f", and about {self.seconds(views):.0f} s on one core"
