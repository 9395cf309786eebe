"""Plain data (maps, lists, numbers, texts) of YAML, JSON and OpenCV's FileStorage, without objects and references."""

import io
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import yaml

from jcr.capture.documents.table import MAX_ITEMS, cell_of, decode_text, read_limited
from jcr.errors import InputError, shown

MAX_DEPTH = 32
"""Largest depth of nested lists and maps; a pose in a message of ROS is at depth 6."""
_SYNTAXES = {
    **dict.fromkeys((".json", ".jsonl"), "JSON"),
    **dict.fromkeys((".yaml", ".yml", ".calib", ".samples"), "YAML"),
    ".xml": "XML",
}
_STARTS = {
    "XML": re.compile(r"\s*<(?:\?xml|opencv_storage)"),
    "JSON": re.compile(r'\s*(?:\{\s*"|\[\s*\{)'),
    "YAML": re.compile(r"%YAML|---\s*\n|(?:- )?\w+:[ \t\r]*\n\s+(?:- )?\w+:\s"),
}
"""First characters of a text in each syntax, whatever the ending of the file is."""
_CONSTANTS = {
    "": None, "~": None, "null": None, "true": True, "false": False,
    ".nan": math.nan, ".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf,
}  # fmt: skip


def read_content(file: Path) -> Any:
    """Read the nested data of a YAML, JSON or XML file: dict, list, float, str, bool, None.

    Several documents in a file become a list. Integers of more than 15 digits are texts. A matrix of OpenCV, and any
    map with rows, cols and data, becomes a list of rows, or a flat list if the matrix has one row or column. Raises
    InputError for other syntax, references, duplicate keys, and content that is too large or nested too deeply.
    """
    text = decode_text(file, read_limited(file))
    syntax = syntax_of(file, text)
    if syntax is None:
        raise InputError(f"{file}: not YAML, JSON or OpenCV's XML; name such a file")
    return parse_content(file, text, syntax)


def syntax_of(file: Path, text: str) -> str | None:
    """Return "JSON", "YAML" or "XML" by the first characters of the text or the ending of the file; None for others."""
    begins = (name for name, start in _STARTS.items() if start.match(text))
    return _SYNTAXES.get(file.suffix.lower()) or next(begins, None)


def parse_content(file: Path, text: str, syntax: str) -> Any:
    """Return the nested data of a text in the syntax "JSON", "YAML" or "XML"; raise InputError as read_content."""
    parse = {"JSON": _parse_json, "YAML": _parse_yaml, "XML": _parse_xml}[syntax]
    try:
        documents = [one for one in parse(file, text) if one is not None]
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}" if mark else ""
        _refuse(file, f"not YAML{place} ({str(getattr(error, 'problem', ''))[:80]}); correct it there")
    except json.JSONDecodeError as error:
        _refuse(file, f"not JSON at line {error.lineno}, column {error.colno} ({error.msg}); correct it")
    except RecursionError:
        _refuse(file, f"nested deeper than {MAX_DEPTH}; give a list of poses")
    return documents[0] if len(documents) == 1 else documents or None


def _refuse(file: Path, fault: str) -> NoReturn:
    """Raise InputError with the fault of a file."""
    raise InputError(f"{file}: {fault}") from None


def _limit(file: Path, items: int, depth: int) -> None:
    """Raise InputError if nested data has too many items or is too deep."""
    if items > MAX_ITEMS:
        _refuse(file, f"more than {MAX_ITEMS:,} values; give the poses alone")
    if depth > MAX_DEPTH:
        _refuse(file, f"nested deeper than {MAX_DEPTH}; give a list of poses")


def _parse_json(file: Path, text: str) -> list[Any]:
    """Return the values of a text of JSON: one, or several one after another (JSON lines)."""

    def to_map(pairs: list[tuple[str, Any]]) -> Any:
        return _map_of(file, pairs)

    def require_depth(value: Any, depth: int) -> None:
        _limit(file, 0, depth)
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            require_depth(part, depth + 1)

    _limit(file, max(sum(map(text.count, ",[{")), text.count("\n")), 0)
    decoder = json.JSONDecoder(object_pairs_hook=to_map, parse_int=cell_of, parse_float=cell_of)
    values, end, text = list[Any](), 0, text.strip()
    while end < len(text):
        value, end = decoder.raw_decode(text, end)
        require_depth(value, 0)
        values.append(value)
        _limit(file, len(values), 0)
        while end < len(text) and text[end].isspace():
            end += 1
    return values


