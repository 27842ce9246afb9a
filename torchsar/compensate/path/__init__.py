"""Autofocus of antennas on any path."""

from torchsar.compensate.path.line_of_sight import path_autofocus, path_phase
from torchsar.compensate.path.stages import CorrectPath, PathAutofocus, PathPhase, StripAutofocus
from torchsar.compensate.path.strip import strip_autofocus

__all__ = [
    "CorrectPath",
    "PathAutofocus",
    "PathPhase",
    "StripAutofocus",
    "path_autofocus",
    "path_phase",
    "strip_autofocus",
]
