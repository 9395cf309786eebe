"""Draws packages.svg, the drawing of architecture.md: `python docs/explanation/packages.py` writes it beside this file.

The colours follow the reader's light or dark mode; the ground is opaque, so that the drawing can be read on any page.
"""

from html import escape
from pathlib import Path

ROWS: tuple[tuple[tuple[str, str, float], ...], ...] = (
    (("cli/", "one module a command, imported when it is asked for", 1),),
    (("view/", "a run in the browser", 1),),
    (
        ("batch.py", "many captures", 1),
        ("verify.py", "has the camera moved?", 1),
        ("touch_test.py", "does the tip agree?", 1),
    ),
    (("live/", "take a capture", 1), ("pipeline.py", "the stages in order", 2)),
    (("stages.py", "each stage on a run folder, from the files of those before it, timed", 1),),
    (("mapping.py", "the map stage", 1), ("report/", "the page a person reads", 1)),
    (("export/", "a run in the formats of other tools", 1),),
    (
        ("check.py", "judge a capture", 1),
        ("attempts.py", "choose a back end", 1),
        ("run_folder.py", "files and state", 1),
        ("results.py", "options, result", 1),
    ),
    (("segment/", "labels and sizes of objects", 1), ("represent/", "cloud, trained map, queries", 1)),
    (("cell/", "every camera of the cell: fixed, several on a wrist, two arms, eye-to-hand", 1),),
    (("calibration/", "the stage: fit, adjust, checks, verdict, requirement; calibration.json", 1),),
    (("depth/", "the stage densify: PatchMatch and planes on known cameras", 1),),
    (("reconstruct/", "the table of back ends: COLMAP, boards, networks, given cameras", 1),),
    (("match/", "features and matches that the robot checks", 1),),
    (("capture/", "readers of every format, and their checks", 1),),
    (("estimation/", "the one bundle adjustment: what images show, tied to the robots", 1),),
    (("estimation/", "AX = XB with scale: arrays in, arrays out; no image, no file", 1),),
    (
        ("camera.py", "projection, distortion, derivatives", 1),
        ("arrays_json, intrinsics_json", "parts of our files", 1),
        ("least_squares.py", "damped Gauss-Newton", 1),
    ),
    (
        ("records/", "what flows", 1),
        ("files, memory, progress", "what every stage needs", 2),
    ),
    (
        ("geometry.py", "SE(3), one retraction", 1),
        ("distributions.py", "tails, quantiles", 1),
        ("rounding.py", "digits that mean something", 1),
        ("pages.py", "the manual", 1),
    ),
    (
        ("errors.py", "bad input, a rejected answer", 1),
        ("extras.py", "optional packages", 1),
        ("compiled.py", "loops over pixels", 1),
        ("options.py", "checked options", 1),
        ("deflate.py", "zlib before pycolmap", 1),
    ),
)
"""From the top down: name, what it is for, share of the row's width."""
INSIDE = {
    "reconstruct/": (
        ("direct/", "by colour"),
        ("global_alignment/", "pairs to cameras"),
        ("dust3r/", "predicts pairs"),
        ("views_at_once/", "predicts all"),
    )
}
FLOW = {
    "capture/": ("Capture", "images, gripper poses, intrinsics"),
    "reconstruct/": ("Reconstruction", "cameras, tracks; up to scale"),
    "calibration/": ("HandEye", "camera on the gripper, scale, covariance"),
    "represent/": ("PointCloud, SceneMap", "metres, in the robot's base frame"),
    "report/": ("report.html", "from the RunResult of all stages"),
}
"""What flows, beside the package that makes it."""
SOURCE = ("images and gripper poses", "on disk, or from a live camera")

WIDTH, MARGIN = 1120, 20
LEFT, RIGHT = 118, 800
"""Of the rows; the benchmarks stand left of them, what flows right of them."""
FLOW_LEFT, FLOW_RIGHT = 846, WIDTH - MARGIN
HEIGHT, INNER, GAP, DOWN, TOP = 43, 46, 9, 15, 50
"""GAP between rooms of a row, DOWN between rows."""
STYLE = """
text { font-family: system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; fill: #1f2328; }
.name { font-family: ui-monospace, SFMono-Regular, Menlo, "DejaVu Sans Mono", monospace; font-size: 14px;
  font-weight: 600; }
.what, .head { font-size: 11.5px; fill: #59636e; }
.head { font-size: 13px; }
.ground { fill: #ffffff; stroke: #d1d9e0; }
.room { fill: #eef2f6; stroke: #b8c2cc; }
.inside { fill: #ffffff; stroke: #b8c2cc; }
.maker { fill: #ddeafa; stroke: #4b83c4; }
.record { fill: #fbeed5; stroke: #b9801f; }
.beside { fill: none; stroke: #818b98; stroke-dasharray: 5 4; }
.flow { fill: none; stroke: #b9801f; stroke-width: 2; }
.makes { fill: none; stroke: #4b83c4; stroke-width: 1.5; }
.head-of-flow { fill: #b9801f; }
@media (prefers-color-scheme: dark) {
text { fill: #e6edf3; }
.what, .head { fill: #a9b4c0; }
.ground { fill: #0d1117; stroke: #3d444d; }
.room { fill: #1b222b; stroke: #4a5461; }
.inside { fill: #0d1117; stroke: #4a5461; }
.maker { fill: #142c47; stroke: #5a9be6; }
.record { fill: #3a2a0c; stroke: #d9a23f; }
.beside { stroke: #7d8792; }
.flow { stroke: #d9a23f; }
.makes { stroke: #5a9be6; }
.head-of-flow { fill: #d9a23f; }
}
"""


