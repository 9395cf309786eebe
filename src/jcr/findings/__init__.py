"""Findings of the checks: the record, the table of kinds, and their sentences."""

from jcr.findings.finding import *
from jcr.findings.table import FindingKind as FindingKind
from jcr.findings.table import kinds_of as kinds_of
