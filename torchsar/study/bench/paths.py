"""Estimators of antennas on any path."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate import PathAutofocus, PathPhase, StripAutofocus
from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_path
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
from torchsar.study.bench.frame import Batch, Bench, Entry
from torchsar.study.bench.methods import entries as methods
from torchsar.study.bench.nothing import nothing
from torchsar.study.bench.pulses import PHASES, kinds, turned, white

# settings of the scenes and methods, by choice
PULSES, CELLS = 64, 64
KNOWN = ("frequency_hz", "transmitter_m", "path_reference_m")
# settings of the scenes and methods, by choice
RADAR = InverseRadar(9.6e9, 300e6, 64.0)
FLIGHT = Flight(StraightPath((-700.0, -20.0, 700.0), (0.0, 40.0, 0.0)), Sway(x=[Sinusoid(0.2, 1.5)]))
FEW = RandomPoints(20, 20.0, 16.0)
PATHLESS = ("autofocus", "pga_sca", "entropy_fixed_point", "textbook_pga", "unrolled", "uncorrected")


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
        return Batch(recording.signal, {"phase_rad": of_path(truth.values["line_of_sight_m"])}, known)

    return draw


def of_path(line_of_sight_m: Tensor) -> Tensor:
    """Phases of errors in the line of sight."""
    return 4 * math.pi / RADAR.wavelength_m * line_of_sight_m


def in_phase(found: Estimate) -> Estimate:
    """Errors in the line of sight as phases."""
    value, std = ({"phase_rad": of_path(x["line_of_sight_m"])} for x in (found.value, found.std))
    return Estimate(value, std, found.quality, found.outcome)


def path_autofocus(data: Signal, **known: Tensor) -> Estimate:
    """The stage with the recorded paths, or with one path where the data are no recording."""
    aux = simulate_path(RADAR, PathWorld(FEW, FLIGHT), PULSES, CELLS, Draws(0))[0].aux
    return in_phase(PathAutofocus()(data, **(known or {name: aux[name] for name in KNOWN})))


def strips(scene: Scene, snr_db: float, error_m: float = 1e-3) -> Callable[[int, int], Batch]:
    """Draw strips with errors of navigation."""

    def draw(trials: int, seed: int) -> Batch:
        recording, truth = of_strips.strips(scene, snr_db, error_m, trials, seed)
        known = {name: recording.aux[name] for name in KNOWN}
        phase = of_path(truth.values["line_of_sight_m"])
        return Batch(recording.signal, {"phase_rad": phase.where(of_strips.judged(), torch.nan)}, known)

    return draw


def strip_signal(x: Tensor) -> Signal:
    """Profiles of the strip with the axes of the radar."""
    return Signal(x.to(torch.complex64), of_strips.RADAR.raw_axes(*x.shape[-2:]))


def strip_autofocus(data: Signal, **known: Tensor) -> Estimate:
    """The stage with the recorded paths, or with one path where the data are no recording."""
    known = known or {name: of_strips.strips()[0].aux[name] for name in KNOWN}
    return in_phase(StripAutofocus(**of_strips.STRIP)(data, **known))


def pathless(run: Callable[[Signal], Any]) -> Callable[..., Any]:
    """A method that does not know the path."""
    return lambda data, **_: run(data)


def entries() -> list[Entry]:
    """Estimators of antennas on any path, and those that know no path, in the same scenes."""
    levels = (-20.0, -10.0, 0.0, 10.0, 20.0, 40.0)
    speckle, point = Speckle(800, 20.0, 16.0), Points([3.0], [-2.0], random_phase=True)
    empty = nothing((PULSES, CELLS), signal)
    white_phases = kinds(
        "spotlight, white phases",
        *(("own", drawn(FEW, snr), snr) for snr in levels),
        ("clutter", drawn(speckle, 10.0), 10.0),
        ("one point", drawn(point, -5.0), -5.0),
    )
    walks = kinds(
        "spotlight, errors of the path",
        *(("errors of the path", flown(FEW, snr), snr) for snr in levels),
        ("errors of the path, clutter", flown(speckle, 10.0), 10.0),
        ("errors of the path, one point", flown(point, -5.0), -5.0),
    )
    strip = kinds(
        "strip",
        *(("strip", strips(of_strips.POINTS, snr), snr) for snr in levels),
        ("strip, one point", strips(point, 0.0), 0.0),
    )
    # without a correction the phases of errors of 1 mm are nearly of use
    astray = kinds(
        "strip, errors of 3 mm", *(("strip, 3 mm", strips(of_strips.POINTS, snr, 3e-3), snr) for snr in (0.0, 20.0))
    )
    nowhere = nothing((of_strips.PULSES, of_strips.CELLS), strip_signal)
    return [
        Entry("PathPhase", phase, (*empty, *white_phases), PHASES),
        Entry("PathAutofocus", path_autofocus, (*empty, *walks), PHASES),
        Entry("StripAutofocus", strip_autofocus, (*nowhere, *strip, *astray), PHASES),
        *(
            Entry(one.name, pathless(one.run), (*empty, *white_phases, *walks, *astray), PHASES)
            for one in methods()
            if one.name in PATHLESS
        ),
    ]


BENCH = Bench("path", "phases of antennas on any path", entries, per_pulse=True)
