"""Autofocus of antennas on any path."""

from torchsar.compensate.path.line_of_sight import CorrectPath, PathAutofocus, PathPhase, path_autofocus, path_phase
from torchsar.compensate.path.strip import StripAutofocus, strip_autofocus
from torchsar.compensate.path.sweep import CorrectSweepMotion, correct_sweep_motion

__all__ = [
    "CorrectPath",
    "CorrectSweepMotion",
    "PathAutofocus",
    "PathPhase",
    "StripAutofocus",
    "correct_sweep_motion",
    "path_autofocus",
    "path_phase",
    "strip_autofocus",
]
__dir__ = __all__.copy
