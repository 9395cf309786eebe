"""Writes the pages of the reference that are read from the source: cli.md, api.md, formats.md and their schemas, and
the table of backends.md.

`docs/conf.py` calls it before the site is built; `python docs/generated.py` does the same.
"""

import ast
import contextlib
import inspect
import io
import json
import re
import sys
import textwrap
from collections.abc import Collection, Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

import jcr
from jcr.backends import BACKENDS
from jcr.calibration.record import Calibration
from jcr.cell.cameras_json import CamerasFile
from jcr.cli import COMMANDS, dispatch
from jcr.depth.depth_npz import DepthHeader as DepthAbout
from jcr.findings import FindingKind
from jcr.findings.messages import GROUPS, KindRow
from jcr.result import RunState

REFERENCE = Path(__file__).parent / "reference"
SCHEMAS = REFERENCE / "schemas"
EXAMPLE = Path(__file__).parents[1] / "examples" / "01_quick_start.py"
FORMATS = {
    "calibration.json": (
        Calibration,
        "The hand-eye transform, its covariance, and what was made of each image.",
    ),
    "cameras.json": (CamerasFile, "Further cameras and arms of the cell, where there are some."),
    "run.json": (RunState, "The state of a run folder: capture, options, and what each stage was made from."),
    "depth.npz": (
        DepthAbout,
        "The array `about` in it, as JSON; other arrays have the names of [Pointmaps](api.md#jcrpointmaps). "
        "In reconstruction.npz, `about` is a [Reconstruction](api.md#jcrreconstruction) with the names of its arrays.",
    ),
}
"""Files of a run folder that a pydantic model in the source describes."""


def write_pages() -> None:
    """Write all of them."""
    REFERENCE.mkdir(exist_ok=True)
    SCHEMAS.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (REFERENCE / name).write_text(page(), encoding="utf-8")


def cli_page() -> str:
    """Every command with its arguments, as the parser itself has them."""
    parts = [
        "# Command line\n",
        "Written from the parser of each command. Exit status: 0 done, 2 the input is wrong, 3 the result is rejected "
        "or not as exact as needed, 1 a bug, 130 interrupted, 141 if the reader of the output "
        "ended. [In the shell](../how-to/batch.md#in-the-shell).\n",
        "| command | |\n|---|---|",
        *(f"| [`jcr {name}`](#jcr-{name}) | {about} |" for name, about in COMMANDS.items()),
    ]
    for name in COMMANDS:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            dispatch([name, "--help"])
        parts += ["", f"## jcr {name}", "", "```text", printed.getvalue().strip(), "```"]
    return "\n".join(parts) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").strip()


def _escaped(text: str) -> str:
    """Angle brackets and stars of help texts are not markup."""
    return re.sub(r"([<>*])", r"\\\1", text)


def _text(docstring: str) -> str:
    """A docstring as Markdown: indented blocks after `for example:` are code."""
    lines, code = [], False
    for line in inspect.cleandoc(docstring).splitlines():
        if line.startswith("  ") and not code:
            lines += ["", "```"]
            code = True
        if code and line and not line.startswith("  "):
            lines += ["```", ""]
            code = False
        lines.append(line[2:] if code else line)
    return "\n".join([*lines, "```"] if code else lines)


def api_page() -> str:
    """The public names of the package, and what its functions return."""
    parts = [
        "# Python\n",
        "Every public name of `jcr`. Transforms are `a_from_b` (4×4), points `x_in_a`; metres and radians, or the unit "
        "in the name. Cameras are OpenCV's: x right, y down, z forward. A path may be text, an array a list, options a "
        'dict with the names of the fields: `jcr.run(capture, out, {"calibrate": {"require": (2, 0.3)}})`. What is '
        "wrong in files, poses and options is an `InputError`; an argument of a wrong type may be a `TypeError`. A "
        "message that names an option of the command line, such as `--pose-units`, means the field `pose_units` here.\n",
        f"A complete example, `examples/{EXAMPLE.name}`:\n\n```python\n{EXAMPLE.read_text('utf-8')}```\n",
    ]
    for name in jcr.__all__:
        parts += _entry(f"jcr.{name}", getattr(jcr, name))
    return "\n".join(parts) + "\n"


