"""What an instrument knows about itself."""

from torchsar.radar.inverse import InverseRadar
from torchsar.radar.ladar import TriangularLadar, sweep_middles
from torchsar.radar.spotlight import FarField, PlaneWaveLoss, Spotlight, frequency_samples, geometry_of, plane_wave_loss, range_profiles
from torchsar.radar.stripmap import LIGHT_M_S, StripmapRadar
from torchsar.radar.waveform import LinearFM

__all__ = [
    "LIGHT_M_S",
    "FarField",
    "InverseRadar",
    "LinearFM",
    "PlaneWaveLoss",
    "Spotlight",
    "StripmapRadar",
    "TriangularLadar",
    "frequency_samples",
    "geometry_of",
    "plane_wave_loss",
    "range_profiles",
    "sweep_middles",
]
