"""Records as HTML tables, which notebooks show."""

from collections.abc import Iterable, Sequence
from html import escape


def table(heading: str, rows: Iterable[Sequence[str]], note: str = "") -> str:
    """A heading, rows whose first cell names them, and a note below; all of it text."""
    cells = "".join(
        f"<tr><th>{escape(name)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in others)}</tr>"
        for name, *others in rows
    )
    return f"<p><b>{escape(heading)}</b></p><table>{cells}</table><p>{escape(note)}</p>"
