"""Descriptions of instruments: radars and ladars, their geometry, timing, orbits and waveforms.

=====================================  ============================================================
instrument or task                     what to use
=====================================  ============================================================
side-looking radar on a straight path  `StripmapRadar`, with the pulse `LinearFM`
rotating target (ISAR, ISAL)           `InverseRadar`
ladar with triangular sweeps           `TriangularLadar`; `sweep_middles` for the times of the
                                       sweeps
distant transmitter, several channels  `BistaticRadar`; `range_coefficients` for the transmit range
antennas on any path                   `AntennaPath`; `StraightTrack` for the nominal path
positions from navigation              `read_track` reads a motion log as a `Track`;
                                       `resample_path` to the times of the pulses
spotlight or turntable geometry        `Spotlight`, exact; `FarField`, plane waves; `geometry_of`
                                       from a recording
frequency samples, range profiles      `range_profiles` and `frequency_samples` change one into the
                                       other
orbit of a satellite                   `Orbit`, or `Ephemeris` with the line of sight; `seen_point`
                                       on the Earth
pulse rate of a satellite              `timing_diagram`, which returns a `TimingDiagram`
position on the Earth                  `geocentric` coordinates, `LocalFrame` about a point
speed of light                         `LIGHT_M_S`
=====================================  ============================================================
"""

from torchsar.core.kinds import check_kinds
from torchsar.core.show import show_briefly
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
from torchsar.radar.track import Track, read_track
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
    "Track",
    "TriangularLadar",
    "frequency_samples",
    "geocentric",
    "geometry_of",
    "range_coefficients",
    "range_profiles",
    "read_track",
    "resample_path",
    "seen_point",
    "sweep_middles",
    "timing_diagram",
]
__dir__ = __all__.copy
show_briefly(globals()[name] for name in __all__)
globals().update(check_kinds(globals()[name] for name in __all__))
