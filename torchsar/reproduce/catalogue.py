"""All papers whose figures and tables are reproduced."""

from __future__ import annotations

import importlib

from torchsar.reproduce.item import Paper

# by the system that follows each of them
PAPERS = ("sal", "geo", "isal", "isal_rotation", "stripmap")


def paper(name: str) -> Paper:
    """Return a paper with its figures and tables.

    Args:
        name: One of `PAPERS`.

    Returns:
        The paper.
    """
    return importlib.import_module(f"torchsar.reproduce.{name}").PAPER
