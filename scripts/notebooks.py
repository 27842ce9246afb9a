"""Tutorials as executed notebooks, from the same pages as the site (`make notebooks`).

Every block of Python of a page becomes a cell, and all else text. A notebook holds what its cells
print; the pictures that they save lie beside it.
"""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from jupyter_client.manager import AsyncKernelManager
from jupyter_core.utils import run_sync
from nbclient import NotebookClient

DOCS = Path(__file__).parents[1] / "docs"


def text_of(part: str) -> str:
    """Markdown of a part of a page without what only the site understands."""
    part = re.sub(r"```\{[\w-]+\}.*?```\n?", "", part, flags=re.S)  # tables and lists made by the site
    part = re.sub(r"\{[\w:]+\}`~?(?:([^`<]*?) <)?([^`>]*)>?`", lambda m: f"`{m[1] or m[2]}`", part)
    part = re.sub(r"(?<!!)\[([^\]]*)\]\(([^)]*\.md)[^)]*\)", lambda m: m[1] or Path(m[2]).stem, part)
    return re.sub(r"!\[([^\]]*)\]\(\.\./([^)]*)\)", r"![\1](\2)", part).strip()


def notebook(page: Path) -> nbformat.NotebookNode:
    """Notebook of a page, not executed."""
    parts = re.split(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    cells = [
        nbformat.v4.new_code_cell(part.strip()) if i % 2 else nbformat.v4.new_markdown_cell(text_of(part))
        for i, part in enumerate(parts)
        if text_of(part)
    ]
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # the same page gives the same file
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return nbformat.v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})


def main() -> None:
    """Write and execute the notebooks that the command names."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("pages", nargs="*", help="tutorials by name, such as steps; all by default")
    options.add_argument("--out", type=Path, default=DOCS / "_build" / "notebooks", help="folder of the notebooks")
    given = options.parse_args()
    pages = {page.stem: page for page in sorted((DOCS / "tutorials").glob("*.md")) if page.stem != "index"}
    unknown = set(given.pages) - set(pages)
    if unknown:
        options.error(f"there is no tutorial {sorted(unknown)[0]!r}; there are {', '.join(pages)}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.pages or pages:
        made = notebook(pages[name])
        for picture in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", "".join(c.source for c in made.cells)):
            shutil.copy(DOCS / picture, given.out)
        with TemporaryDirectory() as folder:  # files in it take the place of ports
            kernel = AsyncKernelManager(transport="ipc", connection_file=f"{folder}/kernel.json")
            where = {"metadata": {"path": str(given.out)}}
            NotebookClient(made, km=kernel, timeout=600, startup_timeout=300, resources=where).execute()
            run_sync(kernel.shutdown_kernel)(now=True)
        nbformat.write(made, given.out / f"{name}.ipynb")
        print(given.out / f"{name}.ipynb", flush=True)


if __name__ == "__main__":
    main()
