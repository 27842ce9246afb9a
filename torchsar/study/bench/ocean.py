"""Small frames of ships on a sea, and settings of the imaging that suit them."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from torchsar.core import Draws, Signal
from torchsar.echo import simulate_bistatic
from torchsar.multichannel import Detector, Extraction, ImageMovers
from torchsar.scene import BandLimited, BistaticWorld, Fleet, KSea, Ship
from torchsar.study.bench.direct.moving import published_radar

# settings of the scenes and methods, by choice
GATE_S = 2.0
EXTRACTION = Extraction(along_m=60.0, range_m=30.0, integration_s=GATE_S, segment_s=0.4)
RADAR = published_radar()


def ship(u_r=8.0, u_a=0.0, **values) -> Ship:
    return Ship(u_r, u_a, **{"length_m": 40.0, "range_cells": 2, "count": 6, "level_db": 20.0, **values})


def frame_of(ships: Mapping[str, Ship], seed=1, pulses=540, lines=120, sea=True, dtype=torch.complex64) -> Signal:
    """Return channels (channel, pulse, range) with noise of -30 dB and a sea of 0 dB."""
    world = BistaticWorld(
        Fleet(ships) if ships else None, BandLimited(GATE_S), KSea(shape=1.5) if sea else None, snr_db=30.0
    )
    return simulate_bistatic(RADAR, world, pulses, lines, Draws(seed), dtype=dtype)[0].signal


def flow(**values) -> ImageMovers:
    """Return the imaging stage with the conventional image only, enough for bright ships."""
    return ImageMovers(
        RADAR, **{"extraction": EXTRACTION, "detector": Detector(suppressed_m_s=()), "u_a_half_m_s": 12.0, **values}
    )
