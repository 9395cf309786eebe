"""Findings of the checks: the record of a finding, the table of its kinds, and the sentences made from both."""

from jcr.findings.finding import *
from jcr.findings.table import FindingKind as FindingKind
from jcr.findings.table import kinds_of as kinds_of
