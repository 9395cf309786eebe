"""Every extra that a message or a page names is one of the distribution."""

import re
import sys
import tomllib

import pytest

from jcr.errors import InputError
from jcr.extras import DISTRIBUTION, extra
from places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_extras_that_are_named_exist():
    assert PROJECT["name"] == DISTRIBUTION
    named = set()
    for folder in ("src", "benchmarks", "docs", "examples"):
        for file in (one for one in (ROOT / folder).rglob("*.*") if one.suffix in (".py", ".md")):
            text = file.read_text()
            assert not re.search(r"pip\s+install\s+'?jcr\b(?!-)", text), file
            several = ",".join(re.findall(rf"{DISTRIBUTION}\[([\w,]+)\]", text)).split(",")
            every = [*re.findall(r'\bextra\("[\w.]+", "(\w+)"', text), *filter(None, several)]
            named |= {(name, file.name) for name in every}
    assert {name for name, _ in named} >= {"networks", "view", "sam", "ros", "lerobot", "planning"}
    assert not {(name, file) for name, file in named if name not in PROJECT["optional-dependencies"]}


def test_the_lowest_versions_are_those_that_are_tested():
    bounds = {}
    for requirement in [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["ros"],
                        *PROJECT["optional-dependencies"]["lerobot"]]:  # fmt: skip
        name, version = re.fullmatch(r"([\w-]+)>=([\d.]+)(?:,.*)?", requirement).groups()
        bounds[name] = version
    pinned = dict(
        line.split("==")
        for line in (ROOT / "constraints-lowest.txt").read_text().splitlines()
        if "==" in line
    )
    assert pinned.keys() == bounds.keys()
    for name, version in bounds.items():
        shortest = re.sub(r"(\.0)+$", "", pinned[name])
        assert shortest == version or pinned[name].startswith(f"{version}.0."), name


def test_a_package_that_is_there_but_broken_reports_why(tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "brokenpackage.py").write_text("raise ImportError('libmissing.so: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"cannot be imported \(libmissing.so: no such file\): pip install"):
        extra("brokenpackage", "view", "the simulation")
    monkeypatch.setitem(sys.modules, "brokenpackage", None)
    with pytest.raises(InputError, match="the simulation needs brokenpackage, which is not installed"):
        extra("brokenpackage", "view", "the simulation")
