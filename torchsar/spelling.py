"""Hints for words that are not accepted, without any import that takes time."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def entries_with(words: Iterable[str], text: str) -> str:
    """Select the entries of an indented text that contain all words.

    Args:
        words: Parts of words, in any case of letters. One of them stands in the line of the entry,
            the others there or in the lines to which it belongs.
        text: Lines; those that are indented deeper belong to the one above.

    Returns:
        The entries, with the lines that belong to them and those to which they belong; the text
        itself without words.
    """
    wanted, found = [word.lower() for word in words], []
    # indent and text of the lines to which the next line may belong
    above: list[tuple[int, str]] = []
    # shown: indent of the last line in `found`
    # taken: indent of the entry whose lines are selected; -1 if there is none
    shown = taken = -1
    for line in text.splitlines():
        depth = len(line) - len(line.lstrip())
        above = [(deep, one) for deep, one in above if deep < depth and line]
        shown, taken = min(shown, above[-1][0] if above else -1), taken if depth > taken >= 0 and line else -1
        here, whole = line.lower(), "\n".join([*(one for _, one in above), line]).lower()
        if taken < 0 and any(word in here for word in wanted) and all(word in whole for word in wanted):
            taken = depth
        if taken >= 0 and line:
            found += [*(one for deep, one in above if deep > shown), line]
            shown = depth
        above.append((depth, line))
    return "\n".join(found) if wanted else text


def did_you_mean(word: str, accepted: Iterable[str], listed: str = "") -> str:
    """Return a hint for an unknown word.

    Args:
        word: The word that is not accepted.
        accepted: The words that are.
        listed: Where a long list of them is found, which replaces them if one is similar.

    Returns:
        "; did you mean ...?" with the most similar accepted word, if there is one, and the list of
        accepted words, or `listed`.
    """
    names = sorted(accepted)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    shown = listed if near and listed else f"accepted: {', '.join(names) or 'nothing'}"
    return f"{hint} ({shown})"
