"""`jcr board`: a calibration board to print."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jcr.cli.output import Output


@dataclass(frozen=True)
class Arguments:
    """Write a ChArUco board or chessboard at its exact size, with rulers to check the printer.

    Print it at 100 %, measure the rulers, and calibrate with the --board that the sheet names.

    examples:
      jcr board board.pdf
      jcr board a3.pdf charuco:9x6:0.040:0.030:DICT_5X5_100 --paper a3
      jcr board board.pdf chessboard:9x6:0.025
    """

    out: Annotated[Path, tyro.conf.Positional]
    """PDF to write."""
    board: Annotated[str, tyro.conf.Positional] = "charuco:8x5:0.030:0.022:DICT_4X4_50"
    """charuco:SQUARES:SQUARE:MARKER:DICTIONARY or chessboard:INNER-CORNERS:SQUARE, lengths in metres."""
    paper: Literal["a4", "a3", "a2", "letter"] = "a4"
    """Paper, the long side across."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Write the sheet and print the option that it is used with."""
    from jcr.boards.sheet import board_sheet
    from jcr.errors import InputError
    from jcr.files import write_bytes

    if arguments.out.suffix.lower() != ".pdf":
        raise InputError(f"jcr board {arguments.out}: writes a PDF; name a file that ends in .pdf")
    write_bytes(arguments.out, board_sheet(arguments.board, arguments.paper).as_pdf())
    arguments.output.result(
        f"{arguments.out}: print at 100 % on {arguments.paper}, measure the rulers, then calibrate with "
        f"--board {arguments.board}\n",
        {"file": str(arguments.out), "board": arguments.board, "paper": arguments.paper},
    )
    return 0
