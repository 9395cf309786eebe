"""Whether a page of results is older than the code that it measures: by git, and by what the code computes."""

import ast
import re
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from jcr.errors import InputError

CHECKOUT = Path(__file__).parents[1]
PAGES = CHECKOUT / "docs" / "results"
COMMIT = re.compile(r"(?:commit|ommitted with) `([0-9a-f]{7,40})\+?`")
OLD = "**Older than the code that it measures**:"
"""Begins the line of a page that says so."""
AT_MOST = 6
"""Files that the line names."""


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=CHECKOUT, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"git {' '.join(arguments[:2])}: {done.stderr.strip() or 'failed'}")
    return done.stdout.strip()


def has_history() -> bool:
    """Whether git can tell what changed when: not in a shallow clone, nor in a source without its repository."""
    try:
        return _git("rev-parse", "--is-shallow-repository") == "false"
    except (InputError, OSError):
        return False


def commit_now(paths: Sequence[str]) -> str:
    """The commit that is checked out, as a page states it; with a + where files under `paths` differ from it."""
    try:
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", *paths)
        return f"commit `{_git('rev-parse', '--short', 'HEAD')}{'+' if changed else ''}`"
    except (InputError, OSError):
        return "commit not known"


def commit_of(page: Path) -> str:
    """The commit that a page names, or, where history does not have it, the one that last changed the page."""
    named = COMMIT.search(page.read_text())
    if named:
        try:
            return _git("rev-parse", "--verify", "--quiet", f"{named[1]}^{{commit}}")
        except InputError:
            pass
    found = _git("log", "-1", "--format=%H", "--", str(page))
    if not found:
        raise InputError(f"{page}: names no commit, and git knows none of it")
    return found


def changed_since_measured(page: Path, paths: Sequence[str], at_most: int | None = None) -> list[str]:
    """Files under `paths` that compute something else than at the commit of the page; `at_most` this many.

    What a file says is no difference: comments, docstrings, and texts of more than one word.
    """
    commit = commit_of(page)
    found = []
    for line in _git("diff", "--raw", "--no-renames", "--abbrev=40", commit, "--", *paths).splitlines():
        about, name = line.split("\t", 1)
        _, _, before, _, _ = about.split()
        if not name.endswith(".py") or _differs(before, CHECKOUT / name):
            found.append(name)
        if at_most is not None and len(found) >= at_most:
            break
    return found


def _differs(before: str, now: Path) -> bool:
    if not now.exists() or set(before) == {"0"}:
        return True
    return _essence_of_blob(before) != essence(now.read_text(encoding="utf-8"))


@cache
def _essence_of_blob(blob: str) -> str:
    return essence(_git("cat-file", "blob", blob))


@cache
def essence(source: str) -> str:
    """A Python file without what it says."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            lines = getattr(node, name, None)
            if isinstance(lines, list):
                setattr(node, name, [line for line in lines if not _is_text(line)])
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            node.value = " "
    return ast.dump(tree)


def _is_text(line: ast.stmt) -> bool:
    return (
        isinstance(line, ast.Expr)
        and isinstance(line.value, ast.Constant)
        and isinstance(line.value.value, str)
    )


def is_marked_old(text: str) -> bool:
    """Whether a page has the line."""
    return any(line.startswith(OLD) for line in text.splitlines())


def marked(text: str, changed: Sequence[str]) -> str:
    """The text of a page with that line below the one that names its commit, or without it where nothing changed."""
    lines = text.splitlines()
    if is_marked_old(text):
        at = next(i for i, line in enumerate(lines) if line.startswith(OLD))
        del lines[at : at + 2]
    if changed:
        named = ", ".join(f"`{name}`" for name in changed[:AT_MOST])
        more = f" and {len(changed) - AT_MOST} more" if len(changed) > AT_MOST else ""
        at = next(i for i, line in enumerate(lines) if COMMIT.search(line))
        lines[at + 1 : at + 1] = ["", f"{OLD} {named}{more} changed since."]
    return "\n".join(lines) + "\n"
