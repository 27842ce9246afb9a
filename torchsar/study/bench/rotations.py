"""Estimators of a non-uniform rotation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate import (
    CoarseRotation,
    CorrectPulsePhase,
    EntropyObjective,
    EntropyRotation,
    RotationAutofocus,
    UnevenRotation,
)
from torchsar.core import Alternate, Draws, Signal, Turn
from torchsar.echo import simulate_turntable
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import warp
from torchsar.scene import Aircraft, PolynomialRotation, Satellite, TurntableWorld, UniformStartPhase
from torchsar.study.bench.direct.turntable import Turntable
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World
from torchsar.study.bench.nothing import nothing

F64 = torch.float64
WIDTH_M, DEPTH_M = 0.6, 5.2  # of targets; their Doppler fills 90 % of the band at the end
OMEGA, K = 0.02, torch.tensor([10.0, 1000.0], dtype=F64)
TABLE = Turntable(24e3, 480, 16, 0.45, 60, WIDTH_M / 2, DEPTH_M / 2)
RADAR = InverseRadar(LIGHT_M_S / TABLE.wavelength_m, LIGHT_M_S / (2 * TABLE.cell_m), TABLE.prf_hz)
TIMES_S = torch.arange(TABLE.pulses, dtype=F64) / TABLE.prf_hz
ORDER = EntropyObjective(order=3, range_term=False, oversampling=2.0)


def signal(x: Tensor) -> Signal:
    """Pulses with the axes of the radar, in single precision."""
    return Signal(x.to(torch.complex64), RADAR.raw_axes(*x.shape[-2:]))


def points(seed: int = 0, count: int = 30) -> tuple[Tensor, Tensor, Tensor]:
    """Cross range over 0.6 m, range over 5.6 m, complex amplitudes of 0.5 to 1.5."""
    source = torch.Generator().manual_seed(seed)
    x, y, level, phase = (torch.rand(count, generator=source, dtype=F64) for _ in range(4))
    return 0.6 * (x - 0.5), 5.6 * (y - 0.5), torch.polar(0.5 + level, 2 * math.pi * phase)


def truth_of(trials: int, **more: Tensor) -> dict[str, Tensor]:
    """True rotation of every trial."""
    return {
        "omega_rad_s": torch.full((trials,), OMEGA, dtype=F64),
        "warp_k": K.expand(trials, -1),
        "k1_per_s": K[0].expand(trials),
        "k2_per_s2": K[1].expand(trials),
        **more,
    }


def direct(snr_db: float, count: int | None = None, row: bool = False, lit: float = 1.0) -> Callable[[int, int], Batch]:
    """Draw satellites, or `count` points, by the generator of direct sums."""

    def draw(trials: int, seed: int) -> Batch:
        data = []
        for i in range(seed, seed + trials):
            x, y, amplitude = TABLE.satellite(i) if count is None else points(i, count)
            x = x * (WIDTH_M / 2 / x.abs().max())  # targets reach the edge, where errors are judged
            clean = TABLE.echo(x, 0.0 * y if row else y, amplitude) * (lit * TIMES_S[-1] > TIMES_S)[:, None]
            data.append(TABLE.noisy(clean, snr_db, 1000 + i)[0])
        return Batch(signal(torch.stack(data)), truth_of(trials))

    return draw


def clutter(trials: int, seed: int) -> Batch:
    """Draw many weak scatterers over the whole Doppler band in every cell."""
    return direct(10.0, 800)(trials, seed)


def satellite(snr_db: float, phases: bool = False) -> Callable[[int, int], Batch]:
    """Draw satellites with our own simulator."""

    def draw(trials: int, seed: int) -> Batch:
        world = TurntableWorld(
            Satellite(TABLE.count, WIDTH_M / 2, DEPTH_M / 2),
            rotation=PolynomialRotation(OMEGA, K.tolist()),
            snr_db=snr_db,
            start_phase=[UniformStartPhase()] if phases else [],
        )
        recording, truth = simulate_turntable(
            RADAR, world, TABLE.pulses, TABLE.cells, Draws(seed, trials=range(trials))
        )
        if not phases:
            return Batch(recording.signal, truth_of(trials))
        known = {"omega_rad_s": torch.full((trials,), OMEGA, dtype=F64), "warp_k": K.expand(trials, -1)}
        return Batch(recording.signal, truth_of(trials, phase_rad=truth.values["phase_rad"]), known)

    return draw


def aircraft(trials: int, seed: int) -> Batch:
    """Draw aircraft that turn uniformly, of a quite different ladar."""
    ladar = InverseRadar(193.4e12, 150e9, 2000.0, 0.005)
    world = TurntableWorld(Aircraft(), start_phase=[UniformStartPhase()], snr_db=10.0)
    data = simulate_turntable(ladar, world, 400, 192, Draws(seed, trials=range(trials)))[0].signal.data
    return Batch(signal(data[..., 88 : 88 + TABLE.cells]), None)


def warp_error(found: Tensor, truth: Tensor) -> Tensor:
    """Phase error in rad that wrong derivatives leave at the edge of the target, rms over time.

    A line in the warp is left out, since it displaces scatterers. A line in time is not: it blurs.
    """
    t, d = TIMES_S, found - truth
    angle = OMEGA * (d[..., :1] * t**2 / 2 + d[..., 1:2] * t**3 / 6)
    angle = angle - angle.mean(-1, keepdim=True)
    line = warp(t, K) - warp(t, K).mean()
    angle = angle - (angle * line).sum(-1, keepdim=True) / line.square().sum() * line
    return 4 * math.pi / RADAR.wavelength_m * WIDTH_M / 2 * angle.square().mean(-1).sqrt()


def off_the_warp(found: Tensor, truth: Tensor) -> Tensor:
    """Rms phase error in rad without its constant and its line in the warp, which shift the image.

    The line is the maximum of the spectrum over the warp.
    """
    error, turns = found - truth, warp(TIMES_S, K)
    angle = 2 * math.pi * turns / turns[-1]
    tables = torch.polar(torch.ones(1, dtype=F64), -torch.arange(-40, 40.005, 0.02, dtype=F64)[:, None] * angle)
    z = torch.polar(torch.ones_like(error), error)
    flat = z * tables[(z @ tables.mT).abs().argmax(-1)]
    return torch.angle(flat * flat.mean(-1, keepdim=True).conj()).square().mean(-1).sqrt()


# tolerances of use
WARP = [Quantity("warp_k", 0.5, warp_error, predicted=False)]
PARTS = [Quantity("k1_per_s", 4.0, floor=0.01), Quantity("k2_per_s2", 400.0, floor=1.0)]
RATE = [Quantity("omega_rad_s", 0.1 * OMEGA, floor=1e-6)]
PHASES_OF_WARP = [Quantity("phase_rad", 0.5, off_the_warp, 0.01)]
WORLDS = (
    *nothing((TABLE.pulses, TABLE.cells), signal),
    *(World("own", satellite(snr), snr) for snr in SNR_DB),
    World("clutter", clutter, 10.0),
    World("one point", direct(10.0, 1), 10.0),
    World("one row", direct(10.0, 12, row=True), 10.0),
    World("few points", direct(10.0, 3), 10.0),
    World("partly lit", direct(10.0, lit=0.5), 10.0),
    World("turntable", aircraft),
    World("direct", direct(20.0), 20.0),
    World("direct", direct(0.0), 0.0),
    World("direct", direct(-10.0), -10.0),
)
# settings of the scenes and methods, by choice
PHASE_WORLDS = (
    *nothing(
        (TABLE.pulses, TABLE.cells),
        signal,
        omega_rad_s=lambda x: torch.full((len(x),), OMEGA, dtype=F64),
        warp_k=lambda x: K.expand(len(x), -1),
    ),
    *(World("own", satellite(snr, True), snr) for snr in (-20.0, -10.0, 0.0, 20.0, 60.0)),
)


def entries() -> list[Entry]:
    """Entries of the rotation estimators."""
    shape = replace(ORDER, variables="shape")
    box, small = ([7.0, 700.0], [14.0, 1400.0]), {"population": 12, "generations": 8, "objective": ORDER}
    start = [9.0, 900.0]
    searches = {
        # with points of the grid near the truth, but not at it
        "EntropyRotation": EntropyRotation(RADAR, "grid", [8.0, 800.0], [12.2, 1220.0], [8, 8], objective=ORDER),
        "EntropyRotation:genetic": EntropyRotation(RADAR, "genetic", *box, **small),
        "EntropyRotation:evolution": EntropyRotation(RADAR, "evolution", *box, **small),
        "EntropyRotation:newton": EntropyRotation(RADAR, "newton", start=start, objective=replace(ORDER, taps=6)),
        "EntropyRotation:descent": EntropyRotation(RADAR, "descent", start=start, objective=shape),
    }
    far = EntropyRotation(
        RADAR, "grid", [2.0, 200.0], [20.0, 2000.0], [7, 7], objective=ORDER
    )  # no point of the grid is of use
    phase = Turn(RotationAutofocus(RADAR), CorrectPulsePhase())
    pair = Alternate(3, phase=phase, rotation=Turn(CoarseRotation(RADAR, yc_m=0.0, fits=4)))
    return [
        Entry("UnevenRotation", UnevenRotation(RADAR), WORLDS, [*PARTS, *WARP, *RATE]),
        Entry("CoarseRotation", CoarseRotation(RADAR), WORLDS, WARP),
        Entry("CoarseRotation:fits", CoarseRotation(RADAR, fits=4), WORLDS, WARP),
        *(Entry(f"{name}", stage, WORLDS, WARP) for name, stage in searches.items()),
        Entry("EntropyRotation:far", far, [world for world in WORLDS if world.name == "direct"], WARP),
        Entry("RotationAutofocus", RotationAutofocus(RADAR), PHASE_WORLDS, PHASES_OF_WARP),
        Entry("Alternate", lambda x, **_: pair(x), PHASE_WORLDS, [*PHASES_OF_WARP, *WARP]),
    ]


BENCH = Bench("rotation", "a rotation that is not uniform", entries)
