"""Commands that are not part of a calibration: board, docs and models."""

from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jcr.backends import BACKENDS, weights_command
from jcr.cli.output import Output
from jcr.errors import InputError, did_you_mean
from jcr.extras import DISTRIBUTION
from jcr.files import write_bytes
from jcr.hub import HUB_ID, download

CHECKOUT = Path(__file__).parents[3] / "docs"
SECTIONS = ("tutorials", "how-to", "reference", "explanation", "results")
"""Folders of the manual's pages; pages in `results`, whose names others have, are named with their folder."""
MOST_NAMED = 4
"""Largest number of pages that are named for a word."""


@dataclass(frozen=True)
class BoardCommand:
    """Write a ChArUco board or chessboard at its exact size, with rulers to check the printer.

    Print it at 100 %, measure the rulers, and calibrate with the --board that the sheet names.

    for example:
      jcr board board.pdf
      jcr board a3.pdf charuco:9x6:0.040:0.030:DICT_5X5_100 --paper a3
      jcr board board.pdf chessboard:9x6:0.025
    """

    out: Annotated[Path, tyro.conf.Positional]
    """PDF to write."""
    board: Annotated[str, tyro.conf.Positional] = "charuco:8x5:0.030:0.022:DICT_4X4_50"
    """Board as charuco:SQUARES:SQUARE:MARKER:DICTIONARY or chessboard:INNER-CORNERS:SQUARE, with lengths in metres."""
    paper: Literal["a4", "a3", "a2", "letter"] = "a4"
    """Paper size; the long side is horizontal."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Write the sheet with the board, and print the option --board for its use; return the exit status 0."""
        from jcr.boards.sheet import as_pdf, board_sheet

        if self.out.suffix.lower() != ".pdf":
            raise InputError(f"jcr board {self.out}: writes a PDF; name a file that ends in .pdf")
        write_bytes(self.out, as_pdf(*board_sheet(self.board, self.paper)))
        use = f"print at 100 % on {self.paper}, measure the rulers, then calibrate with --board {self.board}"
        facts = {"file": str(self.out), "board": self.board, "paper": self.paper}
        self.output.result([f"{self.out}: {use}"], facts)
        return 0


@dataclass(frozen=True)
class DocsCommand:
    """Print a page of the manual, or list the pages.

    for example:
      jcr docs
      jcr docs captures
      jcr docs results/speed
    """

    name: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[PAGE]")] = ()
    """Page to print, or words of which the pages that contain them are named; none: list all pages."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Print a page of the manual, or the names and titles of all pages; return the exit status 0."""
        if self.name:
            text = page(name := " ".join(self.name))
            self.output.result(text.splitlines(), {"page": name, "markdown": text})
            return 0
        titles, lines, section = dict[str, str](), list[str](), ""
        for name, path in pages().items():
            titles[name] = path.read_text("utf-8").partition("\n")[0].removeprefix("# ").strip()
            if path.parent.name != section:
                section = path.parent.name
                lines += [*([""] if lines else []), f"{section}:"]
            lines.append(f"  {name:<20} {titles[name]}")
        self.output.result(lines, {"pages": titles})
        return 0


def pages() -> dict[str, Path]:
    """Return the file of each page of the manual by its name for `jcr docs`; empty if no page is installed."""
    found = list(CHECKOUT.rglob("*.md"))
    if not (CHECKOUT / "conf.py").is_file():
        with suppress(PackageNotFoundError):  # when run from source files, without installation
            installed = [Path(str(file.locate())) for file in files(DISTRIBUTION) or []]
            found = [one for one in installed if one.suffix == ".md" and f"doc/{DISTRIBUTION}/" in str(one)]
    named = [file for file in found if file.parent.name in SECTIONS and file.stem not in ("index", "README")]
    named.sort(key=lambda file: (SECTIONS.index(file.parent.name), file))
    return {"results/" * (file.parent.name == "results") + file.stem: file for file in named}


