"""Published figures, tables and numbers, made anew and compared: `torchsar reproduce`.

The catalogue lists every numbered figure and table of the five papers, numbers of their texts and
what they have wrong, with what makes it, the published numbers, the tolerance of each comparison,
and the reason of what is not reproduced with the numbers that show it.
"""

from __future__ import annotations

from torchsar.reproduce.catalogue import PAPERS, paper
from torchsar.reproduce.command import reproduce, table
from torchsar.reproduce.item import (
    BETTER,
    MISPRINT,
    NOT_REPRODUCED,
    REPRODUCED,
    Check,
    Fact,
    Item,
    Paper,
    falling,
    misprint,
    number,
    settled,
    statement,
    verdict,
)

__all__ = [
    "BETTER",
    "MISPRINT",
    "NOT_REPRODUCED",
    "PAPERS",
    "REPRODUCED",
    "Check",
    "Fact",
    "Item",
    "Paper",
    "falling",
    "misprint",
    "number",
    "paper",
    "reproduce",
    "settled",
    "statement",
    "table",
    "verdict",
]
__dir__ = __all__.copy
