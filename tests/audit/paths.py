"""Estimators of antennas on any path."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tests.audit.frame import Batch, Entry, World, nothing
from tests.audit.pulses import PHASES
from tests.compensate.scenes import turned, white
from torchsar.compensate import PathAutofocus
from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_path
from torchsar.radar import InverseRadar
from torchsar.scene import Flight, PathWorld, Points, RandomPoints, Scene, Sinusoid, Speckle, StraightPath, Sway

PULSES, CELLS = 64, 64
RADAR = InverseRadar(9.6e9, 300e6, 64.0)
FLIGHT = Flight(StraightPath((-700.0, -20.0, 700.0), (0.0, 40.0, 0.0)), Sway(x=[Sinusoid(0.2, 1.5)]))
FEW = RandomPoints(20, 20.0, 16.0)


def drawn(scene: Scene, snr_db: float) -> Callable[[int, int], Batch]:
    """Draw scenes, whose scatterers migrate through several cells, with white phases."""

    def draw(trials: int, seed: int) -> Batch:
        world = PathWorld(scene, FLIGHT, snr_db=snr_db)
        recording, _ = simulate_path(RADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)))
        phase = white(trials, PULSES, seed + 1)
        data = turned(recording.signal.data, phase).to(torch.complex64)
        return Batch(recording.signal.with_data(data), {"phase_rad": phase})

    return draw


def signal(x: Tensor) -> Signal:
    """Profiles with the axes of the radar."""
    return Signal(x.to(torch.complex64), RADAR.raw_axes(*x.shape[-2:]))


def autofocus(data: Signal) -> Estimate:
    """The stage with the recorded path, which is the same in all worlds."""
    aux = simulate_path(RADAR, PathWorld(FEW, FLIGHT), PULSES, CELLS, Draws(0))[0].aux
    known = {name: aux[name] for name in ("frequency_hz", "transmitter_m", "path_reference_m")}
    return PathAutofocus()(data, **known)


def entries() -> list[Entry]:
    """Entries of the estimators of antennas on any path."""
    worlds = (
        *nothing((PULSES, CELLS), signal),
        *(World("own", drawn(FEW, snr), snr) for snr in (-20.0, -10.0, 0.0, 10.0, 20.0, 40.0)),
        World("clutter", drawn(Speckle(800, 20.0, 16.0), 10.0), 10.0),
        World("one point", drawn(Points([3.0], [-2.0], random_phase=True), -5.0), -5.0),
    )
    return [Entry("compensate.PathAutofocus", autofocus, worlds, PHASES, share=0.1)]