def box(kind: str, x: float, y: float, width: float, height: float) -> str:
    """A rectangle of a class of STYLE."""
    return f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6"/>'


def words(kind: str, x: float, y: float, text: str, anchor: str = "middle") -> str:
    """One line of text at its baseline."""
    return f'<text class="{kind}" x="{x:g}" y="{y:g}" text-anchor="{anchor}">{escape(text)}</text>'


def labelled(kind: str, left: float, top: float, width: float, name: str, what: str) -> list[str]:
    """A box with a name, and below it what that is for."""
    middle = left + width / 2
    return [
        box(kind, left, top, width, HEIGHT),
        words("name", middle, top + 19, name),
        words("what", middle, top + 35, what),
    ]


def row(rooms: tuple[tuple[str, str, float], ...], top: float) -> list[str]:
    """The rooms of one row, with those inside them."""
    drawn, left = [], float(LEFT)
    share = (RIGHT - LEFT - GAP * (len(rooms) - 1)) / sum(weight for _, _, weight in rooms)
    for name, what, weight in rooms:
        width, kind = share * weight, "maker" if name in FLOW else "room"
        if name in INSIDE:
            drawn.append(box(kind, left, top, width, HEIGHT + INNER + GAP))
            drawn += labelled(kind, left, top, width, name, what)[1:]
            inner = (width - GAP * (len(INSIDE[name]) + 1)) / len(INSIDE[name])
            for k, (part, use) in enumerate(INSIDE[name]):
                drawn += labelled("inside", left + GAP + k * (inner + GAP), top + HEIGHT, inner, part, use)
        else:
            drawn += labelled(kind, left, top, width, name, what)
        left += width + GAP
    return drawn


def flow(tops: dict[str, float]) -> list[str]:
    """The records from the bottom up, each beside its maker, with the way from one to the next."""
    middle, width = (FLOW_LEFT + FLOW_RIGHT) / 2, FLOW_RIGHT - FLOW_LEFT
    source = tops["camera.py"]
    drawn = labelled("beside", FLOW_LEFT, source, width, *SOURCE)
    below = source
    for maker, (name, what) in FLOW.items():
        top = tops[maker]
        drawn += labelled("record", FLOW_LEFT, top, width, name, what)
        drawn.append(f'<path class="makes" d="M{RIGHT} {top + HEIGHT / 2:g}H{FLOW_LEFT}"/>')
        drawn.append(f'<path class="flow" d="M{middle:g} {below:g}V{top + HEIGHT + 8:g}"/>')
        tip = top + HEIGHT + 1
        drawn.append(f'<path class="head-of-flow" d="M{middle:g} {tip:g}l-6 9h12z"/>')
        below = top
    return drawn


def drawing() -> str:
    """The whole SVG."""
    drawn, tops, top = [], {}, float(TOP)
    for rooms in ROWS:
        drawn += row(rooms, top)
        tops |= dict.fromkeys((name for name, _, _ in rooms), top)
        top += HEIGHT + DOWN + (INNER + GAP if rooms[0][0] in INSIDE else 0)
    bottom = top - DOWN
    beside, x, y = LEFT - 2 * GAP - MARGIN, MARGIN + 33, (TOP + bottom) / 2
    drawn += [
        box("beside", MARGIN, TOP, beside, bottom - TOP),
        f'<g transform="rotate(-90 {x} {y:g})">',
        words("name", x, y, "benchmarks/"),
        words("what", x, y + 19, "measures all of it; in the source, not installed"),
        "</g>",
        words("head", LEFT, TOP - 16, "src/jcr: imports run downwards", "start"),
        words("head", FLOW_LEFT, TOP - 16, "what flows, and who makes it", "start"),
    ]
    drawn += flow(tops)
    height = bottom + MARGIN
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:g}" role="img">'
    title = "<title>The packages of jcr from the bottom up, and the records that flow between them</title>"
    ground = f'<rect class="ground" x="0.5" y="0.5" width="{WIDTH - 1}" height="{height - 1:g}" rx="10"/>'
    return "\n".join([head, title, f"<style>{STYLE}</style>", ground, *drawn, "</svg>", ""])


if __name__ == "__main__":
    Path(__file__).with_name("packages.svg").write_text(drawing())
