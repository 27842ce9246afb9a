"""Draw passages of the pages, docstrings and error messages at random, for a reader to judge.

Each should be understood at first reading by somebody who knows radar but not this project.

    python scripts/random_passages.py --count 10 --seed 7
"""

from __future__ import annotations

import argparse
import ast
import random
import textwrap
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# shorter texts say too little to be judged
LEAST_CHARACTERS = 60


def pages() -> Iterator[tuple[str, str]]:
    """(where, text) of every paragraph of the README and of the documentation that is prose."""
    for path in (
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("[a-z]*/*.md")),
        *sorted((ROOT / "docs").glob("*.md")),
    ):
        yield from paragraphs(path)


def paragraphs(path: Path) -> Iterator[tuple[str, str]]:
    """(where, text) of every paragraph of a page that is prose."""
    code, section = False, ""
    for part in path.read_text(encoding="utf-8").split("\n\n"):
        opens = part.count("```") % 2 == 1
        if part.startswith("#") and not code:
            section = part.splitlines()[0].lstrip("# ")
        elif not (code or opens or part.startswith(("|", "    ", "![", "```", "$$", ":::", "---"))):
            yield f"{path.relative_to(ROOT)}, section {section!r}", part
        code = code ^ opens


def docstrings(path: Path, tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(where, text) of the docstrings of a module and of its public classes and functions; a
    function has its signature in front, as in `help`.
    """
    for name, node in [("module", tree), *public(tree)]:
        text = ast.get_docstring(node)
        if text:
            yield f"{path.relative_to(ROOT)}: {name}", f"{signature(node)}{text}"


def public(
    tree: ast.Module | ast.ClassDef, above: str = ""
) -> Iterator[tuple[str, ast.Module | ast.ClassDef | ast.FunctionDef]]:
    """(qualified name, node) of public classes and functions, without those of private classes."""
    for node in tree.body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_"):
            yield f"{above}{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public(node, f"{above}{node.name}.")


def signature(node: ast.AST) -> str:
    """The line `name(arguments) -> result` of a function, and nothing for others."""
    if not isinstance(node, ast.FunctionDef):
        return ""
    result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{node.name}({ast.unparse(node.args)}){result}\n\n"


def errors(path: Path, tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(where, text) of the messages of exceptions; what is filled in stands in braces."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            for argument in node.exc.args:
                if isinstance(argument, ast.JoinedStr) or isinstance(getattr(argument, "value", None), str):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", message(argument)


def message(node: ast.expr) -> str:
    """The text of a string or of an f-string."""
    if isinstance(node, ast.JoinedStr):
        return "".join(message(part) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return f"{{{ast.unparse(node.value)}}}"
    assert isinstance(node, ast.Constant)
    return str(node.value)


def passages() -> dict[str, list[tuple[str, str]]]:
    """(where, text) of everything that may be drawn, by kind."""
    files = [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in sorted((ROOT / "torchsar").rglob("*.py"))]
    found = {
        "page": list(pages()),
        "docstring": [one for path, tree in files for one in docstrings(path, tree)],
        "error": [one for path, tree in files for one in errors(path, tree)],
    }
    return {kind: [one for one in all_ if len(one[1]) >= LEAST_CHARACTERS] for kind, all_ in found.items()}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    options.add_argument("--count", type=int, default=10, help="passages to draw")
    options.add_argument("--seed", type=int, default=random.randrange(10**6), help="seed of the draw (printed)")
    given = options.parse_args()
    kinds, draw = passages(), random.Random(given.seed)
    print(f"seed {given.seed}")
    for number in range(1, given.count + 1):
        kind = draw.choice(sorted(kinds))
        where, text = draw.choice(kinds[kind])
        print(f"\n--- {number}. {kind}, {where}\n{textwrap.indent(text, '    ')}")


if __name__ == "__main__":
    main()
