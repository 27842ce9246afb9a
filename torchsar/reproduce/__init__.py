"""Reproduction of published figures, tables and numbers, and their comparison: `torchsar
reproduce`.

The catalogue lists every numbered figure and table of the five papers, numbers of their texts, and
their errors. An entry names the experiment that makes the figure, the published numbers, and the
tolerance of each comparison. For figures and tables that are not reproduced, it gives the reason
and the numbers that show it.
"""

from __future__ import annotations

from torchsar.reproduce.command import PAPERS, paper, reproduce, table
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