def _entry(name: str, value: Any) -> list[str]:
    if inspect.isfunction(value):
        return [
            "",
            f"## {name}",
            "",
            f"```python\n{_signature(name, value)}\n```",
            "",
            _text(value.__doc__ or ""),
        ]
    lines = ["", f"## {name}", "", _text(value.__doc__ or "")]
    if is_dataclass(value):
        said, kinds = described(value), annotations(value)
        rows = [
            f"| `{field.name}` | `{_cell(kinds.get(field.name, ''))}` | {_default(field)} | "
            f"{_cell(_escaped(said.get(field.name, '')))} |"
            for field in fields(value)
        ]
        lines += ["", "| field | type | default | |", "|---|---|---|---|", *rows]
    elif inspect.isclass(value) and "__init__" in vars(value):
        lines += ["", f"```python\n{_signature(name, vars(value)['__init__'])}\n```"]
        lines += ["", _text(vars(value)["__init__"].__doc__ or "")]
    hidden = [
        one
        for one in inspect.getmro(value)
        if one.__module__.startswith("jcr") and not hasattr(jcr, one.__name__)
    ]
    own = {name for one in (value, *hidden) for name in vars(one)}
    for name, prop in inspect.getmembers(value, lambda one: isinstance(one, property | cached_property)):
        if name in own and prop.__doc__:
            lines.append(f"\n`.{name}`: {_text(prop.__doc__)}")
    for method, function in inspect.getmembers(value, inspect.isfunction):
        if not method.startswith("_") and function.__doc__ and method in vars(value):
            lines += ["", f"```python\n{_signature(method, function)}\n```", "", _text(function.__doc__)]
    return lines


def _default(field: Field[Any]) -> str:
    """Return the default of a field of a record; empty where it must be given."""
    if field.default is not MISSING:
        return f"`{_cell(repr(field.default))}`"
    return "" if field.default_factory is MISSING else "those of its fields"


def _signature(name: str, function: Any) -> str:
    """Return the signature as it is in the source, where annotations are short."""
    node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(node, ast.FunctionDef)
    arguments = ast.unparse(node.args)
    line = f"{name}({arguments})" + (f" -> {ast.unparse(node.returns)}" if node.returns else "")
    if len(line) <= 100:
        return line
    parts = inspect.signature(function).parameters
    star = [parameter for parameter in parts.values() if parameter.kind is parameter.KEYWORD_ONLY]
    written = {part.arg: part for part in [*node.args.args, *node.args.kwonlyargs]}
    lines = []
    for parameter in parts.values():
        if star and parameter is star[0]:
            lines.append("    *,")
        kind = written[parameter.name].annotation if parameter.name in written else None
        text = parameter.name + (f": {ast.unparse(kind)}" if kind else "")
        default = "..." if inspect.isfunction(parameter.default) else repr(parameter.default)
        text += "" if parameter.default is parameter.empty else f" = {default}"
        lines.append(f"    {text},")
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return "\n".join([f"{name}(", *lines, f"){returns}"])


def described(record: type) -> dict[str, str]:
    """Return the docstring of each field of a class and of the classes it derives from."""
    return {
        field.target.id: " ".join(below.value.value.split())
        for field, below in _fields(record)
        if isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
        and isinstance(below.value.value, str)
    }


def annotations(record: type) -> dict[str, str]:
    """The type of each field as the source has it, without what tyro is told beside it."""
    found = {}
    for field, _ in _fields(record):
        kind = field.annotation
        if isinstance(kind, ast.Subscript) and ast.unparse(kind.value) == "Annotated":
            kind = kind.slice.elts[0] if isinstance(kind.slice, ast.Tuple) else kind
        found[field.target.id] = ast.unparse(kind).replace(" | ", " or ")
    return found


def _fields(record: type) -> Iterator[tuple[Any, ast.stmt | None]]:
    for kind in reversed(record.__mro__):
        if not kind.__module__.startswith("jcr"):
            continue
        node = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
        assert isinstance(node, ast.ClassDef)
        for field, below in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                yield field, below


