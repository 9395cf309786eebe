"""Record of a finding, and the order, verdict and sentences of several."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.findings.requirement import Requirement
from jcr.findings.table import MOTIONS, REACHED, FindingKind
from jcr.rounding import significant

Severity = Literal["rejects", "warns", "informs"]
Concerns = Literal["reconstruction", "motion", "images", "intrinsics", "poses", "mount", "robot", "none"]
"""Part of the capture that the remedy changes: another reconstruction of the same images, other motions, more or other
images, other intrinsics, corrected gripper poses, a firm mount, the arm's name or joint angles; or nothing."""
Verdict = Literal["accepted", "accepted with warnings", "rejected"]
NUMBERS = ("joints", "value", "std", "p", "shift", "intrinsics_shift")
"""Fields of a finding that are its numbers."""
RANK: dict[Severity, int] = {"rejects": 0, "warns": 1, "informs": 2}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Observation that speaks against a calibration, or that is worth stating."""

    # Files also hold text and remedy, which follow from the fields.
    __pydantic_config__ = {"extra": "ignore"}
    kind: FindingKind
    severity: Severity
    concerns: Concerns = "none"
    images: tuple[str, ...] = ()
    """Names of the images concerned; empty where it concerns all or none."""
    joints: tuple[int, ...] = ()
    """Joints concerned, the first is 1."""
    value: float | None = None
    """Size, in the unit of its kind (docs: reference/findings); None where it has no size."""
    std: float | None = None
    """One standard deviation of the value."""
    p: float | None = None
    """Chance of this or more where there is nothing to find."""
    shift: tuple[float, ...] | None = None
    """Change of the calibration if this were allowed for, in COVARIANCE_ORDER; its outer product is part of the
    covariance. None where it adds nothing."""
    intrinsics_shift: tuple[float, ...] | None = None
    """Change of the intrinsics with it, in the order of camera.parameters. What these compensate of `shift` is no
    error for a user of both. None where it concerns the transform alone."""
    details: Mapping[str, float | str] = field(default_factory=dict)
    """Further numbers (m, rad, px, shares) and names that the sentence needs."""

    @classmethod
    def of(
        cls, kind: FindingKind, severity: Severity, concerns: Concerns = "none", *images: str, **known: Any
    ) -> "Finding":
        """Make a finding about these images; `known` are its numbers, and details by their names."""
        sizes = {name: known.pop(name) for name in NUMBERS if name in known}
        return cls(kind=kind, severity=severity, concerns=concerns, images=images, details=known, **sizes)

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Its part of the covariance of the calibration, in COVARIANCE_ORDER."""
        shift = np.zeros(7) if self.shift is None else np.array(self.shift)
        return np.outer(shift, shift)


LENGTHS = {
    "robot": "the robot's positions",
    "board": "the size of the board",
    "known length": "the known length",
    "depth camera": "the depth camera",
    "network": "the network's metre",
}
"""Names of the sources of a scale."""


class _Number(float):
    """Number of a template: {n:~} has two significant digits, {n:!.1f} no sign, and {n:long|short} goes by the sign."""

    def __format__(self, spec: str) -> str:
        if "|" in spec:
            return spec.split("|")[self <= 0]
        if "$" in spec:
            return spec.replace("$", significant(self))
        number, spec = abs(self) if spec.startswith("!") else float(self), spec.removeprefix("!")
        return significant(number) if spec == "~" else format(number, spec)


class _Text(str):
    """Text of a template: {name:a=words of a|b=words of b}, or {name:words around $}, which are empty without it."""

    def __format__(self, spec: str) -> str:
        if "=" in spec:
            return dict(part.split("=", 1) for part in spec.split("|") if part).get(self, "")
        if not self:
            return spec.split("|")[1] if "|" in spec else ""
        return spec.replace("$", self) or str(self)


class _Images(tuple[str, ...]):
    """Images of a template: {images} names at most three, {images:is|are} agrees with their number."""

    def __format__(self, spec: str) -> str:
        if spec:
            return spec.split("|")[len(self) > 1]
        return joined([*self[:3], *[f"{len(self) - 3} more"] * (len(self) > 3)])


