"""`python -m jcr.depth` compiles the numba loops of dense depth before their first use and caches them on disk."""

from jcr.depth.densify import compile_loops

compile_loops()
