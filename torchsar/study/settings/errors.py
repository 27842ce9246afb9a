"""Errors in configs, command lines and input files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
            f"({type(error).__name__}: {one_line(error)}); mend or uninstall the package"
        ) from error
