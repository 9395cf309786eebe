"""`jcr bench`: the benchmarks, which lie beside the source of this package and are not installed with it."""

import sys
from importlib import import_module
from pathlib import Path

from jcr.errors import InputError

CHECKOUT = Path(__file__).parents[3]

if not (CHECKOUT / "benchmarks" / "__main__.py").is_file():
    raise InputError(
        "bench: the benchmarks are not installed with jcr; they are in the folder benchmarks/ of its source: "
        "run `jcr bench` or `python -m benchmarks` there"
    )
# In front: other distributions have left a package of that name, too.
sys.path.insert(0, str(CHECKOUT))
_benchmarks = import_module("benchmarks.__main__")
Arguments, main = _benchmarks.Arguments, _benchmarks.main