def schema(model: Any) -> dict[str, Any]:
    """The JSON Schema of a pydantic model, with what the source says of each field."""
    found = TypeAdapter(model).json_schema(mode="serialization")
    for name, part in [(model.__name__, found), *found.get("$defs", {}).items()]:
        kind = _class_named(name, part.get("properties", {}).keys())
        for field, text in ({} if kind is None else described(kind)).items():
            if field in part.get("properties", {}):
                part["properties"][field].setdefault("description", text)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | found


def _class_named(name: str, properties: Collection[str]) -> type | None:
    """The class of a part of a schema: others may have its name, but not all of its fields."""
    modules = sorted(name for name in sys.modules if name.startswith("jcr"))
    found = (vars(sys.modules[module]).get(name) for module in modules)
    return next(
        (kind for kind in found if inspect.isclass(kind) and annotations(kind).keys() >= set(properties)),
        None,
    )


def formats_page() -> str:
    """Every file that is read or written, with its JSON Schema beside it."""
    parts = [
        "# Files and their schemas\n",
        "| file | schema | what |\n|---|---|---|",
        "| `capture.json` | {download}`capture.schema.json <schemas/capture.schema.json>` | "
        "Images and gripper poses: what is read. [Other formats](captures.md). |",
    ]
    for file, (model, what) in FORMATS.items():
        name = f"{file.split('.')[0]}.schema.json"
        (SCHEMAS / name).write_text(
            json.dumps(schema(model), indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
        parts.append(f"| `{file}` | {{download}}`{name} <schemas/{name}>` | {what} |")
    parts += [
        "| `predictions.npz` | | [Predictions](predictions.md): what a network of your own gives. |",
        "| `cloud.ply`, `map.safetensors`, `report.html`, `log.txt` | | The point cloud in the base frame, "
        "[the map](../how-to/map.md), [the report](../how-to/viewer.md), all messages. |",
        "",
        "The schemas state what is checked on reading, but for what needs more than one field: that a matrix is rigid, "
        "a covariance positive, an image in its folder.",
    ]
    capture = json.loads((SCHEMAS / "capture.schema.json").read_text(encoding="utf-8"))
    parts += ["", "## capture.json", "", capture["description"], "", *_table(capture)]
    for name, part in capture["$defs"].items():
        parts += ["", f"**{name}**: {part.get('description', '')}", "", *_table(part)]
    for file, (model, what) in FORMATS.items():
        found = schema(model)
        parts += ["", f"## {file}", "", what, "", *_table(found)]
        for name, part in found.get("$defs", {}).items():
            if "properties" in part:
                parts += [
                    "",
                    f"**{name}**: {_escaped(' '.join(part.get('description', '').split()))}",
                    "",
                    *_table(part),
                ]
    return "\n".join(parts) + "\n"


def _table(part: dict[str, Any]) -> list[str]:
    required = part.get("required", [])
    rows = [
        f"| `{name}`{'' if name in required else ' (optional)'} | {_cell(_type(value))} "
        f"| {_cell(_escaped(_said(value)))} |"
        for name, value in part.get("properties", {}).items()
    ]
    return ["| key | type | |", "|---|---|---|", *rows] if rows else []


def _said(value: dict[str, Any]) -> str:
    """Return the description of a value, or of the other type of a value that may be null."""
    parts = [value, *value.get("anyOf", [])]
    return next((part["description"] for part in parts if "description" in part), "")


def _type(value: dict[str, Any]) -> str:
    if "$ref" in value:
        return value["$ref"].rpartition("/")[2]
    if "anyOf" in value:
        return " or ".join(dict.fromkeys(_type(part) for part in value["anyOf"]))
    if "enum" in value or "const" in value:
        return ", ".join(f"`{choice}`" for choice in value.get("enum", [value.get("const")]))
    if value.get("type") == "array":
        count = value.get("minItems") if value.get("minItems") == value.get("maxItems") else None
        if "items" in value:
            return f"list of {f'{count} × ' if count else ''}{_type(value['items'])}"
        return "list"
    return str(value.get("type", "any"))


def backends_page() -> str:
    """The page of back ends with its table as the source has it."""
    head = [
        "back end",
        "options of its own",
        "auto",
        "download",
        "licence",
    ]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in BACKENDS.values():
        flags = [f"`--{name.replace('_', '-')}`" for name in row.options]
        cells = [
            f"`{row.name}`",
            ", ".join(flags),
            "yes" if row.auto else "no",
            f"{row.download_gb:g} GB" if row.download_gb else "",
            row.licence,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    written = (REFERENCE / "backends.md").read_text("utf-8")
    return re.sub(
        r"(?m)^\| back end \| options of its own(?:.*\n\|)*.*$", lambda _: "\n".join(lines), written
    )


FINDINGS = """\
# Findings

`calibration.json`, and `cameras.json` for each further camera, list `findings` as data, strongest first.
The `verdict` is that of the strongest:

| severity | verdict | exit status |
|---|---|---|
| `rejects` | rejected | 3 |
| `warns` | accepted; of the kind `requirement not met`: accepted, but not as exact as needed | 0; 3 |
| `informs` | accepted | 0 |

Among findings of one severity, causes come before their consequences. Fields of a finding:

| field | meaning |
|---|---|
| `kind` | one of the kinds below; programs read this field, not the sentence |
| `images`, `joints` | images and joints (the first joint is 1) that it concerns; empty where it concerns all or none |
| `value`, `std` | size with its standard deviation, in the unit given below |
| `p` | chance of this value or a larger one without a fault |
| `shift` | change of the calibration if the fault were modelled, in the order of `uncertainty.order`; its \
outer product is part of the covariance and of `uncertainty.budget.faults` |
| `intrinsics_shift` | the same for the intrinsics, in the order of `uncertainty.joint.order`; null where \
only the transform changes |
| `concerns` | what the remedy changes: `reconstruction`, `motion`, `images`, `intrinsics`, `poses`, \
`mount`, `robot` or `none` |
| `details` | further numbers in m, rad, px or shares of 1, and names |
| `text`, `remedy` | one sentence each, made of the other fields |

`warnings`, `notes`, `converged` and `observability.advice` are made of the findings. Below,
each kind has its message, with … for numbers and names."""
"""Introduction of the page of the findings."""


def findings_page() -> str:
    """Return the page of the findings: the introduction, then each kind from its row of the table."""
    parts = [FINDINGS]
    for group, title in GROUPS.items():
        parts += ["", f"## {title}"]
        for kind in FindingKind:
            if kind.row.group == group:
                parts += ["", f"### `{kind}`", "", *_about_kind(kind.row)]
    return "\n".join(parts) + "\n"


def _blanked(template: str) -> str:
    """Return a template with … for its fields, the inner ones first."""
    while (shorter := re.sub(r"{[^{}]*}", "…", template)) != template:
        template = shorter
    return template


UNITS = {"{mm": "m", "{deg": "rad", "{percent": "share of 1", "{value": "as in the message"}
"""Units of `value` by the field of the message that states it."""


def _about_kind(row: KindRow) -> Iterator[str]:
    if isinstance(row.message, str) and row.message != "{text}":
        yield f"> {_blanked(row.message)}\n"
    unit = next((unit for field, unit in UNITS.items() if field in row.message), "")
    yield from (f"- **{name}**: {text}." for name, text in (("Means", row.means), ("`value`", unit)) if text)
    advice = row.help or (row.remedy if isinstance(row.remedy, str) else "")
    if advice:
        yield f"- **Remedy**: {_blanked(advice)}."
    if row.explains:
        yield f"- **Explains**: {', '.join(f'`{name}`' for name in row.explains)}."


PAGES = {
    "api.md": api_page,
    "backends.md": backends_page,
    "cli.md": cli_page,
    "findings.md": findings_page,
    "formats.md": formats_page,
}
"""Functions that write each page."""

if __name__ == "__main__":
    write_pages()
