"""Published figures and tables, made anew and compared: `torchsar reproduce`.

The catalogue lists every numbered figure and table of the five papers, with what makes it, the
published numbers, the tolerance of each comparison and the reason of what is not reproduced.
"""

from __future__ import annotations

from torchsar.reproduce.catalogue import PAPERS, paper
from torchsar.reproduce.command import reproduce, table
from torchsar.reproduce.item import (
    BETTER,
    NOT_REPRODUCED,
    REPRODUCED,
    Check,
    Item,
    Paper,
    falling,
    number,
    settled,
    statement,
    verdict,
)

__all__ = [
    "BETTER",
    "NOT_REPRODUCED",
    "PAPERS",
    "REPRODUCED",
    "Check",
    "Item",
    "Paper",
    "falling",
    "number",
    "paper",
    "reproduce",
    "settled",
    "statement",
    "table",
    "verdict",
]
__dir__ = __all__.copy
