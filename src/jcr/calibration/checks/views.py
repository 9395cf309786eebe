"""What do the images show by themselves, whatever their poses are? A camera at rest, and images that are blurred.

Of either, features are too few or do not move, and what is then found of motion or texture is a consequence.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from jcr.capture.images import BLURRED_EDGE, EDGES_AT, edge_width, read_image, show_one_view
from jcr.findings import Finding, FindingKind
from jcr.geometry import largest_motion
from jcr.records import Capture

STILL = (20e-3, np.radians(5.0))
"""m, rad: a gripper that moves farther is seen to, in images of a camera that it carries."""
MANY = 1 / 4
"""Share of blurred images that explains a rejection; of fewer the others are enough."""


def view_findings(capture: Capture) -> tuple[Finding, ...]:
    """What its images alone show against a capture, causes of a rejection where it is rejected; empty of sharp images of
    several views."""
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
    """The findings of the images alone on a capture that is rejected; those that concern many images reject it."""
    return tuple(
        replace(one, severity="rejects")
        if one.kind is FindingKind.BLURRED and len(one.images) > MANY * float(one.details["of"])
        else one
        for one in findings
    )
