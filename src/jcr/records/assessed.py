"""Records with findings, from which their verdict and the reasons in words follow."""

from dataclasses import dataclass, replace
from typing import TypeVar

from jcr.findings import Finding, Verdict, doubt_of, strongest_first, verdict_of, warnings_of

Same = TypeVar("Same", bound="Assessed")


@dataclass(frozen=True, kw_only=True)
class Assessed:
    """Calibration with its findings."""

    findings: tuple[Finding, ...] = ()
    """Strongest first; of the same severity causes before consequences."""

    def with_findings(self: Same, *findings: Finding) -> Same:
        """Return the record with more findings, each in its place."""
        return replace(self, findings=strongest_first((*self.findings, *findings)))

    @property
    def verdict(self) -> Verdict:
        """Verdict of the worst finding."""
        return verdict_of(self.findings)

    @property
    def converged(self) -> bool:
        """Whether it is accepted."""
        return self.verdict != "rejected"

    @property
    def doubt(self) -> str | None:
        """Reason of the rejection in words; None where it is accepted."""
        return doubt_of(self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each finding that rejects or warns."""
        return warnings_of(self.findings)
