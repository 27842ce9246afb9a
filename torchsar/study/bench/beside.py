"""A short strip beside a slow antenna, whose navigation errs slowly."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth
from torchsar.echo import simulate_path
from torchsar.focus import ProcessedBeam
from torchsar.radar import AntennaPath, InverseRadar
from torchsar.scene import (
    Flight,
    Navigation,
    PathWorld,
    RandomPoints,
    Scene,
    SideBeam,
    Sinusoid,
    StraightPath,
    Sway,
    VibrationSpectrum,
)

# settings of the scenes and methods, by choice
RADAR = InverseRadar(9.6e9, 300e6, 140.0)
PULSES, CELLS = 1024, 96
FLIGHT = Flight(StraightPath((-290.0, -55.0, 75.0), (0.0, 15.0, 0.0)), Sway(x=[Sinusoid(0.5, 0.2)]))
POINTS = RandomPoints(80, 100.0, 24.0)
STRIP: dict[str, Any] = {"azimuth_m": 60.0, "range_m": 26.0, "beam_deg": 6.0}


def strips(
    scene: Scene = POINTS, snr_db: float | None = 10.0, error_m: float = 1e-3, trials: int = 1, seed: int = 1
) -> tuple[Recording, Truth]:
    """Range profiles along a path of which navigation errs in height and across the track."""
    error = [VibrationSpectrum(error_m, 0.15, 1.0)]
    navigation = Navigation(Sway(x=error, z=error))
    world = PathWorld(scene, FLIGHT, None, navigation, snr_db=snr_db, beam=SideBeam(6.0), window_range_m=300.0)
    return simulate_path(RADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)), dtype=torch.complex64)


def path_of(recording: Recording) -> AntennaPath:
    return AntennaPath(recording.aux["transmitter_m"], None, recording.aux["path_reference_m"])


def judged() -> Tensor:
    """Pulses that see the strip, bool (pulse,)."""
    corners = torch.tensor([[x, y, 0.0] for x in (-13.0, 13.0) for y in (-30.0, 30.0)], dtype=torch.float64)
    nominal = FLIGHT.nominal.position_m(torch.arange(PULSES, dtype=torch.float64) / RADAR.prf_hz)
    ends = ProcessedBeam(STRIP["beam_deg"]).lit_pulses(nominal, corners)
    number = torch.arange(PULSES)
    return (number >= ends[:, 0].min()) & (number < ends[:, 1].max())
