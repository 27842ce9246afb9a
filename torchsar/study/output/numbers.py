"""Formatting of numbers in reports; see `torchsar.core.numbers`."""

from torchsar.core.numbers import MISSING, number, quantity, scale_of

__all__ = ["MISSING", "number", "quantity", "scale_of"]
