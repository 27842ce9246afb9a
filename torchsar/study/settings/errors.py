"""Errors in configs, command lines and input files."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from traceback import walk_tb
from typing import Any

# imported here for all modules of `study`
from torchsar.spelling import did_you_mean as did_you_mean


class ConfigError(ValueError):
    """An error in a config, a command line or an input file; its text is one sentence that names
    the key or the file.
    """


def one_line(error: BaseException) -> str:
    """Return the text of an error as one line; that of a KeyError has no quotes around it."""
    return " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())


@contextmanager
def loading(point: Any) -> Iterator[None]:
    """Convert any error that occurs when an entry point of another package is loaded to one
    sentence.
    """
    try:
        yield
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"the entry point {point.name!r} ({point.value}) of an installed package cannot be loaded "
            f"({type(error).__name__}: {one_line(error)}{own_line(error)}); mend or uninstall the package"
        ) from error


def own_line(error: BaseException) -> str:
    """Name the innermost line of the user's code that an error passed through.

    Args:
        error: The error.

    Returns:
        The line in words, in brackets after a blank; empty if it passed through libraries alone.
    """
    frames = [(frame, line) for frame, line in walk_tb(error.__traceback__)]
    own = [(frame, line) for frame, line in frames if not is_library(str(frame.f_globals.get("__name__")))]
    return f" (line {own[-1][1]} of {own[-1][0].f_code.co_filename})" if own else ""


def is_library(module: str) -> bool:
    """Decide whether a module belongs to the standard library or to an installed package.

    Args:
        module: Its name.

    Returns:
        The answer.
    """
    top = module.partition(".")[0]
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    installed = "site-packages" in file or "dist-packages" in file
    return top in sys.stdlib_module_names or top in ("torchsar", "torch", "numpy") or installed
