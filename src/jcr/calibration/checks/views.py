"""Checks of the images without their poses: a camera at rest, and blurred images.

Both leave too few features or features that do not move; findings of motion or texture are then consequences.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from jcr.capture.images import BLURRED_EDGE, EDGES_AT, edge_width, read_image, show_one_view
from jcr.findings import Finding, FindingKind
from jcr.geometry import largest_motion
from jcr.records import Capture

STILL = (20e-3, np.radians(5.0))
"""m, rad: larger motions of the gripper are visible in the images of a wrist camera."""
MANY = 1 / 4
"""Share of blurred images from which they explain a rejection."""


def view_findings(capture: Capture) -> tuple[Finding, ...]:
    """Return the findings of the images alone: none for sharp images of several views."""
    first = read_image(capture.folder / capture.images[0])
    metres, radians = largest_motion(capture.base_from_gripper)
    is_still = metres > STILL[0] or radians > STILL[1]
    width = {}
    for name in capture.images:
        image = read_image(capture.folder / name)
        width[name] = edge_width(image)
        is_still = is_still and show_one_view(first, image)
    findings = []
    if is_still:
        details = {"rotation": radians}
        findings.append(Finding.of(FindingKind.STATIC_IMAGES, "rejects", "images", value=metres, **details))
    blurred = tuple(name for name, share in width.items() if share > BLURRED_EDGE)
    if blurred:
        edge_px = max(*capture.image_size, EDGES_AT) * float(np.median([width[name] for name in blurred]))
        findings.append(
            Finding.of(
                FindingKind.BLURRED, "warns", "images", *blurred, value=edge_px, of=float(len(capture))
            )
        )
    return tuple(findings)


def as_causes(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings of the images alone for a rejected capture; those that concern many images reject."""
    return tuple(
        replace(one, severity="rejects")
        if one.kind is FindingKind.BLURRED and len(one.images) > MANY * float(one.details["of"])
        else one
        for one in findings
    )
