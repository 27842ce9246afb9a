"""Scenes, motions and worlds: the true state that a simulation starts from.

A world collects everything that is true about an acquisition; `torchsar.echo` turns it into a
recording and the true parameters of this recording. All objects are immutable (frozen dataclasses).

A parameter annotated `Tensor | float` is a number, equal in all trials, or a tensor of shape
(trials,) with one value per trial. Parameters annotated with a plain type are fixed for all trials,
because they decide shapes or choose a model.
"""

from torchsar.scene.aircraft import Aircraft, SpreadRows
from torchsar.scene.bistatic import (
    BandLimited,
    BistaticWorld,
    Gate,
    OrbitTransmit,
    Pattern,
    PolynomialTransmit,
    TransmitRange,
)
from torchsar.scene.flight import (
    CircularPath,
    Flight,
    Jitter,
    Navigation,
    NominalPath,
    Offset,
    RandomWalk,
    StraightPath,
    Sway,
)
from torchsar.scene.fluctuation import (
    LogAmplitude,
    MeasuredTrack,
    PathFluctuation,
    RandomMotion,
    Tones,
    VibrationSpectrum,
    drawn_motion,
)
from torchsar.scene.ladar import (
    CalibrationFibre,
    Effect,
    EverySample,
    Extremes,
    Fidelity,
    LadarWorld,
    LinearInSweep,
    OnePerPeriod,
    OnePerSweep,
    QuadraticInSweep,
    RangeHistory,
    SweepError,
)
from torchsar.scene.ladar_targets import LetterE, RetroAndBrokenLine
from torchsar.scene.lit_points import LitPoints
from torchsar.scene.moving import (
    Bend,
    ExactRange,
    Fleet,
    GroundMovers,
    Movers,
    MovingPoints,
    MovingScene,
    ReceiveRange,
    Ship,
    TaylorRange,
)
from torchsar.scene.path import AlwaysLit, Antenna, Beam, Dwell, Hyperbola, Parabola, Path
from torchsar.scene.path_world import GridGround, Ground, PathWorld, PlaneGround, SideBeam
from torchsar.scene.rotation import PolynomialRotation
from torchsar.scene.satellite import Satellite
from torchsar.scene.sea import ImageReflectivity, KSea, Sea, gamma_from_normal
from torchsar.scene.targets import Points, RandomPoints, Scatterers, Scene, Speckle, Together
from torchsar.scene.turntable import Dechirped, PhaseOnly, TurntableWorld
from torchsar.scene.vibration import (
    Motion,
    Polynomial,
    PulsePhase,
    Sinusoid,
    StartPhase,
    UniformStartPhase,
    displacement_m,
    start_phase_rad,
)
from torchsar.scene.world import StripmapWorld

__all__ = [
    "Aircraft",
    "AlwaysLit",
    "Antenna",
    "BandLimited",
    "Beam",
    "Bend",
    "BistaticWorld",
    "CalibrationFibre",
    "CircularPath",
    "Dechirped",
    "Dwell",
    "Effect",
    "EverySample",
    "ExactRange",
    "Extremes",
    "Fidelity",
    "Fleet",
    "Flight",
    "Gate",
    "GridGround",
    "Ground",
    "GroundMovers",
    "Hyperbola",
    "ImageReflectivity",
    "Jitter",
    "KSea",
    "LadarWorld",
    "LetterE",
    "LinearInSweep",
    "LitPoints",
    "LogAmplitude",
    "MeasuredTrack",
    "Motion",
    "Movers",
    "MovingPoints",
    "MovingScene",
    "Navigation",
    "NominalPath",
    "Offset",
    "OnePerPeriod",
    "OnePerSweep",
    "OrbitTransmit",
    "Parabola",
    "Path",
    "PathFluctuation",
    "PathWorld",
    "Pattern",
    "PhaseOnly",
    "PlaneGround",
    "Points",
    "Polynomial",
    "PolynomialRotation",
    "PolynomialTransmit",
    "PulsePhase",
    "QuadraticInSweep",
    "RandomMotion",
    "RandomPoints",
    "RandomWalk",
    "RangeHistory",
    "ReceiveRange",
    "RetroAndBrokenLine",
    "Satellite",
    "Scatterers",
    "Scene",
    "Sea",
    "Ship",
    "SideBeam",
    "Sinusoid",
    "Speckle",
    "SpreadRows",
    "StartPhase",
    "StraightPath",
    "StripmapWorld",
    "Sway",
    "SweepError",
    "TaylorRange",
    "Together",
    "Tones",
    "TransmitRange",
    "TurntableWorld",
    "UniformStartPhase",
    "VibrationSpectrum",
    "displacement_m",
    "drawn_motion",
    "gamma_from_normal",
    "start_phase_rad",
]
__dir__ = __all__.copy