class Quantities(dict[str, Any]):
    """Quantities that templates name: details and numbers of a finding, these also in mm, degrees and percent.

    A quantity that a finding lacks is an empty text.
    """

    def __missing__(self, name: str) -> _Text:
        return _Text("")

    @staticmethod
    def of(finding: Finding) -> "Quantities":
        """Return the quantities of a finding."""
        named = Quantities(images=_Images(finding.images), concerns=_Text(finding.concerns))
        for name, one in {"value": finding.value, "std": finding.std, **finding.details}.items():
            if isinstance(one, str):
                named[name] = _Text(LENGTHS.get(one, one))
            elif one is not None:
                of, units = (
                    "" if name == "value" else f"{name}_",
                    {"mm": 1e3, "deg": 180 / np.pi, "percent": 100.0},
                )
                named |= {name: _Number(one)} | {
                    f"{of}{unit}": _Number(per * one) for unit, per in units.items()
                }
                if name.endswith("_mm"):
                    named[name.removesuffix("m")] = _Number(1e-3 * one)
        if "x" in named:
            at, frame = np.array([named[name] for name in "xyz"], float), finding.details["frame"]
            k = int(np.abs(at).argmax())
            along = abs(at[k]) > np.cos(np.radians(10))
            numbers = ", ".join(f"{x:.2f}" for x in at)
            named["axis"] = (
                f"the {frame}'s {'xyz'[k]} axis" if along else f"the axis ({numbers}) of the {frame}"
            )
            named["point"] = ", ".join(f"{1e3 * x:.0f}" for x in at)
        if "motion" in named:
            direction, move = MOTIONS[named["motion"]]
            named |= {"direction": direction.format_map(named), "move": move.format_map(named)}
        return named


def joined(words: Iterable[str]) -> str:
    """Return the words as an enumeration: "a, b and c"."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def text(finding: Finding) -> str:
    """Return the message: what is wrong, in one sentence."""
    return finding.kind.row.message.format_map(Quantities.of(finding))


def remedy(finding: Finding) -> str:
    """Return the remedy in one sentence; empty where nothing helps or nothing need be done."""
    return finding.kind.row.remedy.format_map(Quantities.of(finding))


def unobservable(finding: Finding) -> str:
    """Return the direction that is unobservable, or nearly so, in words."""
    return "{nearly:nearly unobservable: |}{direction}".format_map(Quantities.of(finding))


def reached_in_words(required: Requirement) -> str:
    """Return the bound of 95 % of the errors beside the requirement, in words."""
    short = Finding.of(FindingKind.NOT_EXACT_ENOUGH, "informs", "none", **required.details)
    return REACHED.format_map(Quantities.of(short))


def sentence(finding: Finding) -> str:
    """Return message and remedy in one line."""
    return "; ".join(filter(None, (text(finding), remedy(finding))))


def doubt_of(findings: Iterable[Finding]) -> str | None:
    """Return the first reason of a rejection, of findings that are strongest first; None where nothing rejects."""
    return next((sentence(finding) for finding in findings if finding.severity == "rejects"), None)


def warnings_of(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return a sentence for each finding that rejects or warns."""
    return tuple(sentence(finding) for finding in findings if finding.severity != "informs")


def no_reconstruction(error: RejectedError) -> tuple[Finding, ...]:
    """Return the failure of every back end as findings."""
    words = {"text": error.what, "remedy": "; ".join(error.remedies)}
    failed = Finding.of(FindingKind.NO_RECONSTRUCTION, "rejects", "reconstruction", **words)
    return (failed, *(Finding.of(FindingKind.RECONSTRUCTION, "warns", text=text) for text in error.also))


def is_cause(finding: Finding) -> bool:
    """Test whether a finding explains others."""
    return bool(finding.kind.row.explains)


def is_lasting(finding: Finding) -> bool:
    """Test whether a finding holds for every reconstruction of the same images: camera, robot, mount, order."""
    return is_cause(finding) and finding.kind.row.group != "reconstruction"


def strongest_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Order findings by severity; of one severity those of the images alone, other causes, then consequences."""

    def place(finding: Finding) -> tuple[int, bool, bool]:
        return RANK[finding.severity], finding.kind.row.group != "images", not is_cause(finding)

    return tuple(sorted(findings, key=place))


def is_explained(findings: Sequence[Finding]) -> bool:
    """Test whether a cause rejects a calibration, against which neither more images nor other motions help."""
    return bool(findings) and findings[0].severity == "rejects" and is_cause(findings[0])


def without_consequences(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings, strongest first, without those that the first one explains: their remedies do not help."""
    if not is_explained(findings):
        return tuple(findings)
    first, *others = findings
    return (first, *(one for one in others if one.kind not in first.kind.row.explains))


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict, that of the worst finding."""
    severities = {finding.severity for finding in findings}
    if "rejects" in severities:
        return "rejected"
    return "accepted with warnings" if "warns" in severities else "accepted"
