"""Tutorials as executed notebooks, from the same pages as the site (`make notebooks`).

A notebook holds what its cells print; the pictures that they save lie beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from jupyter_client.manager import AsyncKernelManager
from jupyter_core.utils import run_sync
from nbclient import NotebookClient

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS / "_ext"))

from tutorials import notebook, pages  # noqa: E402 # pyright: ignore[reportMissingImports]


def main() -> None:
    """Write and execute the notebooks that the command names."""
    options, known = argparse.ArgumentParser(description=__doc__), pages()
    options.add_argument("pages", nargs="*", help="tutorials by name, such as steps; all by default")
    options.add_argument("--out", type=Path, default=DOCS / "_build" / "notebooks", help="folder of the notebooks")
    given = options.parse_args()
    unknown = set(given.pages) - set(known)
    if unknown:
        options.error(f"there is no tutorial {sorted(unknown)[0]!r}; there are {', '.join(known)}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in given.pages or known:
        made = nbformat.from_dict(notebook(known[name]))
        with TemporaryDirectory() as folder:  # files in it take the place of ports
            kernel = AsyncKernelManager(transport="ipc", connection_file=f"{folder}/kernel.json")
            where = {"metadata": {"path": str(given.out)}}
            NotebookClient(made, km=kernel, timeout=600, startup_timeout=300, resources=where).execute()
            run_sync(kernel.shutdown_kernel)(now=True)
        nbformat.write(made, given.out / f"{name}.ipynb")
        print(given.out / f"{name}.ipynb", flush=True)


if __name__ == "__main__":
    main()
