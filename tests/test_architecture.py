"""Imports between the packages of jcr go downwards only; the contracts are in pyproject.toml."""

from importlinter.cli import lint_imports

from places import ROOT


def test_imports_keep_the_contracts():
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0
