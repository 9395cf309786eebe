"""Imports run one way: read from the source, so that a shortcut is found on the day it is taken."""

import ast
from pathlib import Path

from places import ROOT

SOURCE = ROOT / "src" / "jcr"
LAYERS = [
    {"deflate", "errors"},
    {"extras"},
    {"geometry", "records", "files", "memory", "progress", "rounding"},
    {"camera"},
    {"handeye"},
    {"capture"},
    {"reconstruct"},
    {"calibration"},
    {"represent", "segment"},
    {"export"},
    {"simulate"},
    {"attempts", "check", "live"},
    {"run_folder"},
    {"results"},
    {"mapping", "report"},
    {"pipeline"},
    {"batch", "verify"},
    {"view"},
    {"cli"},
    {"__main__"},
]
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
TORCH_ROOMS = {"reconstruct", "represent", "segment"}


def imports(file: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return found


def room(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def test_every_room_has_its_layer():
    rooms = {room(file) for file in SOURCE.rglob("*.py")} - {"__init__"}
    assert rooms == set(LEVEL)


def test_imports_run_one_way():
    against = []
    for file in SOURCE.rglob("*.py"):
        mine = room(file)
        if mine == "__init__":
            continue
        for module in imports(file):
            if not module.startswith("jcr."):
                continue
            other = module.split(".")[1]
            if other != mine and LEVEL[other] >= LEVEL[mine]:
                against.append(f"{file.relative_to(SOURCE)} imports {module}")
    assert not against


def test_torch_stays_where_networks_are():
    outside = [
        str(file.relative_to(SOURCE))
        for file in SOURCE.rglob("*.py")
        if any(module.split(".")[0] == "torch" for module in imports(file)) and room(file) not in TORCH_ROOMS
    ]
    assert not outside
