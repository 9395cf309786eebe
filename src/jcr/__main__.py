"""`python -m jcr` is `jcr`."""

from jcr.cli import main

main()
