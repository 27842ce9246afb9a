"""What an instrument knows about itself."""

from torchsar.radar.inverse import InverseRadar
from torchsar.radar.stripmap import LIGHT_M_S, StripmapRadar
from torchsar.radar.waveform import LinearFM

__all__ = ["LIGHT_M_S", "InverseRadar", "LinearFM", "StripmapRadar"]
