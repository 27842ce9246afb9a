"""Errors in configs, command lines and input files."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any


class ConfigError(ValueError):
    """An error in a config, a command line or an input file; its text is one sentence that names
    the key or the file.
    """


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


def one_line(error: BaseException) -> str:
    """Return the text of an error as one line; that of a KeyError has no quotes around it."""
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    return " ".join(str(text).split())


@contextmanager
def loading(point: Any) -> Iterator[None]:
    """Turn any error of loading an entry point of another package into one sentence."""
    try:
        yield
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"the entry point {point.name!r} ({point.value}) of an installed package cannot be loaded "
            f"({type(error).__name__}: {one_line(error)}); mend or uninstall the package"
        ) from error
