"""Hints for words that are not accepted, without any import that takes time."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def entries_with(words: Iterable[str], text: str) -> str:
    """Select the entries of an indented text that contain all words.

    Args:
        words: Words, in any case of letters.
        text: Lines; those that are indented deeper belong to the one above.

    Returns:
        The lines that contain all words, with the lines that belong to them and those to which they
        belong; the text itself without words.
    """
    wanted, found = [word.lower() for word in words], []
    above: list[tuple[int, str]] = []  # lines to which the next one may belong, not yet in `found`
    within = None  # indent of the entry whose lines are taken
    for line in text.splitlines():
        depth = len(line) - len(line.lstrip())
        if not line or (within is not None and depth <= within):
            within = None
        above = [(deep, one) for deep, one in above if deep < depth]
        if line and within is None and all(word in line.lower() for word in wanted):
            within = depth
        if within is None and line:
            above.append((depth, line))
        elif line:
            found += [*(one for _, one in above), line]
            above = []
    return "\n".join(found) if wanted else text


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
