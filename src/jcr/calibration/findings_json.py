"""Findings in the files that jcr writes, and what is derived of them there: verdict, converged, warnings."""

import json
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, TypeAdapter, ValidationError

from jcr.capture.plain_files import first_fault
from jcr.findings import Finding, Verdict, remedy, text, verdict_of, warnings_of


def as_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as files have it: its fields, its text and its remedy."""
    return vars(finding) | {"text": text(finding), "remedy": remedy(finding)}


def _without_words(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    numbers = {name: part for name, part in value.items() if name not in ("text", "remedy")}
    try:
        # As JSON again: there, and not among Python's values, a dict may stand for a record and a list for a tuple.
        return _FINDING.validate_json(json.dumps(numbers), strict=True)
    except ValidationError as error:
        raise ValueError(first_fault(error)) from None


_FINDING = TypeAdapter(Finding)
FindingJson = Annotated[Finding, BeforeValidator(_without_words), PlainSerializer(as_json)]
"""Finding with its text and remedy, which are for people and made again when it is read."""


def derived(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the fields of a file that hold findings, strongest first."""
    verdict = verdict_of(findings)
    return {
        "findings": list(findings),
        "verdict": verdict,
        "converged": verdict != "rejected",
        "warnings": list(warnings_of(findings)),
    }


def require_one_verdict(findings: Sequence[Finding], verdict: Verdict, converged: bool) -> None:
    """Raise ValueError where the verdict contradicts the findings."""
    if verdict != verdict_of(findings) or converged is (verdict == "rejected"):
        raise ValueError("converged, verdict and findings contradict one another")
