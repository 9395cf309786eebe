"""`jcr models`: networks and other back ends, their licences, and the weights on this machine; `get` downloads some."""

import sys
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from jcr.cli.output import Output
from jcr.errors import InputError
from jcr.hub import HUB_ID, download
from jcr.reconstruct import BACKENDS, Backend, weights_command


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """List the back ends with their licences, and what is installed on this machine; or download weights.

    Those that `--backend auto` may try come first, in its order. Listing downloads nothing.

    examples:
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
    """For get: accept a non-commercial licence, which is asked for otherwise."""
    revision: str | None = None
    """For get: another commit of the weights than the one this release was written for; give its folder to --weights."""
    output: Output = field(default_factory=Output)


SCALES = {True: "metres", False: "arbitrary", None: "your file's is_metric"}


def models() -> list[dict[str, Any]]:
    """Return the back ends in the order of `auto`, each as --json prints it."""
    return [
        {
            "backend": row.name,
            "weights": row.hub_id,
            "licence": row.licence,
            "commercial": row.commercial,
            "scale": SCALES[row.metric],
            "parameters_m": row.parameters,
            "download_gb": row.download_gb,
            "present": _present(row),
            "accuracy": row.accuracy,
        }
        for row in BACKENDS.values()
    ]


def _present(row: Backend) -> str:
    missing = [] if row.is_installed() else [f"{row.install}"]
    if not row.has_weights():
        missing.append(f"jcr models get {row.name}")
    return f"no: {'; '.join(missing)}" if missing else "yes"


def as_text(rows: list[dict[str, Any]]) -> str:
    """Return the list for a terminal."""
    lines = []
    for row in rows:
        size = f", {row['parameters_m']} M parameters" if row["parameters_m"] else ""
        size += f", {row['download_gb']:g} GB" if row["download_gb"] else ""
        limited = not row["commercial"] and "non-commercial" not in row["licence"]
        lines += [
            f"{row['backend']:<12} {row['weights'] or 'no weights needed'}{size}",
            f"{'':<12} licence: {row['licence']}{' (not for commercial use)' * limited}",
            f"{'':<12} scale: {row['scale']}; here: {row['present']}",
        ]
        if row["accuracy"]:
            lines.append(f"{'':<12} accuracy: {row['accuracy']}")
    return "\n".join(lines) + "\n"


def main(arguments: Arguments) -> int:
    """Print the list, or get weights."""
    if arguments.action == "get":
        return _get(arguments)
    if arguments.name is not None or arguments.accept_licence or arguments.revision is not None:
        raise InputError("jcr models: a name, --accept-licence and --revision are for jcr models get NAME")
    rows = models()
    arguments.output.result(as_text(rows), {"models": rows})
    return 0


def _get(arguments: Arguments) -> int:
    """Download the weights of a back end, or of a hub id, check them, and put them where runs look for them."""
    with_weights = [row.name for row in BACKENDS.values() if row.hub_id]
    name = arguments.name
    row = BACKENDS.get(name or "")
    if name is None or not (HUB_ID.fullmatch(name) or name in with_weights):
        named = "name one" if name is None else f"{name} has none to get"
        raise InputError(
            f"jcr models get: {named}; there are {', '.join(with_weights)}, and hub ids OWNER/NAME"
        )
    hub_id, revision = (row.hub_id, row.revision) if row else (name, None)
    if row and not (row.commercial or row.has_weights() or arguments.accept_licence or _accepts(row)):
        raise InputError(
            f"jcr models get {name}: its licence is {row.licence}; accept it with --accept-licence, or take da3"
        )
    folder = download(hub_id, arguments.revision or revision, arguments.output.quiet)
    text = f"{hub_id}: revision {folder.name[:12]}, checked, in {folder}\n"
    if row and not row.is_installed():
        text += f"its package is missing: {row.install}\n"
    facts = {"backend": row.name if row else None, "weights": hub_id, "revision": folder.name}
    arguments.output.result(text, facts | {"folder": str(folder)})
    return 0


def _accepts(row: Backend) -> bool:
    """Whether the user accepts a licence; False where nobody can be asked."""
    if not sys.stdin.isatty():
        return False
    sys.stderr.write(f"{weights_command(row)}.\nIts licence: {row.licence}\nDo you accept it? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")
