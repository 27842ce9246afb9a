"""Public functions and classes describe their parameters and results, and numeric constants of
modules have a comment with their source or reason.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchsar

PACKAGE = Path(torchsar.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
# a command, a config section or a factory of `study` is described where its keys are listed
LIBRARY = [path for path in MODULES if "study" not in path.relative_to(PACKAGE).parts]
Definition = ast.FunctionDef | ast.ClassDef


def label(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def public(tree: ast.Module) -> Iterator[Definition]:
    """Definitions at the top of a module whose names have no leading underscore."""
    for node in tree.body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield node


def names_of(arguments: ast.arguments) -> list[str]:
    """Names of all parameters of a function, without `self`."""
    found = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return [a.arg for a in (*found, arguments.vararg, arguments.kwarg) if a is not None and a.arg != "self"]


def parameters(node: Definition) -> list[str]:
    """Parameters of a function or of the own constructor of a class, or fields of a dataclass."""
    if isinstance(node, ast.FunctionDef):
        return names_of(node.args)
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            return names_of(item.args)
    if not any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        return []
    fields = [item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
    hidden = ("ClassVar", "init=False")
    return [ast.unparse(f.target) for f in fields if not any(word in ast.unparse(f) for word in hidden)]


def section(docstring: str, name: str) -> str:
    """Indented lines below the heading of a section."""
    found = re.search(rf"^{name}:\n((?:[ \t]+.*\n|\n)*)", docstring + "\n", re.MULTILINE)
    return found[1] if found else ""


def missing(node: Definition) -> Iterator[str]:
    """What the docstring of a definition leaves out."""
    docstring = inspect.cleandoc(ast.get_docstring(node) or "")
    if not docstring:
        yield "a docstring"
    described = section(docstring, "Args")
    for name in parameters(node):
        if not re.search(rf"^ +(?:[\w*, ]+, )?\*{{0,2}}{name}(?:, [\w*, ]+)?:", described, re.MULTILINE):
            yield f"the parameter {name}"
    returned = node.returns if isinstance(node, ast.FunctionDef) else None
    if returned and ast.unparse(returned) != "None" and not re.search("^(Returns|Yields):$", docstring, re.MULTILINE):
        yield "Returns"


def test_public_names_describe_parameters_and_results() -> None:
    found = [
        f"{label(path)}:{node.lineno} {node.name}: {what}"
        for path in LIBRARY
        for node in public(ast.parse(path.read_text(encoding="utf-8")))
        for what in missing(node)
    ]
    assert not found, "docstrings lack\n" + "\n".join(found)


WITH_EXAMPLES = [path for path in LIBRARY if ">>>" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=label)
def test_examples_run(path: Path) -> None:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    module = importlib.import_module(".".join(parts if parts[-1] != "__init__" else parts[:-1]))
    found = doctest.testmod(module)
    assert found.attempted and not found.failed, "what the example printed stands above, under `Got`"


FACES = ("core", "radar", "scene", "echo", "repair", "compensate", "multichannel", "focus", "metrics", "optim", "io")


def test_every_public_name_has_an_example() -> None:
    """A stage and its function need one between them; values such as `LIGHT_M_S` need none."""
    found: dict[str, bool] = {}
    for face in (importlib.import_module(f"torchsar.{name}") for name in FACES):
        for name in face.__all__:
            value = getattr(face, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                idea = f"{face.__name__}.{name.replace('_', '').lower()}"
                found[idea] = found.get(idea, False) or ">>>" in (inspect.getdoc(value) or "")
    bare = [idea for idea, shown in found.items() if not shown]
    assert not bare, f"{bare} need an example (>>>) in the docstring of the function, or in that of the stage"


def constant(node: ast.stmt) -> ast.expr | None:
    """The value of a statement that assigns to names in capitals."""
    if not isinstance(node, ast.Assign | ast.AnnAssign):
        return None
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [item.id for target in targets for item in ast.walk(target) if isinstance(item, ast.Name)]
    return node.value if all(name.isupper() for name in names) else None


def holds_number(value: ast.AST) -> bool:
    """Whether a value is made of numbers; a mapping to objects names its numbers by its keys."""
    if isinstance(value, ast.Dict):
        return any(holds_number(item) for item in value.values if not isinstance(item, ast.Call | ast.Lambda))
    return any(isinstance(item, ast.Constant) and type(item.value) in (int, float) for item in ast.walk(value))


def unexplained(text: str) -> list[int]:
    """Lines of numeric constants without a comment on them, above them, or above the block of
    constants that they stand in.
    """
    lines, found, explained, end = text.splitlines(), [], False, 0
    for node in ast.parse(text).body:
        value = constant(node)
        if value is not None:
            last = node.end_lineno or node.lineno
            own = any("  # " in line for line in lines[node.lineno - 1 : last])
            above = node.lineno > 1 and lines[node.lineno - 2].startswith("# ")
            explained = own or above or (explained and node.lineno == end + 1)
            end = last
            if holds_number(value) and not explained:
                found.append(node.lineno)
    return found


def test_constants_have_a_source_or_a_reason() -> None:
    found = [f"{label(path)}:{line}" for path in MODULES for line in unexplained(path.read_text(encoding="utf-8"))]
    assert not found, "constants without a comment\n" + "\n".join(found)


def test_the_checks_find_what_they_look_for() -> None:
    bare = ast.parse('def f(a: int, b: int) -> int:\n    """Sum.\n\n    Args:\n        a: One.\n    """\n')
    assert [what for node in public(bare) for what in missing(node)] == ["the parameter b", "Returns"]
    record = ast.parse(
        '@dataclass(frozen=True)\nclass C:\n    """Kept.\n\n    Args:\n        x, y: Two.\n    """\n    z: int\n'
    )
    assert [what for node in public(record) for what in missing(node)] == ["the parameter z"]
    assert unexplained("A = 1\n# why\nB, C = 2, 3\nD = 4\n\nE = 5\nNAME = 'text'\n_TABLE = {'a': 1.0}  # why\n") == [
        1,
        6,
    ]
