"""HTML tables of records for notebooks."""

from collections.abc import Iterable, Sequence

TEMPLATE = """\
<p><b>{{ heading }}</b></p><table>
{%- for row in rows %}<tr><th>{{ row[0] }}</th>{% for cell in row[1:] %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor -%}
</table><p>{{ note }}</p>"""


def table(heading: str, rows: Iterable[Sequence[str]], note: str = "") -> str:
    """Return an HTML table with a heading above and a note below; the first cell of each row is its header.

    All arguments are plain text, which is escaped.
    """
    from jinja2 import Template  # which no command needs for its help

    return Template(TEMPLATE, autoescape=True).render(heading=heading, rows=rows, note=note)
