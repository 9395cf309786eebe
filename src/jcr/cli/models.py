"""`jcr models`: back ends, weights present or not, licences."""

from dataclasses import asdict, dataclass, field

from jcr.cli.output import Output
from jcr.reconstruct.backends import BACKENDS
from jcr.reconstruct.checkpoints import CHECKPOINTS


@dataclass(frozen=True)
class Arguments:
    """List what can reconstruct a capture, under which licence, and what of it is on this machine.

    Nothing is downloaded by this command.

    examples:
      jcr models
      jcr models --json
    """

    output: Output = field(default_factory=Output)


@dataclass(frozen=True)
class Model:
    """A row of the list."""

    backend: str
    """For --backend."""
    weights: str
    """Hub id or folder; empty where none are needed."""
    licence: str
    scale: str
    present: str
    """yes, or what is missing."""
    accuracy: str = ""
    """As measured (jcr bench compact); empty: not measured here."""


OTHERS = {
    "depth-anything/DA3-BASE": ("Apache-2.0", "camera_from_world"),
    "depth-anything/DA3-LARGE-1.1": ("non-commercial", "camera_from_world"),
    "yyfz233/Pi3X": ("non-commercial", "world_from_camera"),
    "facebook/VGGT-1B": ("non-commercial", "camera_from_world"),
}
"""Networks whose output `predictions` reads: licence, and the direction of their poses."""


def models() -> list[Model]:
    """The back ends, then networks to be run with their own packages."""
    rows = [
        Model(row.name, "", row.licence, "metres" if row.metric else "arbitrary", "yes")
        for row in BACKENDS.values()
        if row.name not in (*CHECKPOINTS, "predictions")
    ]
    for name, checkpoint in CHECKPOINTS.items():
        scale = "metres" if checkpoint.is_metric else "arbitrary"
        present = "yes" if checkpoint.is_cached() else "no: downloaded on first use"
        if name == "compact" and not checkpoint.is_cached():
            present = "no: python -m jcr.train makes them (docs/compact-model.md)"
        if not BACKENDS[name].is_installed():
            present = "no: its package is missing"
        rows.append(Model(name, checkpoint.hub_id, checkpoint.licence, scale, present, checkpoint.accuracy()))
    rows.append(Model("predictions", "", "your network's", "your file's is_metric", "yes"))
    for hub_id, (licence, direction) in OTHERS.items():
        how = f"run its own package; poses are {direction}"
        rows.append(Model("predictions", hub_id, licence, "see its page", how))
    return rows


def main(arguments: Arguments) -> int:
    """Print the list."""
    rows = models()
    text = "".join(
        f"{row.backend:<12} {row.weights or 'no weights needed'}\n"
        f"{'':<12} scale: {row.scale}; present: {row.present}\n"
        f"{'':<12} licence: {row.licence}\n"
        + (f"{'':<12} accuracy: {row.accuracy}\n" if row.accuracy else "")
        for row in rows
    )
    arguments.output.result(text, {"models": [asdict(row) for row in rows]})
    return 0
