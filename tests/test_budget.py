"""The sizes of the package stay within `budget.toml`.

A change that needs more raises a number there, in a commit that says why.
"""

from __future__ import annotations

import ast
import importlib
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import torchsar

PACKAGE = Path(torchsar.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
BUDGET = tomllib.loads((Path(__file__).parent / "budget.toml").read_text(encoding="utf-8"))
FACES = ("core", "radar", "scene", "echo", "repair", "compensate", "multichannel", "focus", "metrics", "optim", "io")


def room(path: Path) -> str:
    """Name of the package of a module, "top" for those that stand beside the packages; the
    benchmarks of `study`, most of which are scenes, are a room of their own.
    """
    parts = path.relative_to(PACKAGE).parts
    if parts[:2] == ("study", "bench"):
        return "bench"
    return parts[0] if len(parts) > 1 else "top"


def statements() -> Counter[str]:
    """Number of statements by room, those in blocks included."""
    found: Counter[str] = Counter()
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found[room(path)] += sum(isinstance(node, ast.stmt) for node in ast.walk(tree))
    return found


def is_number(value: Any) -> bool:
    """Whether a value is a number or a tuple of numbers."""
    if isinstance(value, tuple):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, int | float | complex) and not isinstance(value, bool)


def bound_names(path: Path) -> set[str]:
    """Names that a module binds by an assignment at its top."""
    found: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        found |= {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    return found


def numbers() -> list[str]:
    """Module names that are bound to a number or a tuple of numbers."""
    found = []
    for path in MODULES:
        if path.name == "__main__.py":
            continue
        name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        module = importlib.import_module(name)
        found += [f"{name}.{bound}" for bound in bound_names(path) if is_number(getattr(module, bound, None))]
    return found


def ideas() -> set[str]:
    """Public names of all faces, of which a stage and its function count as one."""
    faces = [torchsar, *(importlib.import_module(f"torchsar.{name}") for name in FACES)]
    return {name.replace("_", "").lower() for face in faces for name in face.__all__}


RAISE = "make it smaller, or raise the number in tests/budget.toml and say why in the commit"


def test_every_room_keeps_its_number_of_statements() -> None:
    found = statements()
    assert set(found) == set(BUDGET["statements"])
    over = {n: f"{found[n]} statements, of {most}" for n, most in BUDGET["statements"].items() if found[n] > most}
    assert not over, f"{over}: {RAISE}"


def test_constants_and_public_names_are_few() -> None:
    assert len(numbers()) <= BUDGET["numbers"], f"{sorted(numbers())}: {RAISE}"
    assert len(ideas()) <= BUDGET["public_names"], (
        f"{len(ideas())} public names, of {BUDGET['public_names']} at most: a new name needs one that goes, and a "
        "function that a package alone uses stays out of its __all__"
    )


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_file_is_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= BUDGET["lines_of_a_file"], "split it"
