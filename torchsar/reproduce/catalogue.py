"""All papers whose figures and tables are reproduced."""

from __future__ import annotations

import importlib

from torchsar.reproduce.item import Paper

# names of the papers, each that of the system that reproduces it
PAPERS = ("sal", "geo", "isal", "isal_rotation", "stripmap")


def paper(name: str) -> Paper:
    """Return a paper with its figures and tables.

    Args:
        name: One of `PAPERS`.

    Returns:
        The paper.
    """
    return importlib.import_module(f"torchsar.reproduce.{name}").PAPER
