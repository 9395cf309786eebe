"""Imports run one way: read from the source, so that a shortcut is found on the day it is taken."""

import ast
import re
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from places import ROOT

SOURCE = ROOT / "src" / "jcr"
LAYERS = [
    {"deflate", "errors"},
    {"compiled", "extras", "options"},
    {"distributions", "pages", "rounding", "geometry"},
    {"records", "files", "memory", "progress"},
    {"arrays_json", "camera", "least_squares"},
    {"intrinsics_json"},
    {"estimation"},
    {"capture"},
    {"match"},
    {"reconstruct"},
    {"depth"},
    {"calibration"},
    {"cell"},
    {"represent", "segment"},
    {"attempts", "check"},
    {"run_folder"},
    {"results"},
    {"export"},
    {"mapping", "report"},
    {"stages"},
    {"pipeline"},
    {"live"},
    {"batch", "touch_test", "verify"},
    {"view"},
    {"cli"},
    {"__main__"},
]
LEVEL = {package: level for level, packages in enumerate(LAYERS) for package in packages}
TORCH_PACKAGES = {"match", "reconstruct", "represent", "segment"}
BACK_ENDS = ["backends", "from_pairs", "colmap", "marker", "predictions"]
SOLVERS = [
    "least_squares",
    *(
        f"estimation.{name}"
        for name in (
            "closed_form",
            "fit",
            "hand_eye",
            "images",
            "known_scale",
            "residuals",
            "robust",
            "together",
        )
    ),
    *(f"cell.{name}" for name in ("carried", "localise", "stage")),
    *(
        f"calibration.{name}"
        for name in ("adjust", "case", "checks", "cues", "drift", "fit", "poses", "stage", "verdict")
    ),
    *(f"depth.{name}" for name in ("dense", "densify", "fused", "matched", "patch_match", "priors")),
    *(f"reconstruct.{name}" for name in ("colmap", "direct", "relocate", "sfm")),
]
FORBIDDEN = {
    "reconstruct.global_alignment": ["dust3r", "direct", "views_at_once", *BACK_ENDS],
    "reconstruct.direct": ["dust3r", "global_alignment", "views_at_once", *BACK_ENDS],
    "report": SOLVERS,
    "cli": SOLVERS,
}
"""What a part must not import, by names beside it or from the top; estimation has a rule of its own."""


def module_name(file: Path) -> str:
    parts = file.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for file in SOURCE.rglob("*.py")}


def named(node: ast.Import | ast.ImportFrom) -> list[str]:
    """The modules that a statement imports, where `from a import b` may name a module b or what is in a."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    assert node.module and not node.level, "imports are absolute"
    inside = [f"{node.module}.{alias.name}" for alias in node.names]
    return [module if module in FILES else node.module for module in inside]


@cache
def imports(file: Path) -> list[str]:
    statements = ast.walk(ast.parse(file.read_text()))
    return [
        name for node in statements if isinstance(node, ast.Import | ast.ImportFrom) for name in named(node)
    ]


def package(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def test_every_space_has_its_layer():
    packages = {package(file) for file in SOURCE.rglob("*.py")} - {"__init__"}
    assert packages == set(LEVEL)


def test_imports_run_one_way():
    against = []
    for file in SOURCE.rglob("*.py"):
        mine = package(file)
        if mine == "__init__":
            continue
        for module in imports(file):
            if not module.startswith("jcr."):
                continue
            other = module.split(".")[1]
            if other != mine and LEVEL[other] >= LEVEL[mine]:
                against.append(f"{file.relative_to(SOURCE)} imports {module}")
    assert not against


def is_under(module: str, parent: str) -> bool:
    return module == parent or module.startswith(parent + ".")


@pytest.mark.parametrize("part", FORBIDDEN)
def test_parts_of_packages_do_not_know_one_another(part: str):
    above = part.rpartition(".")[0]
    forbidden = [".".join(filter(None, ("jcr", above, name))) for name in FORBIDDEN[part]]
    assert not [name for name in forbidden if not any(is_under(module, name) for module in FILES)]
    against = [
        f"{module} imports {other}"
        for module, file in FILES.items()
        if is_under(module, f"jcr.{part}")
        for other in imports(file)
        if any(is_under(other, name) for name in forbidden)
    ]
    assert not against


def test_hand_eye_calibration_takes_arrays_and_gives_arrays():
    known = {"jcr", "jaxtyping", "numpy", "scipy"}
    files = {"io", "json", "os", "pathlib", "pickle", "shutil", "tempfile"}
    against = [
        f"{module} imports {other}"
        for module, file in FILES.items()
        if is_under(module, "jcr.estimation")
        for other in imports(file)
        if (root := other.split(".")[0]) in files or root not in known | sys.stdlib_module_names
    ]
    assert not against


PUBLIC = "jcr"
"""The package itself names what the modules below it offer, and they ask it for the version: no circle of ideas."""


def test_no_module_knows_a_module_that_knows_it():
    """Imports within functions count, and those that only type checkers read: both are knowledge of the other."""
    graph = {
        module: (set(imports(file)) & set(FILES)) - {module, PUBLIC}
        for module, file in FILES.items()
        if module != PUBLIC
    }
    assert sum(map(len, graph.values())) > len(FILES), "the imports are read"
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_torch_stays_where_networks_are():
    outside = [
        str(file.relative_to(SOURCE))
        for file in SOURCE.rglob("*.py")
        if any(module.split(".")[0] == "torch" for module in imports(file))
        and package(file) not in TORCH_PACKAGES
    ]
    assert not outside


POSITIONAL = {"Intrinsics"}
"""fx, fy, cx, cy, width, height: public, in the order of every library."""


def test_records_of_five_fields_and_more_are_made_by_name():
    by_place = {}
    for module, file in FILES.items():
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef) and any(
                ast.unparse(one).startswith("dataclass") and "kw_only=True" not in ast.unparse(one)
                for one in node.decorator_list
            ):
                fields = [one for one in node.body if isinstance(one, ast.AnnAssign)]
                types = [ast.unparse(one.annotation) for one in fields]
                by_place[f"{module}.{node.name}"] = (*types, "KW_ONLY").index("KW_ONLY")
    assert len(by_place) > 100, "the records are read"
    assert {name.rpartition(".")[2] for name, count in by_place.items() if count >= 5} == POSITIONAL


def test_pages_are_made_by_templates_that_escape():
    """HTML in an f-string is a place where a name of a file becomes markup."""
    tag = re.compile(r"</?(a|b|button|div|form|i|img|li|p|script|span|svg|table|td|th|tr|ul)[ >]")
    assert tag.search('<td class="x">'), "the pattern finds a tag"
    against = [
        f"{module}:{node.lineno}"
        for module, file in FILES.items()
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.JoinedStr) and tag.search("".join(map(ast.unparse, node.values)))
    ]
    assert not against
