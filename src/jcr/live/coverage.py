"""What the pictures taken so far will tell, and the pose that adds most; as text, answer and page."""

from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.handeye.next_poses import next_poses
from jcr.handeye.observability import observability
from jcr.live.asks import Answer
from jcr.live.folder import LiveFolder
from jcr.records import NextPose

ENOUGH_STD = np.array([1e-3] * 3 + [np.radians(0.2)] * 3 + [5e-3])
"""Expected one sigma at which the page calls a direction covered: 1 mm, 0.2°, 0.5 % of scale."""


@dataclass(frozen=True)
class Coverage:
    """How far a capture is."""

    pictures: int
    unseen: tuple[str, ...]
    """What the motions do not show yet, in words."""
    expected_std: Float[ndarray, "7"] | None
    """records.COVARIANCE_ORDER; None below three pictures."""
    next_pose: NextPose | None
    like: str | None
    """The picture nearest to the next pose."""


def coverage(live: LiveFolder, reach: Float[ndarray, "2 3"] | None = None) -> Coverage:
    """What the gripper poses in the folder will show, whatever is in the pictures."""
    if len(live.poses) < 2:
        return Coverage(len(live.poses), (), None, None, None)
    poses = np.stack(live.poses)
    now, (proposed,) = next_poses(poses, 1, reach=reach)
    return Coverage(
        len(poses),
        observability(poses).unobservable,
        now if len(poses) >= 3 else None,
        proposed,
        live.names[proposed.like],
    )


def in_words(found: Coverage) -> list[str]:
    """A line on what is covered, and lines with the next pose."""
    if found.next_pose is None:
        first = "one picture; " if found.pictures else "no picture yet; "
        return [first + "turn the wrist by 20° or more, and move, between pictures"]
    pose = found.next_pose
    lines = [f"{found.pictures} pictures" + "".join(f"; not shown yet: {name}" for name in found.unseen)]
    if found.expected_std is not None and not found.unseen:
        offset = ", ".join(f"{1e3 * value:.2g}" for value in found.expected_std[:3])
        lines[0] += f"; expected ± {offset} mm, scale {100 * found.expected_std[6]:.2g} %"
    moved, turned = 1e3 * pose.moved_m, np.degrees(pose.turned_rad)
    lines.append(f"best next: {moved:.0f} mm and {turned:.0f}° from {found.like}; base_from_gripper")
    lines += [" ".join(f"{value:8.4f}" for value in row) for row in pose.base_from_gripper]
    return lines


def as_answer(found: Coverage) -> Answer:
    """The same for a program."""
    pose = found.next_pose
    return {
        "pictures": found.pictures,
        "unobservable": list(found.unseen),
        "expected_std": None if found.expected_std is None else found.expected_std.tolist(),
        "next_base_from_gripper": None if pose is None else pose.base_from_gripper.tolist(),
    }


_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="2">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>jcr capture</title>
<style>:root{{color-scheme:light dark}}body{{font:15px system-ui,sans-serif;margin:1.5em;max-width:70em}}
figure{{display:inline-block;margin:0 .6em .6em 0}}figcaption{{font-size:.8em;opacity:.7}}img{{width:180px}}
pre{{white-space:pre-wrap}}svg{{width:20em;max-width:100%;border:1px solid #8888;float:right;margin:0 0 1em 1em}}
.bar{{display:inline-block;width:12em;height:.7em;background:#8884;margin:0 .6em}}
.bar i{{display:block;height:100%;background:#2a7}}p{{margin:.3em 0}}</style>
<h1>{verdict}</h1>{plan}<pre>{text}</pre>{bars}<h2>Pictures</h2>{pictures}</html>
"""


def page(live: LiveFolder, found: Coverage, message: str) -> str:
    """A page that shows the capture as it grows and loads itself anew; for the folder's live.html."""
    pictures = "".join(
        f'<figure><img src="{escape(live.thumbnail(name))}" alt=""><figcaption>{escape(name)}</figcaption>'
        "</figure>"
        for name in reversed(live.names)
    )
    text = "\n".join(escape(line) for line in in_words(found))
    return _PAGE.format(
        verdict=escape(message), plan=_plan(live, found), text=text, bars=_bars(found), pictures=pictures
    )


def _bars(found: Coverage) -> str:
    if found.expected_std is None:
        return ""
    names = ("x", "y", "z", "turn x", "turn y", "turn z", "scale")
    share = np.clip(ENOUGH_STD / found.expected_std, 0, 1)
    return "".join(
        f'<p><span class="bar"><i style="width:{100 * part:.0f}%"></i></span>{name}</p>'
        for name, part in zip(names, share, strict=True)
    )


def _plan(live: LiveFolder, found: Coverage) -> str:
    """Seen from above in the base frame: gripper positions and where their z axes point; the next one dashed."""
    if found.next_pose is None:
        return ""
    poses = np.stack([*live.poses, found.next_pose.base_from_gripper])
    start, end = poses[:, :2, 3], poses[:, :2, 3] + 0.08 * poses[:, :2, 2]
    low, high = np.minimum(start, end).min(0) - 0.05, np.maximum(start, end).max(0) + 0.05
    width, height = high - low
    marks = []
    for k, ((x, y), (to_x, to_y)) in enumerate(zip(start, end, strict=True)):
        color, dash = ("#d60", ' stroke-dasharray=".01"') if k == len(live.poses) else ("#27c", "")
        line = f'x1="{x:.3f}" y1="{-y:.3f}" x2="{to_x:.3f}" y2="{-to_y:.3f}"'
        marks.append(
            f'<line {line} stroke="{color}" stroke-width=".006"{dash}/>'
            f'<circle cx="{x:.3f}" cy="{-y:.3f}" r=".012" fill="{color}"/>'
        )
    box = f"{low[0]:.3f} {-high[1]:.3f} {width:.3f} {height:.3f}"
    title = "<title>gripper positions seen from above; orange: the next</title>"
    return f'<svg viewBox="{box}" role="img">{title}{"".join(marks)}</svg>'
