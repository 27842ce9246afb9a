"""Scenes, motions and worlds: the true state that a simulation starts from.

A world collects everything that is true about an acquisition; `torchsar.echo` turns it into a
recording and the true parameters of this recording. All objects are immutable (frozen dataclasses).

================================  ==================================================================
to describe                       what to use
================================  ==================================================================
world seen by a stripmap radar    `StripmapWorld`; ranges `Hyperbola` or `Parabola`; beams
                                  `AlwaysLit`, `Dwell`, `Antenna`
world of a rotating target        `TurntableWorld` with `PolynomialRotation`; echo `Dechirped` or
                                  `PhaseOnly`
world of a triangular ladar       `LadarWorld`; `CalibrationFibre` where the sweeps are not linear
range within a sweep of a ladar   `LinearInSweep`; `EverySample` is exact; `QuadraticInSweep`,
                                  `OnePerSweep`, `OnePerPeriod`
moving targets, several channels  `BistaticWorld`; gain `Pattern` or `BandLimited`; ranges
                                  `ExactRange` or `TaylorRange`; transmit range `OrbitTransmit` or
                                  `PolynomialTransmit`
world seen from any path          `PathWorld` with a `Flight`, its `Navigation`, a `PlaneGround` and
                                  a `SideBeam`; `MotionInSweep`
path of an antenna                `StraightPath`, `CircularPath`, `RecordedPath`; `Sway`, with
                                  `Jitter`, `RandomWalk`, `Offset` and the motions below
point targets                     `Points`, `RandomPoints`; `PointCloud` of an array or an image;
                                  `Together` joins a `Scene` with others; they become `Scatterers`
surface                           `Speckle`, `KSea`, `ImageReflectivity`
moving points and ships           `MovingPoints`, `Ship`, `GroundMovers`; `Fleet` joins them; for
                                  strips they are `movers` of a `StripmapWorld`
models of targets                 `Aircraft`, `Satellite`, `SpreadRows`, `LetterE`,
                                  `RetroAndBrokenLine`
motion along the line of sight    `Motion`: `Polynomial`, `Sinusoid`, `VibrationSpectrum`,
                                  `MeasuredTrack`
turbulent air                     `PathFluctuation` of the path, `LogAmplitude` of the amplitude
start phase of each pulse         `StartPhase`, normal; `UniformStartPhase`, incoherent pulses
================================  ==================================================================

A parameter annotated `Tensor | float` is a number, equal in all trials, or a tensor of shape
(trials,) with one value per trial. Parameters annotated with a plain type are fixed for all trials,
because they decide shapes or choose a model.
"""

from torchsar.core.kinds import check_kinds
from torchsar.core.show import show_briefly
from torchsar.scene.bistatic import (
    BandLimited,
    BistaticWorld,
    ExactRange,
    OrbitTransmit,
    Pattern,
    PolynomialTransmit,
    TaylorRange,
)
from torchsar.scene.flight import (
    CircularPath,
    Flight,
    Jitter,
    Navigation,
    Offset,
    RandomWalk,
    RecordedPath,
    StraightPath,
    Sway,
)
from torchsar.scene.ladar import CalibrationFibre, LadarWorld, LetterE, RetroAndBrokenLine
from torchsar.scene.ladar_range import EverySample, LinearInSweep, OnePerPeriod, OnePerSweep, QuadraticInSweep
from torchsar.scene.motion import (
    LogAmplitude,
    MeasuredTrack,
    Motion,
    PathFluctuation,
    Polynomial,
    Sinusoid,
    StartPhase,
    UniformStartPhase,
    VibrationSpectrum,
)
from torchsar.scene.movers import Fleet, GroundMovers, MovingPoints, Ship
from torchsar.scene.path import MotionInSweep, PathWorld, PlaneGround, SideBeam
from torchsar.scene.satellite import Aircraft, Satellite, SpreadRows
from torchsar.scene.sea import ImageReflectivity, KSea
from torchsar.scene.strip import AlwaysLit, Antenna, Dwell, Hyperbola, Parabola, StripmapWorld
from torchsar.scene.targets import PointCloud, Points, RandomPoints, Scatterers, Scene, Speckle, Together
from torchsar.scene.turntable import Dechirped, PhaseOnly, PolynomialRotation, TurntableWorld

__all__ = [
    "Aircraft",
    "AlwaysLit",
    "Antenna",
    "BandLimited",
    "BistaticWorld",
    "CalibrationFibre",
    "CircularPath",
    "Dechirped",
    "Dwell",
    "EverySample",
    "ExactRange",
    "Fleet",
    "Flight",
    "GroundMovers",
    "Hyperbola",
    "ImageReflectivity",
    "Jitter",
    "KSea",
    "LadarWorld",
    "LetterE",
    "LinearInSweep",
    "LogAmplitude",
    "MeasuredTrack",
    "Motion",
    "MotionInSweep",
    "MovingPoints",
    "Navigation",
    "Offset",
    "OnePerPeriod",
    "OnePerSweep",
    "OrbitTransmit",
    "Parabola",
    "PathFluctuation",
    "PathWorld",
    "Pattern",
    "PhaseOnly",
    "PlaneGround",
    "PointCloud",
    "Points",
    "Polynomial",
    "PolynomialRotation",
    "PolynomialTransmit",
    "QuadraticInSweep",
    "RandomPoints",
    "RandomWalk",
    "RecordedPath",
    "RetroAndBrokenLine",
    "Satellite",
    "Scatterers",
    "Scene",
    "Ship",
    "SideBeam",
    "Sinusoid",
    "Speckle",
    "SpreadRows",
    "StartPhase",
    "StraightPath",
    "StripmapWorld",
    "Sway",
    "TaylorRange",
    "Together",
    "TurntableWorld",
    "UniformStartPhase",
    "VibrationSpectrum",
]
__dir__ = __all__.copy
show_briefly(globals()[name] for name in __all__)
globals().update(check_kinds(globals()[name] for name in __all__))
