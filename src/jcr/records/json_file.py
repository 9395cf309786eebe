"""Reading of JSON files of this program, and validation of plain data by a schema."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from jcr.errors import InputError, first_fault, shown
from jcr.files import read_bytes

MAX_JSON = 32_000_000
"""Largest number of characters of a JSON file; a capture of 1000 images needs 1 % of it."""


def read_json(file: Path) -> Any:
    """Read a JSON file; raise InputError if it is missing, too large, no UTF-8 JSON, or has a key twice in an object."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            key = Counter(key for key, _ in pairs).most_common(1)[0][0]
            raise InputError(f"{file}: the key {shown(key)} appears twice in one object; keep one")
        return content

    try:
        text = read_bytes(file).decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); name a file that is there") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    if len(text) > MAX_JSON:
        raise InputError(f"{file}: {len(text) / 1e6:.0f} MB; {MAX_JSON // 1_000_000} MB at most")
    try:
        return json.loads(text, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{file}: not JSON at line {error.lineno}, column {error.colno}: {error.msg}; correct it"
        ) from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # a number of thousands of digits
        raise InputError(f"{file}: invalid number, or too deep ({str(error)[:80]}); correct it") from None


def validated_content(schema: type[BaseModel] | TypeAdapter, content: Any, where: str) -> Any:
    """Return the content of a file, converted by the pydantic model or type adapter `schema`.

    Raises InputError if the content does not fit.
    """
    validate = schema.validate_python if isinstance(schema, TypeAdapter) else schema.model_validate
    try:
        return validate(content)
    except ValidationError as error:
        # The message of a check of the schema has its remedy already.
        remedy = "" if error.errors()[0]["type"] == "value_error" else "; correct it there"
        raise InputError(f"{where}: {first_fault(error)}{remedy}") from None
