"""Hints for words that are not accepted, without any import that takes time."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, accepted: Iterable[str]) -> str:
    """Return a hint for an unknown word.

    Args:
        word: The word that is not accepted.
        accepted: The words that are.

    Returns:
        "; did you mean ...?" with the most similar accepted word, if there is one, and the list of
        accepted words.
    """
    names = sorted(accepted)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"{hint} (accepted: {', '.join(names) or 'nothing'})"
