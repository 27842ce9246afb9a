"""Autofocus of antennas on any path."""

from torchsar.compensate.path.line_of_sight import path_autofocus
from torchsar.compensate.path.phase import PathPhase, path_phase
from torchsar.compensate.path.stages import CorrectPath, PathAutofocus

__all__ = ["CorrectPath", "PathAutofocus", "PathPhase", "path_autofocus", "path_phase"]
