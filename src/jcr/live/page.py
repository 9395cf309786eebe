"""live.html: the camera's image now, what the images show so far, and the next pose; it renews itself."""

import json
import threading
import time
from collections.abc import Callable
from html import escape
from importlib import resources
from string import Template

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.calibration.requirement import GRASPING
from jcr.files import write_bytes, write_text
from jcr.geometry import apply
from jcr.live.camera import Frame
from jcr.live.coverage import Coverage, in_words, next_lines
from jcr.live.folder import LiveFolder
from jcr.rounding import significant

TEMPLATE = resources.files("jcr.live") / "live.html"
STYLE = resources.files("jcr.report") / "page" / "page.css"
"""That of the report, so that both look alike."""
NOW_PX = 640
FEW_FEATURES = 150
"""SIFT features in an image of NOW_PX below which registration is at risk."""
LOOK_S = 1.0
WIDTH, HEIGHT = 460.0, 340.0
SIGHT_M = 0.12
"""Depth of a drawn camera; half of that for its half width."""
AZIMUTH_DEG, ELEVATION_DEG = -50.0, 30.0
ENOUGH = GRASPING
"""mm, degrees: what the chart marks where nothing was required."""


def write_page(
    live: LiveFolder, found: Coverage, headline: str, wanted: tuple[float, float] = ENOUGH
) -> None:
    """Write live.html, and live/state.js by which an open page learns of it."""
    body = _body(live, found, headline, wanted)
    text = Template(TEMPLATE.read_text("utf-8")).substitute(
        style=STYLE.read_text("utf-8"), title=escape(str(live.folder)), body=body
    )
    write_text(live.folder / "live.html", text)
    write_text(live.folder / "live" / "state.js", f"show({json.dumps(body)});\n")


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
        picture, count = with_features(frame.image)
        write_bytes(
            self._live.folder / "live" / "now.jpg", cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()
        )
        words = f"{count} features" + (
            f": few; put textured things into view (fewer than {FEW_FEATURES} may not register)"
            if count < FEW_FEATURES
            else ""
        )
        told = {"words": words, "few": count < FEW_FEATURES, "time": time.strftime("%H:%M:%S")}
        write_text(self._live.folder / "live" / "now.js", f"now({json.dumps(told)});\n")

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


def _body(live: LiveFolder, found: Coverage, headline: str, wanted: tuple[float, float]) -> str:
    first = in_words(found)[0]
    thumbnails = "".join(
        f'<figure><img src="{escape(live.thumbnail(name))}" alt=""><figcaption>{number}: {escape(name)}</figcaption>'
        "</figure>"
        for number, name in reversed(list(enumerate(live.names, 1)))
    )
    lines = "\n".join(escape(line) for line in next_lines(found))
    next_pose = "<p>Two images from different places are needed before a pose is proposed.</p>"
    if found.next_pose is not None:
        pose = found.next_pose
        next_pose = (
            f"<p>{1e3 * pose.moved_m:.0f} mm and {np.degrees(pose.turned_rad):.0f}° from "
            f"{escape(str(found.like))}. Check that the arm can move there without collision.</p><pre>{lines}</pre>"
        )
    return (
        f'<section class="verdict {_kind(headline, found, wanted)}"><h2>{escape(headline)}</h2>'
        f"<p>{escape(first)}</p></section>{_tiles(found, wanted)}"
        f'<div class="pair"><section><h2>Next pose</h2>{next_pose}{_scene(live, found)}</section>'
        f"<section><h2>Expected uncertainty</h2>{_chart(found, wanted)}</section></div>"
        f'<section><h2>Images</h2><div class="thumbnails">{thumbnails or "None yet."}</div></section>'
    )


def _kind(headline: str, found: Coverage, wanted: tuple[float, float]) -> str:
    if headline.startswith("Refused"):
        return "bad"
    if (now := found.now) is None or found.unseen:
        return ""
    mm, deg = now.reached("seen")
    return "good" if mm <= wanted[0] and deg <= wanted[1] else ""