def page(name: str) -> str:
    """Return the Markdown of a page by its name (`captures`, `results/speed`) or a link to it, else raise InputError."""
    found = pages()
    if name not in found:  # a link of a page, such as ../how-to/exports.md
        last = name.removesuffix(".md").rpartition("/")[2]
        name = next((one for one in (last, f"results/{last}") if one in found), name)
    if name not in found:
        words, count = name.lower().split(), dict[str, int]()
        for other, path in found.items():
            text = path.read_text("utf-8").lower()
            count[other] = sum(map(text.count, words)) if all(word in text for word in words) else 0
        speak = sorted(filter(count.get, found), key=lambda other: -count[other])[:MOST_NAMED]
        what = "this word" if len(words) == 1 else "these words"
        there = f"pages that contain {what}: {', '.join(speak)}" if speak else "`jcr docs` lists the pages"
        raise InputError(f"jcr docs {name}: no such page{did_you_mean(name, found)}; {there}")
    return found[name].read_text(encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class ModelsCommand:
    """List the back ends with their licences, and what is installed on this machine; or download weights.

    The back ends that `--backend auto` may try come first, in that order. Listing downloads nothing.

    for example:
      jcr models
      jcr models get da3-small
      jcr models get dust3r --accept-licence
      jcr models --json
    """

    action: Annotated[Literal["list", "get"], tyro.conf.Positional] = "list"
    """list; or get: download the weights of a back end."""
    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")] = None
    """For get: the back end whose weights are downloaded, or a hub id for --weights or --sam-weights."""
    accept_licence: bool = False
    """For get: accept a non-commercial licence."""
    output: Output = field(default_factory=Output)

    def main(self) -> int:
        """Print the list of back ends, or download the weights of one; return the exit status."""
        if self.action == "get":
            with_weights = [row.name for row in BACKENDS.values() if row.hub_id]
            name = self.name
            row = BACKENDS.get(name or "")
            if name is None or not (HUB_ID.fullmatch(name) or name in with_weights):
                named = "name one" if name is None else f"{name} has none to get"
                raise InputError(
                    f"jcr models get: {named}; there are {', '.join(with_weights)}, and hub ids OWNER/NAME"
                )
            hub_id, revision = (row.hub_id, row.revision) if row else (name, None)
            if row and not (row.commercial or row.has_weights() or self.accept_licence):
                raise InputError(
                    f"{weights_command(row)}; its licence is {row.licence}; accept it with --accept-licence, or take da3"
                )
            folder = download(hub_id, revision, self.output.quiet)
            lines = [f"{hub_id}: revision {folder.name[:12]}, checked, in {folder}"]
            if row and not row.is_installed():
                lines.append(f"its package is missing: {row.install}")
            facts = {"backend": row.name if row else None, "weights": hub_id, "revision": folder.name}
            self.output.result(lines, facts | {"folder": str(folder)})
            return 0
        if self.name is not None or self.accept_licence:
            raise InputError("jcr models: name and --accept-licence are for jcr models get NAME")
        lines, facts = [], []
        for row in BACKENDS.values():
            missing = [] if row.is_installed() else [row.install]
            missing += [] if row.has_weights() else [f"jcr models get {row.name}"]
            present = f"no: {'; '.join(missing)}" if missing else "yes"
            size = f", {row.download_gb:g} GB" if row.download_gb else ""
            limited = not row.commercial and "non-commercial" not in row.licence
            lines += [
                f"{row.name:<12} {row.hub_id or 'no weights needed'}{size}",
                f"{'':<12} licence: {row.licence}{' (not for commercial use)' * limited}",
                f"{'':<12} here: {present}",
            ]
            own = {name: getattr(row, name) for name in ("licence", "commercial", "download_gb")}
            facts.append({"backend": row.name, "weights": row.hub_id, "present": present} | own)
        self.output.result(lines, {"models": facts})
        return 0
