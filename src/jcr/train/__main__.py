"""`python -m jcr.train`."""

import sys

import tyro

from jcr.errors import InputError
from jcr.train.options import TrainOptions
from jcr.train.train import train

if __name__ == "__main__":
    try:
        train(tyro.cli(TrainOptions, config=(tyro.conf.FlagCreatePairsOff,)))
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(2)