def _tiles(found: Coverage, wanted: tuple[float, float]) -> str:
    cells = [("images", str(found.images), "")]
    if (now := found.now) is not None:
        mm, deg = now.reached("seen")
        far, std = significant(1e-3 * now.seen.distance_mm), now.std
        offset = " ".join(significant(1e3 * value) for value in std[:3])
        cells += [
            (f"a point seen at {far} m, 95 %", f"{significant(mm)} mm", f"wanted {wanted[0]:g} mm"),
            ("directions there, 95 %", f"{significant(deg)}°", f"wanted {wanted[1]:g}°"),
            ("the camera itself, 1 σ", f"{offset} mm", f"scale {significant(100 * std[6])} %"),
        ]
    tiles = "".join(
        f'<div class="tile"><div class="name">{name}</div><div class="number">{value}</div>'
        f'<div class="more">{more}</div></div>'
        for name, value, more in cells
    )
    return f'<div class="tiles">{tiles}</div>'


def _chart(found: Coverage, wanted: tuple[float, float]) -> str:
    """Expected errors of a seen point against the number of images, logarithmic in the errors."""
    if not found.expected:
        return "<p>Known from the third image on.</p>"
    left, right, top, bottom = 52.0, 14.0, 16.0, 42.0
    reached = np.array([one.reached("seen") for one in found.expected]).T
    series = dict(zip(("translation", "rotation"), reached, strict=True))
    shares = {name: values / want for (name, values), want in zip(series.items(), wanted, strict=True)}
    low = min(0.5, *(float(values.min()) for values in shares.values()))
    high = max(2.0, *(float(values.max()) for values in shares.values()))
    span = np.log(high / low)
    count = len(found.expected)

    def at(k: int, share: float) -> tuple[float, float]:
        x = left + (WIDTH - left - right) * (k / max(count - 1, 1))
        return x, top + (HEIGHT - top - bottom) * float(np.log(high / np.clip(share, low, high)) / span)

    goal = at(0, 1.0)[1]
    parts = [
        f'<rect x="{left}" y="{goal:.1f}" width="{WIDTH - left - right}" height="{HEIGHT - bottom - goal:.1f}" '
        'class="reached"/>',
        f'<line x1="{left}" x2="{WIDTH - right}" y1="{goal:.1f}" y2="{goal:.1f}" class="goal"/>',
        f'<text x="{WIDTH - right - 4}" y="{goal - 6:.1f}" class="end">wanted</text>',
    ]
    powers = range(int(np.ceil(np.log2(low))), int(np.floor(np.log2(high))) + 1)
    for power in powers[:: max(1, len(powers) // 6)]:
        y = at(0, 2.0**power)[1]
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" class="end">{2.0**power:g}×</text>')
    for name, values in shares.items():
        points = " ".join("{:.1f},{:.1f}".format(*at(k, share)) for k, share in enumerate(values))
        parts.append(f'<polyline points="{points}" class="line {name}"/>')
        parts += [
            '<circle cx="{:.1f}" cy="{:.1f}" r="3.5" class="{}"/>'.format(*at(k, share), name)
            for k, share in enumerate(values)
        ]
    for k in range(0, count, max(1, count // 8)):
        parts.append(
            f'<text x="{at(k, 1.0)[0]:.1f}" y="{HEIGHT - bottom + 18:.0f}" class="middle">{k + 3}</text>'
        )
    parts.append(f'<text x="{WIDTH / 2}" y="{HEIGHT - 6}" class="middle">images</text>')
    legend = "".join(
        f'<span><span class="key {name}"></span>{name}: {significant(float(values[-1]))} {unit}</span>'
        for (name, values), unit in zip(series.items(), ("mm", "°"), strict=True)
    )
    label = (
        "95 % of the errors expected of a seen point, as a multiple of what is wanted, by number of images"
    )
    usual = "for a usual robot and usual images, if all register: jcr check measures both"
    return f'{_svg(parts, label)}<div class="legend">{legend}</div><p class="soft">{label}; logarithmic; {usual}.</p>'


def _scene(live: LiveFolder, found: Coverage) -> str:
    """Gripper poses as pyramids along z, the newest filled, the next one dashed; base axes and a floor grid."""
    if not live.poses:
        return ""
    a, e = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    to_view = np.array(
        [
            [-np.sin(a), np.cos(a), 0.0],
            [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)],
        ]
    )
    poses = list(live.poses) + ([found.next_pose.base_from_gripper] if found.next_pose else [])
    shape = SIGHT_M * np.array([[0, 0, 0], [0.5, 0.4, 1], [-0.5, 0.4, 1], [-0.5, -0.4, 1], [0.5, -0.4, 1]])
    pyramids = np.stack([apply(pose, shape) for pose in poses])
    step = 0.1
    corners = np.vstack([pyramids.reshape(-1, 3), np.zeros((1, 3))])
    low = np.floor(corners.min(0)[:2] / step) * step
    high = np.ceil(corners.max(0)[:2] / step) * step
    floor = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    flat = np.vstack([corners, floor]) @ to_view.T
    least, most = flat.min(0), flat.max(0)
    zoom = min((WIDTH - 60) / (most[0] - least[0]), (HEIGHT - 50) / (most[1] - least[1]))

    def place(x_in_base: Float[ndarray, "k 3"]) -> Float[ndarray, "k 2"]:
        return (x_in_base @ to_view.T - (least + most) / 2) * [zoom, -zoom] + [WIDTH / 2, HEIGHT / 2]

    def line(ends: Float[ndarray, "k 3"], kind: str) -> str:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in place(ends))
        return f'<polyline points="{points}" class="{kind}"/>'

    parts = []
    for x in np.arange(low[0], high[0] + 1e-9, step):
        parts.append(line(np.array([[x, low[1], 0], [x, high[1], 0]]), "grid"))
    for y in np.arange(low[1], high[1] + 1e-9, step):
        parts.append(line(np.array([[low[0], y, 0], [high[0], y, 0]]), "grid"))
    for k, name in enumerate("xyz"):
        tip = 0.15 * np.eye(3)[k]
        parts.append(line(np.array([np.zeros(3), tip]), f"axis-{name}"))
        ((tip_x, tip_y),) = place(1.2 * tip[None])
        parts.append(f'<text x="{tip_x:.1f}" y="{tip_y + 4:.1f}" class="middle">{name}</text>')
    for k, body in enumerate(pyramids):
        kind = "ghost" if k == len(live.poses) else "newest" if k == len(live.poses) - 1 else "taken"
        parts += [line(body[[0, i, i % 4 + 1, 0]], f"cone {kind}") for i in range(1, 5)]
        parts.append(line(body[[1, 2, 3, 4, 1]], f"cone {kind}"))
        ((x, y),) = place(body[:1])
        if kind != "ghost":
            parts.append(f'<text x="{x + 5:.1f}" y="{y - 5:.1f}" class="small">{k + 1}</text>')
    if found.next_pose is not None:
        from_to = np.stack([poses[found.next_pose.like][:3, 3], poses[-1][:3, 3]])
        parts.append(line(from_to, "way"))
    legend = (
        '<span><span class="key taken"></span>images, by number</span>'
        '<span><span class="key newest"></span>newest</span>'
        '<span><span class="key ghost"></span>next pose</span><span>axes of the base, grid 0.1 m</span>'
        "<span>a pyramid opens along the gripper's z axis</span>"
    )
    return f'{_svg(parts, "Gripper poses of the images, and the next one")}<div class="legend">{legend}</div>'


def _svg(parts: list[str], label: str) -> str:
    return (
        f'<svg class="live" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )
