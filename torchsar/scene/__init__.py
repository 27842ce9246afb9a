"""The truth: targets, path, beam."""

from torchsar.scene.aircraft import Aircraft, SpreadRows
from torchsar.scene.fluctuation import LogAmplitude, MeasuredTrack, PathFluctuation, RandomMotion, Tones, VibrationSpectrum, drawn_motion
from torchsar.scene.ladar import CalibrationFibre, Effect, EverySample, Extremes, Fidelity, LadarWorld, LinearInSweep, OnePerPeriod, OnePerSweep, QuadraticInSweep, RangeHistory, SweepError
from torchsar.scene.ladar_targets import LetterE, RetroAndBrokenLine
from torchsar.scene.path import AlwaysLit, Antenna, Beam, Dwell, Hyperbola, Parabola, Path
from torchsar.scene.rotation import PolynomialRotation
from torchsar.scene.satellite import Satellite
from torchsar.scene.targets import Points, RandomPoints, Scatterers, Scene, Speckle, Together
from torchsar.scene.turntable import Dechirped, PhaseOnly, TurntableWorld
from torchsar.scene.vibration import Motion, Polynomial, PulsePhase, Sinusoid, StartPhase, UniformStartPhase, displacement_m, start_phase_rad
from torchsar.scene.world import StripmapWorld

__all__ = [
    "Aircraft",
    "AlwaysLit",
    "Antenna",
    "Beam",
    "CalibrationFibre",
    "Dechirped",
    "Dwell",
    "Effect",
    "EverySample",
    "Extremes",
    "Fidelity",
    "Hyperbola",
    "LadarWorld",
    "LetterE",
    "LinearInSweep",
    "LogAmplitude",
    "MeasuredTrack",
    "Motion",
    "OnePerPeriod",
    "OnePerSweep",
    "Parabola",
    "Path",
    "PathFluctuation",
    "PhaseOnly",
    "Points",
    "Polynomial",
    "PolynomialRotation",
    "PulsePhase",
    "QuadraticInSweep",
    "RandomMotion",
    "RandomPoints",
    "RangeHistory",
    "RetroAndBrokenLine",
    "Satellite",
    "Scatterers",
    "Scene",
    "Sinusoid",
    "Speckle",
    "SpreadRows",
    "StartPhase",
    "StripmapWorld",
    "SweepError",
    "Together",
    "Tones",
    "TurntableWorld",
    "UniformStartPhase",
    "VibrationSpectrum",
    "displacement_m",
    "drawn_motion",
    "start_phase_rad",
]
