"""Libraries of optional extras, and the files that they read and write."""

from __future__ import annotations

import importlib
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import walk_tb
from typing import Any


def library(module: str, extra: str, purpose: str) -> Any:
    """Import a library of an optional extra.

    Args:
        module: Name of the module.
        extra: Extra of the package that installs it.
        purpose: What needs it, as the subject of the message.

    Returns:
        The module.

    Raises:
        ModuleNotFoundError: If it is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{purpose} needs the package {(error.name or module).partition('.')[0]}: "
            f'pip install "torchsar-lab[{extra}]"',
            name=error.name,
        ) from None


@contextmanager
def quiet() -> Iterator[None]:
    """Leave out what libraries log, and warn of their own code, which a user cannot change.

    Yields:
        Nothing.
    """
    loggers = [logging.getLogger(name) for name in ("jbpy", "sarkit")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a library raises for a damaged file into one sentence that names the file.

    Args:
        path: Path of the file.
        kind: What it should be, for messages.

    Yields:
        Nothing.

    Raises:
        ValueError: If the block raises anything but an error of import, memory or file system.
    """
    try:
        with quiet():
            yield
    except (ImportError, MemoryError, FileNotFoundError, PermissionError):
        raise
    except Exception as error:  # libraries raise errors of any type for damaged files
        text = " ".join(str(error).split())
        if str(error).startswith(str(path)):
            raise ValueError(text) from None
        # what libraries say of their own variables names no cause
        *_, (raised, _) = walk_tb(error.__traceback__)
        plain = isinstance(error, ValueError) and text and raised.f_globals["__name__"].startswith("torchsar.")
        reason = (
            text if plain else f"it is damaged or of another kind ({type(error).__name__}{': ' if text else ''}{text})"
        )
        raise ValueError(f"{path} cannot be read as {kind}: {reason[:300]}") from None


def write_whole(path: str | Path, write: Callable[[Path], None]) -> None:
    """Write a file completely, or leave what was there.

    Args:
        path: Path of the file.
        write: Function that writes the file at the path that it gets, in the same folder.

    Raises:
        FileNotFoundError: If the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: its folder does not exist; create it")
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        write(part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
