"""Autofocus of antennas on any path."""

from torchsar.compensate.path.line_of_sight import CorrectPath, PathAutofocus, PathPhase, path_autofocus, path_phase
from torchsar.compensate.path.strip import StripAutofocus, strip_autofocus

__all__ = [
    "CorrectPath",
    "PathAutofocus",
    "PathPhase",
    "StripAutofocus",
    "path_autofocus",
    "path_phase",
    "strip_autofocus",
]
__dir__ = __all__.copy
