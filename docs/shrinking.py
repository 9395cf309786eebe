"""Draws shrinking.svg, the moving drawing of the README: `python docs/shrinking.py` calibrates image by image.

Left the image that has just been taken; right the accuracy that the calibration states after it, of a point that the
camera sees: 95 % of errors are smaller. The last state is the final calibration of all images, and is shown without
animation.
"""

import base64
import io
import json
import math
import tempfile
from pathlib import Path

import numpy as np
from markupsafe import escape
from PIL import Image

import jcr

HERE = Path(__file__).parent
CAPTURE = HERE.parent / "examples" / "tabletop"
WIDTH, HEIGHT = 900, 300
PHOTO = (320, 240)
"""Size of a drawn image, pixels."""
LEFT, RIGHT, TOP, BOTTOM = 430, 870, 40, 240
"""Borders of the chart, pixels."""
STEP_S, STAY_S = 0.9, 3.0
"""An image is shown for a step, the last one for longer."""
STYLE = """
text{font:15px system-ui,sans-serif;fill:#444}.big{font-size:22px;font-weight:600;fill:#111}
.axis{stroke:#8886}.line{stroke:#c2570c;stroke-width:2.5;fill:none}.dot{fill:#c2570c}
@media(prefers-color-scheme:dark){text{fill:#bbb}.big{fill:#eee}}
"""


def states() -> list[tuple[str, float, float]]:
    """Return for each image with a calibration: its file, the error in mm and in degrees."""
    content = json.loads((CAPTURE / "capture.json").read_text())
    intrinsics, found = jcr.read_capture(CAPTURE).intrinsics, []
    with tempfile.TemporaryDirectory() as folder:
        live = jcr.LiveCalibration(Path(folder) / "live", intrinsics=intrinsics)
        for frame in content["frames"]:
            image = np.asarray(Image.open(CAPTURE / frame["image"]).convert("RGB"))
            reached = live.add(image, np.array(frame["base_from_gripper"])).reached
            found.append((frame["image"], *(reached or (math.nan, math.nan))))
        final = live.finish()
        assert final is not None and (seen := final.found.uncertainty.seen) is not None
        found[-1] = (found[-1][0], seen.within_95_mm, seen.rotation_95_deg)
    return found


def shown_during(first: int, last: int, count: int) -> str:
    """The animation by which an element is visible from a step to the one before `last`, of `count` steps."""
    whole = (count - 1) * STEP_S + STAY_S
    times = [0.0, first * STEP_S / whole, 1.0 if last >= count else last * STEP_S / whole]
    values = ["0", "1", "1" if last >= count else "0"]
    if first == 0:
        times, values = times[1:], values[1:]
    stops = ";".join(f"{time:.4f}" for time in times)
    return (
        # It begins with the last state, so that a reader first sees the result.
        f'<animate attributeName="opacity" calcMode="discrete" dur="{whole:.1f}s" begin="{STAY_S - whole:.1f}s" '
        f'repeatCount="indefinite" '
        f'values="{";".join(values)}" keyTimes="{stops}"/>'
    )


def photo(name: str) -> str:
    """An image as a data URL, small."""
    data = io.BytesIO()
    Image.open(CAPTURE / name).convert("RGB").resize(PHOTO, Image.Resampling.LANCZOS).save(
        data, "JPEG", quality=70
    )
    return "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode()


def drawing(found: list[tuple[str, float, float]]) -> str:
    """The file."""
    count, known = len(found), [mm for _, mm, _ in found if math.isfinite(mm)]
    low, high = math.floor(math.log10(min(known))), math.ceil(math.log10(max(known)))

    def at(k: int, mm: float) -> tuple[float, float]:
        height = (math.log10(mm) - low) / (high - low)
        return LEFT + (RIGHT - LEFT) * (k + 1) / count, BOTTOM - (BOTTOM - TOP) * height

    parts = [f'<text x="{LEFT}" y="20">a point that the camera sees: 95 % of errors are below</text>']
    for power in range(low, high + 1):
        y = at(0, 10.0**power)[1]
        parts += [
            f'<line class="axis" x1="{LEFT}" y1="{y:.0f}" x2="{RIGHT}" y2="{y:.0f}"/>',
            f'<text x="{LEFT - 8}" y="{y + 5:.0f}" text-anchor="end">{10.0**power:g} mm</text>',
        ]
    before = None
    for k, (name, mm, deg) in enumerate(found):
        last = 1 if k == count - 1 else 0
        now = shown_during(k, k + 1, count)
        parts.append(
            f'<image x="20" y="30" width="{PHOTO[0]}" height="{PHOTO[1]}" opacity="{last}" '
            f'href="{photo(name)}">{now}</image>'
        )
        words = f"{mm:.2g} mm, {deg:.2g}°" if math.isfinite(mm) else "too few images"
        words = f"final calibration: {words}" if last else words
        parts.append(
            f'<g opacity="{last}"><text x="20" y="20">image {k + 1} of {count}: {escape(Path(name).name)}</text>'
            f'<text class="big" x="{RIGHT}" y="{BOTTOM + 42}" text-anchor="end">{words}</text>{now}</g>'
        )
        if math.isfinite(mm):
            x, y = at(k, mm)
            line = (
                ""
                if before is None
                else f'<path class="line" d="M{before[0]:.1f} {before[1]:.1f}L{x:.1f} {y:.1f}"/>'
            )
            parts.append(
                f'<g>{line}<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="5"/>{shown_during(k, count, count)}</g>'
            )
            before = x, y
    label = "After each image the stated error of the calibration shrinks"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">'
        f"<style>{STYLE}</style>{''.join(parts)}</svg>\n"
    )


if __name__ == "__main__":
    (HERE / "shrinking.svg").write_text(drawing(states()), encoding="utf-8")
