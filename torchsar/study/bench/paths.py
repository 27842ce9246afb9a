"""Estimators of antennas on any path."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.compensate import PathAutofocus, PathPhase, StripAutofocus
from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_path
from torchsar.metrics import phase_rmse
from torchsar.radar import InverseRadar
from torchsar.scene import (
    Flight,
    Navigation,
    PathWorld,
    Points,
    RandomPoints,
    RandomWalk,
    Scene,
    Sinusoid,
    Speckle,
    StraightPath,
    Sway,
)
from torchsar.study.bench import beside as of_strips
from torchsar.study.bench.frame import Batch, Bench, Entry, Quantity, World
from torchsar.study.bench.nothing import nothing
from torchsar.study.bench.pulses import PHASES, turned, white

# settings of the scenes and methods, by choice
PULSES, CELLS = 64, 64
KNOWN = ("frequency_hz", "transmitter_m", "path_reference_m")
# settings of the scenes and methods, by choice
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


def phase(data: Signal) -> Estimate:
    """The stage with the recorded path, which is the same in all worlds."""
    aux = simulate_path(RADAR, PathWorld(FEW, FLIGHT), PULSES, CELLS, Draws(0))[0].aux
    return PathPhase()(data, **{name: aux[name] for name in KNOWN})


def flown(scene: Scene, snr_db: float) -> Callable[[int, int], Batch]:
    """Draw scenes and paths that navigation records with random walks of 1 cm."""

    def draw(trials: int, seed: int) -> Batch:
        walk = [RandomWalk(0.01 * math.sqrt(6), 1 / PULSES)]
        world = PathWorld(scene, FLIGHT, navigation=Navigation(Sway(walk, walk, walk)), snr_db=snr_db)
        recording, truth = simulate_path(
            RADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)), dtype=torch.complex64
        )
        known = {name: recording.aux[name] for name in KNOWN}
        return Batch(recording.signal, {"line_of_sight_m": truth.values["line_of_sight_m"]}, known)

    return draw


def path_autofocus(data: Signal, **known: Tensor) -> Estimate:
    """The stage with the recorded paths, or with one path where the data are no recording."""
    aux = simulate_path(RADAR, PathWorld(FEW, FLIGHT), PULSES, CELLS, Draws(0))[0].aux
    return PathAutofocus()(data, **(known or {name: aux[name] for name in KNOWN}))


def strips(scene: Scene, snr_db: float) -> Callable[[int, int], Batch]:
    """Draw strips with errors of navigation of 1 mm."""

    def draw(trials: int, seed: int) -> Batch:
        recording, truth = of_strips.strips(scene, snr_db, trials=trials, seed=seed)
        known = {name: recording.aux[name] for name in KNOWN}
        return Batch(recording.signal, {"line_of_sight_m": truth.values["line_of_sight_m"]}, known)

    return draw


def strip_signal(x: Tensor) -> Signal:
    """Profiles of the strip with the axes of the radar."""
    return Signal(x.to(torch.complex64), of_strips.RADAR.raw_axes(*x.shape[-2:]))


def strip_autofocus(data: Signal, **known: Tensor) -> Estimate:
    """The stage with the recorded paths, or with one path where the data are no recording; values
    at the pulses that see the strip.
    """
    known = known or {name: of_strips.strips()[0].aux[name] for name in KNOWN}
    found = StripAutofocus(**of_strips.STRIP)(data, **known)
    seen = of_strips.judged()
    value, std = ({key: x[..., seen] for key, x in of.items() if x.ndim == 2} for of in (found.value, found.std))
    return Estimate(value, std, found.quality, found.outcome)


def abeam(found: Tensor, truth: Tensor) -> Tensor:
    """`apart` of the pulses that see the strip."""
    return apart(found, truth[..., of_strips.judged()])


def apart(found: Tensor, truth: Tensor) -> Tensor:
    """Rms of the line of sight modulo half a wavelength, without constant and linear terms."""
    radians = 4 * math.pi / RADAR.wavelength_m
    return phase_rmse(found * radians, truth.double() * radians) / radians


# a residual of 0.47 rad, as for the phases of pulses
LINE_OF_SIGHT = (Quantity("line_of_sight_m", 0.47 * RADAR.wavelength_m / (4 * math.pi), apart),)
ABEAM = (Quantity("line_of_sight_m", 0.47 * RADAR.wavelength_m / (4 * math.pi), abeam),)


def entries() -> list[Entry]:
    """Entries of the estimators of antennas on any path."""
    worlds = (
        *nothing((PULSES, CELLS), signal),
        *(World("own", drawn(FEW, snr), snr) for snr in (-20.0, -10.0, 0.0, 10.0, 20.0, 40.0)),
        World("clutter", drawn(Speckle(800, 20.0, 16.0), 10.0), 10.0),
        World("one point", drawn(Points([3.0], [-2.0], random_phase=True), -5.0), -5.0),
    )
    paths = (
        *nothing((PULSES, CELLS), signal),
        *(World("own", flown(FEW, snr), snr) for snr in (-20.0, -10.0, 0.0, 10.0, 20.0, 40.0)),
        World("clutter", flown(Speckle(800, 20.0, 16.0), 10.0), 10.0),
        World("one point", flown(Points([3.0], [-2.0], random_phase=True), -5.0), -5.0),
    )
    size = (of_strips.PULSES, of_strips.CELLS)
    seen = (
        *nothing(size, strip_signal),
        *(World("own", strips(of_strips.POINTS, snr), snr) for snr in (-20.0, -10.0, 0.0, 10.0, 20.0, 40.0)),
        World("one point", strips(Points([3.0], [-2.0], random_phase=True), 0.0), 0.0),
    )
    return [
        Entry("PathPhase", phase, worlds, PHASES, share=0.1),
        Entry("PathAutofocus", path_autofocus, paths, LINE_OF_SIGHT, share=0.1),
        Entry("StripAutofocus", strip_autofocus, seen, ABEAM, share=0.05),
    ]


BENCH = Bench("path", "phases and errors of antennas on any path", entries)
