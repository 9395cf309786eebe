"""`python -m jcr.depth` compiles the loops of dense depth ahead of their first use, and keeps them on disk."""

from jcr.depth.densify import compile_loops

compile_loops()
