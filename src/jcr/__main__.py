"""Entry point of `python -m jcr`, which is the command `jcr`."""

from jcr.cli import main

main()
