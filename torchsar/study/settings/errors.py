"""What the user did wrong, in one sentence."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """A mistake in a config, a command line or an input file; its text is one sentence that names
    the offender.
    """


def did_you_mean(word: str, accepted: Iterable[str]) -> str:
    """'; did you mean ...?' where something close is accepted, then the list of what is."""
    names = sorted(accepted)
    near = difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"{hint} (accepted: {', '.join(names) or 'nothing'})"


def one_line(error: BaseException) -> str:
    """The text of an error without line ends; a KeyError without its quotes."""
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    return " ".join(str(text).split())
