"""What findings are about: its verdict and the reasons in words follow from the findings alone."""

from dataclasses import dataclass, replace
from typing import TypeVar

from jcr.findings import Finding, Verdict, doubt_of, strongest_first, verdict_of, warnings_of

Same = TypeVar("Same", bound="Assessed")


@dataclass(frozen=True, kw_only=True)
class Assessed:
    """A calibration, or a camera's place, with what was found against it."""

    findings: tuple[Finding, ...] = ()
    """Strongest first; of the same severity causes before consequences."""

    def with_findings(self: Same, *findings: Finding) -> Same:
        """The same with more findings, each in its place."""
        return replace(self, findings=strongest_first((*self.findings, *findings)))

    @property
    def verdict(self) -> Verdict:
        """That of the worst finding."""
        return verdict_of(self.findings)

    @property
    def converged(self) -> bool:
        """Whether it is accepted."""
        return self.verdict != "rejected"

    @property
    def doubt(self) -> str | None:
        """Why it is rejected, in words; None when it is not."""
        return doubt_of(self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each finding that rejects or warns."""
        return warnings_of(self.findings)
