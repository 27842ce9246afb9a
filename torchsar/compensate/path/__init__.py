"""Autofocus of antennas on any path."""

from torchsar.compensate.path.line_of_sight import path_autofocus
from torchsar.compensate.path.phase import path_phase
from torchsar.compensate.path.strip import strip_autofocus
from torchsar.compensate.path.stages import CorrectPath, PathAutofocus, PathPhase

__all__ = ["CorrectPath", "PathAutofocus", "PathPhase", "path_autofocus", "path_phase", "strip_autofocus"]