def _parse_yaml(file: Path, text: str) -> list[Any]:
    """Return the documents of a text of YAML, built from its events, so that no tag constructs an object."""
    text = re.sub(r"\A\s*%YAML:.*", "", text).expandtabs()  # OpenCV's header is no directive of YAML
    documents, open_nodes = list[Any](), list[list[Any]]()
    for items, event in enumerate(yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))):
        _limit(file, items // 2, len(open_nodes))
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            line = event.start_mark.line + 1
            _refuse(file, f"line {line} has an anchor or alias of YAML (& or *); write the values in place")
        if "python/object" in (getattr(event, "tag", None) or ""):
            _refuse(file, "holds Python objects; save lists of numbers, yaml.safe_dump(poses.tolist(), file)")
        if isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append([isinstance(event, yaml.MappingStartEvent)])
            continue
        if isinstance(event, yaml.ScalarEvent):
            value = event.value if event.style in ("'", '"') else _scalar(event.value)
            is_key = bool(open_nodes) and open_nodes[-1][0] and len(open_nodes[-1]) % 2
            value = event.value if is_key else value
        elif isinstance(event, yaml.CollectionEndEvent):
            is_map, *parts = open_nodes.pop()
            value = _map_of(file, list(zip(parts[::2], parts[1::2], strict=True))) if is_map else parts
        else:
            continue
        (open_nodes[-1] if open_nodes else documents).append(value)
    return documents


def _scalar(text: str) -> Any:
    """Return a plain scalar of YAML as None, truth value, number or text."""
    return _CONSTANTS[text.lower()] if text.lower() in _CONSTANTS else cell_of(text)


def _parse_xml(file: Path, text: str) -> list[Any]:
    """Return the content of a FileStorage of OpenCV in XML, in a list; raise InputError for other XML."""
    root = root_of_xml(file, text)
    if root.tag != "opencv_storage":
        _refuse(file, "XML that is not OpenCV's FileStorage; give the numbers as YAML or CSV")
    return [_element(file, root)]


def root_of_xml(file: Path, text: str) -> ElementTree.Element:
    """Return the root of a text of XML; raise InputError for document types, entities, bad syntax, size and depth."""
    if "<!DOCTYPE" in text.upper() or "<!ENTITY" in text.upper():
        _refuse(file, "XML with a document type or entities; remove them")
    _limit(file, text.count("<") + len(text.split()), 0)
    depth, elements = 0, list[ElementTree.Element]()
    try:
        for event, element in ElementTree.iterparse(io.BytesIO(text.encode()), ("start", "end")):  # nosec B314: no entities
            elements = elements or [element]
            depth += 1 if event == "start" else -1
            _limit(file, 0, depth)
    except ElementTree.ParseError as error:
        _refuse(file, f"not XML ({str(error)[:80]}); correct it there")
    return elements[0]


def _element(file: Path, element: ElementTree.Element) -> Any:
    """Return the content of an element of OpenCV's XML."""
    if len(element):
        children = [_element(file, child) for child in element]
        if all(child.tag == "_" for child in element):
            return children
        return _map_of(file, list(zip((child.tag for child in element), children, strict=True)))
    text = (element.text or "").strip()
    cells = [_scalar(part) for part in text.split()]
    if len(cells) > 1 and not any(isinstance(cell, str) for cell in cells):
        return cells
    parts = re.findall(r'"([^"]*)"', text)
    return parts if len(parts) > 1 else parts[0] if parts else _scalar(text)


def _map_of(file: Path, pairs: Sequence[tuple[Any, Any]]) -> Any:
    """Return key and value pairs as a dictionary, or as nested lists if they state shape and data of a matrix."""
    content = dict[str, Any]()
    for key, value in pairs:
        if not isinstance(key, str) or key == "<<":
            _refuse(file, "has a merge key or a key that is no text; write the values in place")
        if key in content:
            _refuse(file, f"the key {shown(key)} appears twice in one map; keep one")
        content[key] = value
    shape = content.get("sizes") or [content.get("rows"), content.get("cols")]
    data = content.get("data")
    if isinstance(data, list) and isinstance(shape, list):
        sizes = [int(size) for size in shape if isinstance(size, float) and 1 <= size <= MAX_ITEMS]
        return (_nested(data, sizes) if len(sizes) == len(shape) else None) or content
    return content


def _nested(data: Iterable[Any], shape: Sequence[int]) -> list[Any] | None:
    """Return numbers as nested lists of a shape without its sides of length 1; None if their number does not fit."""
    flat = [cell for row in data for cell in (row if isinstance(row, list) else [row])]
    sides = [side for side in shape if side > 1]
    if not flat or len(flat) % math.prod(sides):
        return None
    if (channels := len(flat) // math.prod(sides)) > 1:
        sides.append(channels)
    for side in reversed(sides[1:]):
        flat = [flat[k : k + side] for k in range(0, len(flat), side)]
    return flat
