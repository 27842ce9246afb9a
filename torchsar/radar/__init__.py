"""Descriptions of instruments: radars and ladars, their geometry, timing, orbits and waveforms."""

from torchsar.radar.antenna_path import AntennaPath
from torchsar.radar.bistatic import BistaticRadar
from torchsar.radar.instrument import LIGHT_M_S
from torchsar.radar.inverse import InverseRadar
from torchsar.radar.ladar import TriangularLadar, sweep_middles
from torchsar.radar.local_frame import LocalFrame, geocentric
from torchsar.radar.navigation import resample_path
from torchsar.radar.orbit import Ephemeris, Orbit, range_coefficients, seen_point
from torchsar.radar.spotlight import (
    FarField,
    Spotlight,
    frequency_samples,
    geometry_of,
    range_profiles,
)
from torchsar.radar.straight_track import StraightTrack
from torchsar.radar.stripmap import StripmapRadar
from torchsar.radar.timing import TimingDiagram, timing_diagram
from torchsar.radar.waveform import LinearFM

__all__ = [
    "LIGHT_M_S",
    "AntennaPath",
    "BistaticRadar",
    "Ephemeris",
    "FarField",
    "InverseRadar",
    "LinearFM",
    "LocalFrame",
    "Orbit",
    "Spotlight",
    "StraightTrack",
    "StripmapRadar",
    "TimingDiagram",
    "TriangularLadar",
    "frequency_samples",
    "geocentric",
    "geometry_of",
    "range_coefficients",
    "range_profiles",
    "resample_path",
    "seen_point",
    "sweep_middles",
    "timing_diagram",
]
__dir__ = __all__.copy
