"""Packages that only some formats need."""

from importlib import import_module
from types import ModuleType

from jcr.errors import InputError


def extra(module: str, name: str, what: str) -> ModuleType:
    """The module, or an InputError that says which extra of jcr brings it."""
    try:
        return import_module(module)
    except ImportError:
        raise InputError(
            f"reading {what} needs a package that is missing: pip install 'jcr[{name}]'"
        ) from None
