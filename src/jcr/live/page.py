"""live.html: the camera's image now, what the images show so far, and the next pose; it renews itself."""

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.calibration.expected import FEWEST
from jcr.calibration.requirement import GRASPING
from jcr.files import write_bytes, write_text
from jcr.live.camera import Frame
from jcr.live.coverage import Coverage, in_words, next_lines
from jcr.live.figures import chart_figure, pose_figure
from jcr.live.folder import LiveFolder
from jcr.report.render import render
from jcr.report.svg import Figure
from jcr.report.verdict import Tile
from jcr.rounding import significant

PACKAGE = "jcr.live"
NOW_PX = 640
FEW_FEATURES = 150
"""SIFT features in an image of NOW_PX below which registration is at risk."""
LOOK_S = 1.0
ENOUGH = GRASPING
"""mm, degrees: what the chart marks where nothing was required."""
LABEL = "95 % of the errors expected of a seen point, as a multiple of what is wanted, by number of images"


@dataclass(frozen=True, kw_only=True)
class PageState:
    """All that the page shows of a capture; the templates draw nothing else."""

    folder: str
    kind: str
    """good, bad, or empty: the colour of the headline."""
    headline: str
    covered: str
    """A sentence on what the images cover."""
    tiles: Sequence[Tile]
    next_pose: str
    """Where it is, as a sentence; empty where none is proposed yet."""
    next_pose_lines: Sequence[str]
    """As the arm writes it."""
    scene: Figure | None
    chart: Figure | None
    legend: Sequence[tuple[str, str]]
    """The curves of the chart, and their last values."""
    images: Sequence[tuple[int, str, str]]
    """Number, name and thumbnail, the newest first."""


def write_page(
    live: LiveFolder, found: Coverage, headline: str, wanted: tuple[float, float] = ENOUGH
) -> None:
    """Write live.html, and live/state.js by which an open page learns of it."""
    content = {"state": page_state(live, found, headline, wanted)}
    write_text(live.folder / "live.html", render("live.html", content, PACKAGE))
    body = json.dumps(render("state.html", content, PACKAGE))
    write_text(live.folder / "live" / "state.js", f"show({body});\n")


def page_state(live: LiveFolder, found: Coverage, headline: str, wanted: tuple[float, float]) -> PageState:
    """What the page shows after an image: what is covered, and mm and degrees expected beside those wanted."""
    pose, like = found.next_pose, 0 if found.next_pose is None else found.next_pose.like
    reached = np.array([one.reached("seen") for one in found.expected]).reshape(-1, 2).T
    curves = dict(zip(("translation", "rotation"), reached, strict=True))
    shares = {name: values / want for (name, values), want in zip(curves.items(), wanted, strict=True)}
    next_gripper = None if pose is None else pose.base_from_gripper
    units = dict(zip(curves, ("mm", "°"), strict=True))
    return PageState(
        folder=str(live.folder),
        kind=_kind(headline, found, wanted),
        headline=headline,
        covered=in_words(found)[0],
        tiles=_tiles(found, wanted),
        next_pose=""
        if pose is None
        else f"{1e3 * pose.moved_m:.0f} mm and {np.degrees(pose.rotation_rad):.0f}° from {found.like}.",
        next_pose_lines=[] if pose is None else next_lines(found),
        scene=pose_figure(live.poses, next_gripper, like) if live.poses else None,
        chart=chart_figure(LABEL, shares, FEWEST) if found.expected else None,
        legend=[(name, f"{significant(float(v[-1]))} {units[name]}") for name, v in curves.items() if len(v)],
        images=[(k, name, live.thumbnail(name)) for k, name in reversed(list(enumerate(live.names, 1)))],
    )


def _kind(headline: str, found: Coverage, wanted: tuple[float, float]) -> str:
    if headline.startswith("Refused"):
        return "bad"
    if (now := found.now) is None or found.unseen:
        return ""
    mm, deg = now.reached("seen")
    return "good" if mm <= wanted[0] and deg <= wanted[1] else ""


def _tiles(found: Coverage, wanted: tuple[float, float]) -> list[Tile]:
    tiles: list[Tile] = [("images", str(found.images), "", False)]
    if (now := found.now) is None:
        return tiles
    mm, deg = now.reached("seen")
    far, std = significant(1e-3 * now.seen.distance_mm), now.std
    translation = " ".join(significant(1e3 * value) for value in std[:3])
    return [
        *tiles,
        (f"a point seen at {far} m, 95 %", f"{significant(mm)} mm", f"wanted {wanted[0]:g} mm", False),
        ("directions there, 95 %", f"{significant(deg)}°", f"wanted {wanted[1]:g}°", False),
        ("the camera itself, 1 σ", f"{translation} mm", f"scale {significant(100 * std[6])} %", False),
    ]


class Window:
    """Writes what the camera sees into the folder, once a second, with the features on it."""

    def __init__(self, live: LiveFolder, latest: Callable[[], Frame | None]) -> None:
        self._live, self._latest = live, latest
        self._stop = threading.Event()
        self._shown: float | None = None
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Window":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(10 * LOOK_S)
        self.look()

    def look(self) -> None:
        """Write the newest image, if it is new."""
        frame = self._latest()
        if frame is None or frame.time_s == self._shown:
            return
        self._shown = frame.time_s
        image, count = with_features(frame.image)
        write_bytes(
            self._live.folder / "live" / "now.jpg", cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
        )
        words = f"{count} features" + (
            f": few; put textured things into view (fewer than {FEW_FEATURES} may not register)"
            if count < FEW_FEATURES
            else ""
        )
        seen = {"words": words, "few": count < FEW_FEATURES, "time": time.strftime("%H:%M:%S")}
        write_text(self._live.folder / "live" / "now.js", f"now({json.dumps(seen)});\n")

    def _watch(self) -> None:
        while not self._stop.wait(LOOK_S):
            self.look()


def with_features(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "h2 w2 3"], int]:
    """The image NOW_PX wide with a ring at each SIFT feature, and how many there are."""
    height = max(1, round(NOW_PX * image.shape[0] / image.shape[1]))
    small = cv2.resize(np.ascontiguousarray(image), (NOW_PX, height), interpolation=cv2.INTER_AREA)
    found = cv2.SIFT.create(2000).detect(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None)
    for feature in found:
        center = round(feature.pt[0]), round(feature.pt[1])
        cv2.circle(small, center, 3, (60, 235, 120), 1, cv2.LINE_AA)
    return small, len(found)
