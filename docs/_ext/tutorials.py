"""Tutorials as notebooks, made from the pages of the site, which offers them for download.

Every block of Python of a page becomes a cell, and all else text, which holds its pictures.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

TUTORIALS = Path(__file__).parents[1] / "tutorials"
_PICTURE = re.compile(r"!\[([^\]]*)\]\((\.\./[^)]*)\)")


def pages() -> dict[str, Path]:
    """Pages of the tutorials by name."""
    return {page.stem: page for page in sorted(TUTORIALS.glob("*.md")) if page.stem != "index"}


def notebook(page: Path) -> dict[str, Any]:
    """Notebook of a page, not executed, as its JSON."""
    parts = re.split(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    cells = [_code(part) if i % 2 else _text(part, page.parent) for i, part in enumerate(parts) if _markdown(part)]
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # the same page gives the same file
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _code(part: str) -> dict[str, Any]:
    """Cell of a block of Python."""
    return {"cell_type": "code", "metadata": {}, "execution_count": None, "outputs": [], "source": part.strip()}


def _text(part: str, folder: Path) -> dict[str, Any]:
    """Cell of text with its pictures, whose names are relative to `folder`."""
    pictures = {Path(name).name: (folder / name).read_bytes() for _, name in _PICTURE.findall(part)}
    attached = {name: {"image/png": base64.b64encode(data).decode()} for name, data in pictures.items()}
    cell = {"cell_type": "markdown", "metadata": {}, "source": _markdown(part)}
    return {**cell, "attachments": attached} if attached else cell


def _markdown(part: str) -> str:
    """Markdown of a part of a page without what only the site understands."""
    part = re.sub(r"```\{[\w-]+\}.*?```\n?", "", part, flags=re.S)  # tables and lists made by the site
    part = re.sub(r"\{[\w:]+\}`~?(?:([^`<]*?) <)?([^`>]*)>?`", lambda m: f"`{m[1] or m[2]}`", part)
    part = re.sub(r"(?<!!)\[([^\]]*)\]\(([^)]*\.md)[^)]*\)", lambda m: m[1] or Path(m[2]).stem, part)
    return _PICTURE.sub(lambda m: f"![{m[1]}](attachment:{Path(m[2]).name})", part).strip()


def _link(app: Sphinx, name: str, source: list[str]) -> None:
    """Add the link below the title of a tutorial."""
    folder, _, page = name.rpartition("/")
    if folder == "tutorials" and page in pages() and app.builder.format == "html":
        link = f'<a href="{page}.ipynb" download>This page as a notebook</a>'
        source[0] = re.sub(r"\A(# .*\n)", lambda m: f"{m[1]}\n{link}\n", source[0])


def _write(app: Sphinx, error: Exception | None) -> None:
    """Write the notebooks beside their pages."""
    if error is None and app.builder.format == "html":
        for name, page in pages().items():
            path = Path(app.outdir) / "tutorials" / f"{name}.ipynb"
            path.write_text(json.dumps(notebook(page), ensure_ascii=False, indent=1), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the links and the files."""
    app.connect("source-read", _link)
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
