"""Pages of the API reference: one per package, from its `__all__`, and one per module in it.

Docstrings are plain text with names in single backticks. Here they become reStructuredText: a name
in backticks is a link where it is public, and code elsewhere.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.docutils import SphinxDirective

# packages in the order in which they build on each other
PACKAGES = (
    *("core", "radar", "scene", "echo", "repair", "compensate", "multichannel", "focus"),
    *("metrics", "optim", "io", "data", "datasets", "strips", "study", "reproduce", "plot"),
)
# public in a part of a package, and taken by functions of its face
PARTS = ("compensate.pulse_phase", "compensate.rotation")
# prose of docstrings: everything but names in backticks
MARKS = re.compile(r"(`[^`]*`)|([*|\\]|(?<=\w)_(?!\w))")


def public(package: str) -> list[str]:
    """Public names of a package, or of a module without `__all__`."""
    module = importlib.import_module(f"torchsar.{package}")
    if hasattr(module, "__all__"):
        return sorted(module.__all__, key=str.lower)
    own = [name for name, x in vars(module).items() if getattr(x, "__module__", "") == module.__name__]
    return sorted((name for name in own if not name.startswith("_")), key=str.lower)


def names() -> dict[str, list[str]]:
    """Qualified public names, by package; those of parts stand with their package."""
    found = {package: [f"torchsar.{package}.{name}" for name in public(package)] for package in PACKAGES}
    for part in PARTS:
        package = part.split(".")[0]
        known = public(package)
        found[package] += [f"torchsar.{part}.{name}" for name in public(part) if name not in known]
    return found


def home(qualified: str) -> str:
    """Module that defines a public name; of a constant, the one that its package takes it from."""
    face, name = split(qualified)
    module = getattr(getattr(face, name), "__module__", "")
    if not module.startswith("torchsar."):
        found = re.search(
            rf"from (torchsar\.\S+) import (?:\([^)]*?\b{name}\b|[^\n(]*\b{name}\b)", inspect.getsource(face)
        )
        module = found[1] if found else face.__name__
    return module


def split(qualified: str) -> tuple[ModuleType, str]:
    """Package and name."""
    package, name = qualified.rsplit(".", 1)
    return importlib.import_module(package), name


def first_sentence(qualified: str) -> str:
    """First sentence of the docstring of a class or function, as reStructuredText."""
    face, name = split(qualified)
    obj = getattr(face, name)
    if not (inspect.isclass(obj) or inspect.isfunction(obj)):
        return "See below."
    paragraph = " ".join(inspect.cleandoc(obj.__doc__ or "").split("\n\n")[0].split())
    return escaped(re.split(r"(?<=[.:]) (?=[A-Z])", paragraph)[0])


def escaped(line: str) -> str:
    """A line whose marks mean nothing in reStructuredText, but for names in backticks."""
    return MARKS.sub(lambda found: found[1] or "\\" + found[2], line)


def language(lines: list[str]) -> str:
    """Language of the indented code at the beginning of some lines."""
    depth = len(lines[0]) - len(lines[0].lstrip())
    code = itertools.takewhile(lambda line: not line.strip() or line.startswith(" " * depth), lines)
    try:
        ast.parse(inspect.cleandoc("\n" + "\n".join(code)))
    except SyntaxError:
        return "text"
    return "python"


def restructured(lines: list[str]) -> Iterator[str]:
    """A docstring as reStructuredText: marks escaped, lists set off, indented examples as code."""
    before, level, code, bullets = "", 0, None, None
    for number, line in enumerate(lines):
        text, indent = line.lstrip(), len(line) - len(line.lstrip())
        if text and code is not None and indent < code:
            code = None
        if text and code is None:
            if text.startswith("- ") and (bullets is None or indent <= bullets):
                if bullets is None and before:
                    yield ""
                bullets = indent
            elif bullets is not None and indent <= bullets:
                bullets = None
                if before:
                    yield ""
            elif bullets is None and not before and indent >= level + 4:
                code = indent
                yield " " * level + f".. code-block:: {language(lines[number:])}"
                yield ""
            level = indent
        yield line if code is not None else escaped(line)
        before = text


def describe(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Replace a docstring by reStructuredText, before its sections are read."""
    lines[:] = restructured(lines)


def directive(qualified: str) -> str:
    """What documents a public name."""
    face, name = split(qualified)
    obj = getattr(face, name)
    if inspect.isclass(obj):
        return f".. autoclass:: {qualified}\n   :members:\n   :show-inheritance:\n"
    return f".. auto{'function' if inspect.isfunction(obj) else 'data'}:: {qualified}\n"


def title(text: str, mark: str) -> str:
    return f"{text}\n{mark * len(text)}\n\n"


def docstring(module: str) -> str:
    """The docstring of a module as reStructuredText."""
    lines = inspect.cleandoc(importlib.import_module(module).__doc__ or "").splitlines()
    return "\n".join(restructured(lines)) + "\n\n"


def page(package: str, qualified: list[str]) -> str:
    """The page of a package: an overview with the first sentences, then everything by module."""
    full = f"torchsar.{package}"
    modules: dict[str, list[str]] = {}
    for name in qualified:
        modules.setdefault(home(name), []).append(name)
    ordered = {module: modules[module] for module in sorted(modules)}
    parts = [title(full, "="), f".. py:module:: {full}\n\n", docstring(full), title("Overview", "-")]
    parts += [".. list-table::\n   :class: overview\n   :widths: 35 65\n\n"]
    for name in itertools.chain(*ordered.values()):
        parts.append(f"   * - :py:obj:`~{name}`\n     - {first_sentence(name)}\n")
    for module, members in ordered.items():
        parts += ["\n", title(module.removeprefix("torchsar."), "-")]
        if module != full:
            parts.append(docstring(module))
        parts.append("\n".join(map(directive, members)))
    return "".join(parts)


def write(app: Sphinx) -> None:
    """Write the pages of all packages into the folder reference/api, where they have changed."""
    folder = Path(app.srcdir) / "reference" / "api"
    folder.mkdir(exist_ok=True)
    for package, qualified in names().items():
        path, text = folder / f"{package}.rst", page(package, qualified)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def missing(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> nodes.Element | None:
    """Code in place of a link: names in docstrings that are not public, types of other packages.

    Links in pages written by hand must lead somewhere: unless resolved they are reported.
    """
    in_docstring = node.get("refdoc", "").startswith("reference/api/")
    return content if in_docstring and node.get("refdomain") == "py" else None


class Derivatives(SphinxDirective):
    """Table of the stages and functions whose attribute `differentiable` is not "yes"."""

    def run(self) -> list[nodes.Node]:
        named: dict[str, list[str]] = {"where ok": [], "no": []}
        for qualified in itertools.chain(*names().values()):
            face, name = split(qualified)
            kind = getattr(getattr(face, name), "differentiable", "yes")
            if kind in named:
                named[kind].append(f"{{py:obj}}`~{qualified}`")
        rows = [*((kind, ", ".join(found)) for kind, found in named.items()), ("yes", "all others")]
        lines = [
            "| derivatives | stages and functions |",
            "|---|---|",
            *(f"| {kind} | {found} |" for kind, found in rows),
        ]
        return self.parse_text_to_nodes("\n".join(lines))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the pages, the docstrings, the table of derivatives, and the unknown names."""
    app.add_directive("derivatives", Derivatives)
    app.connect("builder-inited", write)
    app.connect("autodoc-process-docstring", describe, priority=400)
    app.connect("missing-reference", missing)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
