"""Libraries of optional extras, imported when something needs them."""

from __future__ import annotations

import importlib
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
