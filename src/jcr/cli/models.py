"""`jcr models`: back ends, weights present or not, licences."""

from dataclasses import asdict, dataclass, field

from jcr.cli.output import Output
from jcr.reconstruct.backends import BACKENDS, Backend


@dataclass(frozen=True)
class Arguments:
    """List what can reconstruct a capture, under which licence, and what of it is on this machine.

    Those that `--backend auto` may take come first, in its order. Nothing is downloaded by this command.

    examples:
      jcr models
      jcr models --json
    """

    markdown: bool = False
    """Print the table of docs/backends.md."""
    output: Output = field(default_factory=Output)


@dataclass(frozen=True)
class Model:
    """A row of the list."""

    backend: str
    """For --backend."""
    weights: str
    """Hub id; empty where none are needed."""
    licence: str
    scale: str
    present: str
    """yes, or what is missing."""
    accuracy: str = ""
    """As measured; empty: not measured here."""


OTHERS = {
    "depth-anything/DA3-BASE": ("Apache-2.0", "camera_from_world"),
    "depth-anything/DA3-LARGE-1.1": ("non-commercial", "camera_from_world"),
    "yyfz233/Pi3X": ("non-commercial", "world_from_camera"),
    "facebook/VGGT-1B": ("non-commercial", "camera_from_world"),
}
"""Networks whose output `predictions` reads: licence, and the direction of their poses."""
SCALES = {True: "metres", False: "arbitrary", None: "your file's is_metric"}


def models() -> list[Model]:
    """The back ends, then networks to be run with their own packages."""
    rows = [
        Model(row.name, row.hub_id, row.licence, SCALES[row.metric], _present(row), row.accuracy)
        for row in BACKENDS.values()
    ]
    for hub_id, (licence, direction) in OTHERS.items():
        how = f"run its own package; poses are {direction}"
        rows.append(Model("predictions", hub_id, licence, "see its page", how))
    return rows


def _present(row: Backend) -> str:
    if not row.is_installed():
        return f"no: its package is missing, {row.install}"
    return "yes" if row.has_weights() else "no: downloaded on first use"


def as_text(rows: list[Model]) -> str:
    """The list for a terminal."""
    return "".join(
        f"{row.backend:<12} {row.weights or 'no weights needed'}\n"
        f"{'':<12} scale: {row.scale}; present: {row.present}\n"
        f"{'':<12} licence: {row.licence}\n"
        + (f"{'':<12} accuracy: {row.accuracy}\n" if row.accuracy else "")
        for row in rows
    )


def as_markdown() -> str:
    """The back ends as a table, without what differs from machine to machine."""
    lines = ["| back end | options of its own | auto | scale | licence | measured |", "|---" * 6 + "|"]
    for row in BACKENDS.values():
        flags = [f"`--{name.replace('_', '-')}`" for name in row.options]
        cells = [f"`{row.name}`", ", ".join(flags), "yes" if row.auto else "no", SCALES[row.metric]]
        lines.append(f"| {' | '.join([*cells, row.licence, row.accuracy])} |")
    return "\n".join(lines) + "\n"


def main(arguments: Arguments) -> int:
    """Print the list."""
    rows = models()
    text = as_markdown() if arguments.markdown else as_text(rows)
    arguments.output.result(text, {"models": [asdict(row) for row in rows]})
    return 0
