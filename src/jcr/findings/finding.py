"""Record of a finding; text and remedy of a finding; order and verdict of several findings."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from string import Formatter
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.findings.messages import MOTIONS, REACHED, FindingKind
from jcr.number_format import significant

Severity = Literal["rejects", "warns", "informs"]
Concerns = Literal["reconstruction", "motion", "images", "intrinsics", "poses", "mount", "robot", "none"]
"""Subject of a finding's remedy, in this order: another reconstruction of the same images, other motions, more or
other images, other intrinsics, corrected gripper poses, a firm mount, the arm's name or joint angles, nothing."""
Verdict = Literal["accepted", "accepted, but not as exact as needed", "not checked", "rejected"]
"""Verdicts from best to worst: nothing contradicts the calibration and the required accuracy is reached, or none is
required; nothing contradicts it and the accuracy is missed; no check was made; a check contradicts it."""
MORE_IMAGES = {FindingKind.UNCERTAIN, FindingKind.LEAVE_ONE_OUT}
"""Kinds with the remedy "more images", which does not help where a finding of another kind rejects the calibration."""
RANK: dict[Severity, int] = {"rejects": 0, "warns": 1, "informs": 2}


@dataclass(frozen=True, kw_only=True)
class Requirement:
    """Required and reached accuracy of a point that the camera sees, as bounds on 95 % of the errors."""

    translation_mm: float
    """Required bound on the translation error."""
    rotation_deg: float
    """Required bound on the rotation error."""
    distance_mm: float
    """Distance from the camera to the point at the image centre to which the bounds refer."""
    reached_mm: float
    """Bound on the translation error that the calibration reaches."""
    reached_deg: float
    """Bound on the rotation error that the calibration reaches."""
    more_images: int | None = None
    """Number of images to add until the required accuracy is reached, by an estimate; 0 if it is reached, None if no
    reasonable number suffices."""

    @property
    def met(self) -> bool:
        """Whether both reached bounds are at most the required ones."""
        return self.reached_mm <= self.translation_mm and self.reached_deg <= self.rotation_deg

    @property
    def details(self) -> dict[str, float | str]:
        """Required and reached accuracy as the `details` of a finding that the requirement is not met."""
        return {name: float(value) for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of a check: a fault of a calibration that rejects or warns, or a remark that informs."""

    # Files also hold text and remedy, which follow from the fields.
    __pydantic_config__ = {"extra": "ignore"}
    kind: FindingKind
    severity: Severity
    concerns: Concerns = "none"
    images: tuple[str, ...] = ()
    """Names of the images with the fault; empty if it concerns all images or none in particular."""
    joints: tuple[int, ...] = ()
    """Numbers of the joints with the fault; the first joint is 1."""
    value: float | None = None
    """Size of the fault, in the unit of its kind (docs: reference/findings); None if it has no size."""
    std: float | None = None
    """One standard deviation of `value`."""
    p: float | None = None
    """p-value: probability of a test result at least this extreme if there were no fault."""
    shift: tuple[float, ...] | None = None
    """Change s of transform and scale if the fault were modelled, in COVARIANCE_ORDER; s·sᵀ is part of the covariance.
    None: nothing is added to the covariance."""
    intrinsics_shift: tuple[float, ...] | None = None
    """Change of the intrinsics together with `shift`, in the order of camera.parameters; both partly compensate each
    other in a point's position. None: the intrinsics do not change."""
    details: Mapping[str, float | str] = field(default_factory=dict)
    """Other numbers (m, rad, px, fractions) and names that the templates of text and remedy use."""

    @classmethod
    def of(
        cls, kind: FindingKind, severity: Severity, concerns: Concerns = "none", *images: str, **known: Any
    ) -> "Finding":
        """Return a finding about `images`; `known` sets other fields by name and, under all other names, its details.

        Raises TypeError if a name that the message or the remedy of the kind always prints has no value.
        """
        sizes = {name: known.pop(name) for name in cls.__dataclass_fields__ if name in known}
        made = cls(kind=kind, severity=severity, concerns=concerns, images=images, details=known, **sizes)
        if missing := printed_names(kind) - quantities(made).keys():
            raise TypeError(f"finding {kind.value!r} without {', '.join(sorted(missing))}")
        return made

    def __repr__(self) -> str:
        return f"<Finding {self.kind.name}, {self.severity}: {self.text}>"

    @property
    def text(self) -> str:
        """Message of the finding: the fault in one sentence."""
        return self.kind.row.message.format_map(quantities(self))

    @property
    def remedy(self) -> str:
        """Remedy of the finding in one sentence; empty if there is none or none is needed."""
        return self.kind.row.remedy.format_map(quantities(self))

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Part s·sᵀ of the calibration's covariance due to the shift s, in COVARIANCE_ORDER; zero without a shift."""
        shift = np.zeros(7) if self.shift is None else np.array(self.shift)
        return np.outer(shift, shift)


LENGTHS = {
    "robot": "the robot's positions",
    "board": "the size of the board",
    "depth camera": "the depth camera",
    "network": "the network's metre",
}
"""Printed names of the sources of scale: the robot and the known lengths."""


class _Number(float):
    """Number in a template: {n:~} gives two significant digits, {n:!.1f} no sign, {n:a|b} "a" if positive, else "b"."""

    def __format__(self, spec: str) -> str:
        if "|" in spec:
            return spec.split("|")[self <= 0]
        if "$" in spec:
            return spec.replace("$", significant(self))
        number, spec = abs(self) if spec.startswith("!") else float(self), spec.removeprefix("!")
        return significant(number) if spec == "~" else format(number, spec)


class _Text(str):
    """Text in a template: {name:a=A|b=B} gives "A" for the text "a"; {name:words $} the text in words, if not empty."""

    def __format__(self, spec: str) -> str:
        if "=" in spec:
            return dict(part.split("=", 1) for part in spec.split("|") if part).get(self, "")
        if not self:
            return spec.split("|")[1] if "|" in spec else ""
        return spec.replace("$", self) or str(self)


class _Images(tuple[str, ...]):
    """Image names in a template: {images} lists at most three; {images:is|are} is singular or plural by their number."""

    def __format__(self, spec: str) -> str:
        if spec:
            return spec.split("|")[len(self) > 1]
        return joined([*self[:3], *[f"{len(self) - 3} more"] * (len(self) > 3)])


def quantities(finding: Finding) -> defaultdict[str, Any]:
    """Return the values for the templates of a finding's message and remedy, by name: its details and numbers.

    Each number is also given in mm (m times 1000), degrees and percent, under names such as `mm` or `std_percent`. A
    name without a value gives an empty text.
    """
    named: defaultdict[str, Any] = defaultdict(
        _Text, images=_Images(finding.images), concerns=_Text(finding.concerns)
    )
    for name, one in {"value": finding.value, "std": finding.std, **finding.details}.items():
        if isinstance(one, str):
            named[name] = _Text(LENGTHS.get(one, one))
        elif one is not None:
            of = "" if name == "value" else f"{name}_"
            units = {name: 1.0, f"{of}mm": 1e3, f"{of}deg": 180 / np.pi, f"{of}percent": 100.0}
            named |= {unit: _Number(per * one) for unit, per in units.items()}
            if name.endswith("_mm"):
                named[name.removesuffix("m")] = _Number(1e-3 * one)
    if "x" in named:
        at, frame = np.array([named[name] for name in "xyz"], float), finding.details["frame"]
        k = int(np.abs(at).argmax())
        along = abs(at[k]) > np.cos(np.radians(10))
        numbers = ", ".join(f"{x:.2f}" for x in at)
        named["axis"] = f"the {frame}'s {'xyz'[k]} axis" if along else f"the axis ({numbers}) of the {frame}"
        named["point"] = ", ".join(f"{1e3 * x:.0f}" for x in at)
    if "motion" in named:
        direction, move = MOTIONS[named["motion"]]
        named |= {"direction": direction.format_map(named), "move": move.format_map(named)}
    return named


@cache
def printed_names(kind: FindingKind) -> frozenset[str]:
    """Return the names that message and remedy of a kind always print; formats with |, = or $ allow a missing name."""
    parts = (part for template in (kind.row.message, kind.row.remedy) for part in Formatter().parse(template))
    names = {name for _, name, spec, _ in parts if name and not set("|=$") & set(spec or "")}
    return frozenset(name.partition("[")[0] for name in names)


def joined(words: Iterable[str]) -> str:
    """Return the words as an enumeration: "a, b and c"; at least one word is needed."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def unobservable(finding: Finding) -> str:
    """Return the direction of a finding of kind UNOBSERVABLE in words, with "nearly unobservable" before a weak one."""
    return "{nearly:nearly unobservable: |}{direction}".format_map(quantities(finding))


def reached_in_words(required: Requirement) -> str:
    """Return a sentence with the reached bound on 95 % of the errors and the required one."""
    short = Finding.of(FindingKind.NOT_EXACT_ENOUGH, "informs", "none", **required.details)
    return REACHED.format_map(quantities(short))


def sentence(finding: Finding) -> str:
    """Return message and remedy of a finding, separated by a semicolon."""
    return "; ".join(filter(None, (finding.text, finding.remedy)))


def doubt_of(findings: Iterable[Finding]) -> str | None:
    """Return message and remedy of the first finding that rejects; None if no finding rejects."""
    return next((sentence(finding) for finding in findings if finding.severity == "rejects"), None)


def warnings_of(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return one sentence, message and remedy together, for each finding that rejects or warns."""
    return tuple(sentence(finding) for finding in findings if finding.severity != "informs")


def no_reconstruction(error: RejectedError) -> tuple[Finding, ...]:
    """Return findings for a failed reconstruction: one that rejects with the error's reason, and warnings."""
    words = {"text": error.what, "remedy": "; ".join(error.remedies)}
    failed = Finding.of(FindingKind.NO_RECONSTRUCTION, "rejects", "reconstruction", **words)
    return (failed, *(Finding.of(FindingKind.RECONSTRUCTION, "warns", text=text) for text in error.also))


def is_cause(finding: Finding) -> bool:
    """Test whether a finding may explain findings of other kinds, which are then its consequences."""
    return bool(finding.kind.row.explains)


def is_lasting(finding: Finding) -> bool:
    """Test whether a finding explains others, and another reconstruction of the same images cannot remove it."""
    return is_cause(finding) and finding.kind.row.group != "reconstruction"


def strongest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings by severity; within a severity those on images, then those that explain others, then the rest.

    Findings on images are those of the group "images", such as blur. Of the rest, gripper poses that contradict the
    images come first: they leave nothing to conclude from the motions.
    """

    def place(finding: Finding) -> tuple[int, bool, bool, bool]:
        """Return the sort key of a finding: severity, not about images, explains no other, not about wrong poses."""
        of_images = finding.kind.row.group == "images"
        of_poses = finding.kind is FindingKind.POSES_CONTRADICT_IMAGES
        return RANK[finding.severity], not of_images, not is_cause(finding), not of_poses

    return tuple(sorted(findings, key=place))


def is_explained(findings: Sequence[Finding]) -> bool:
    """Test whether the first of the findings, sorted by `strongest_first`, rejects and explains others.

    More images do not remove such a rejection.
    """
    return bool(findings) and findings[0].severity == "rejects" and is_cause(findings[0])


def without_consequences(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return sorted findings; if the first one rejects, what follows from it is left out.

    Left out are the kinds that it explains and, unless it is of such a kind itself, the kinds MORE_IMAGES.
    """
    if not findings or findings[0].severity != "rejects":
        return tuple(findings)
    first, *others = findings
    if is_explained(findings):
        others = [one for one in others if one.kind not in first.kind.row.explains]
    is_advice = first.kind in MORE_IMAGES
    return (first, *(one for one in others if is_advice or one.kind not in MORE_IMAGES))


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict on a calibration with these findings; of the warnings, only a missed accuracy changes it."""
    found = tuple(findings)
    if any(one.severity == "rejects" for one in found):
        return "rejected"
    kinds = {one.kind for one in found}
    if FindingKind.NOT_CHECKED in kinds:
        return "not checked"
    return "accepted, but not as exact as needed" if FindingKind.NOT_EXACT_ENOUGH in kinds else "accepted"
