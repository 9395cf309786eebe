"""Findings of the checks: the record of a finding, the table of its kinds, and the sentences made from both."""

from jcr.findings.finding import *
from jcr.findings.messages import FindingKind as FindingKind
from jcr.findings.messages import kinds_of as kinds_of
