"""The truth: targets, path, beam."""

from torchsar.scene.aircraft import Aircraft, SpreadRows
from torchsar.scene.path import AlwaysLit, Antenna, Beam, Dwell, Hyperbola, Parabola, Path
from torchsar.scene.targets import Points, RandomPoints, Scatterers, Scene, Speckle, Together
from torchsar.scene.turntable import Dechirped, PhaseOnly, TurntableWorld
from torchsar.scene.vibration import Motion, Polynomial, PulsePhase, Sinusoid, StartPhase, UniformStartPhase, displacement_m, start_phase_rad
from torchsar.scene.world import StripmapWorld

__all__ = [
    "Aircraft",
    "AlwaysLit",
    "Antenna",
    "Beam",
    "Dechirped",
    "Dwell",
    "Hyperbola",
    "Motion",
    "Parabola",
    "Path",
    "PhaseOnly",
    "Points",
    "Polynomial",
    "PulsePhase",
    "RandomPoints",
    "Scatterers",
    "Scene",
    "Sinusoid",
    "Speckle",
    "SpreadRows",
    "StartPhase",
    "StripmapWorld",
    "Together",
    "TurntableWorld",
    "UniformStartPhase",
    "displacement_m",
    "start_phase_rad",
]
