"""What every command says and where: its result on stdout, all else on stderr."""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Output:
    """What the command prints: its result on stdout, everything else on stderr."""

    json: bool = False
    """Print the result as one JSON object."""
    quiet: bool = False
    """Print only errors on stderr: no progress, notes or warnings."""

    def result(self, text: str, facts: Mapping[str, object]) -> None:
        """Print the result at once: `facts` with --json, else the text for people."""
        sys.stdout.write(json.dumps(facts) + "\n" if self.json else text)
        sys.stdout.flush()
