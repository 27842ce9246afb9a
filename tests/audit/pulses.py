"""Estimators of pulse phases, range shifts and gains of a target that turns uniformly."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from tests.audit.frame import SNR_DB, Batch, Entry, Quantity, World, nothing, rms, unlit
from tests.compensate.scenes import noisy, still, turned, white
from tests.direct.inverse import Ladar, echo
from torchsar.compensate import (
    AlignEnvelopes,
    Autofocus,
    EntropyFixedPoint,
    LinkPhases,
    Pga,
    PgaSca,
    PhasePolish,
    Sca,
    SharpestPhase,
    align_envelopes,
    pulse_gain,
    sharpest_phase,
)
from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_turntable
from torchsar.focus import compress_dechirped
from torchsar.metrics import phase_rmse
from torchsar.radar import InverseRadar
from torchsar.scene import Aircraft, Points, TurntableWorld, UniformStartPhase

F64, SINGLE = torch.float64, torch.complex64
PULSES, CELLS = 128, 48
ROTATION_RAD_S = 0.016
LADAR = InverseRadar(193.4e12, 150e9, 2000.0, ROTATION_RAD_S)


def signal(x: Tensor) -> Signal:
    """Pulses with the axes of the ladar."""
    return Signal(x.to(SINGLE), LADAR.raw_axes(*x.shape[-2:]))


def aircraft(snr_db: float | None) -> Callable[[int, int], Batch]:
    """Draw aircraft with a white phase error."""

    def draw(trials: int, seed: int) -> Batch:
        world = TurntableWorld(Aircraft(), start_phase=[UniformStartPhase()], snr_db=snr_db)
        recording, truth = simulate_turntable(LADAR, world, PULSES, 192, Draws(seed, trials=range(trials)))
        return Batch(recording.signal, {"phase_rad": truth.values["phase_rad"]})

    return draw


def dechirped(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw dechirped pulses of small aircraft by an independent generator, with white phases."""
    known = Ladar(LADAR.carrier_hz, LADAR.bandwidth_hz, LADAR.prf_hz, ROTATION_RAD_S, pulses=PULSES, cells=96)
    radar = replace(LADAR, pulse_s=known.pulse_s)

    def draw(trials: int, seed: int) -> Batch:
        scenes = [Aircraft(4e-3, 0.08, 0.06).scatterers(Draws(seed + i)) for i in range(trials)]
        raw = torch.stack([echo(known, s.azimuth_m, s.range_m, s.amplitude) for s in scenes])
        phase = white(trials, PULSES, seed + 1)
        data = turned(noisy(compress_dechirped(raw, radar), snr_db, seed + 2), phase)
        return Batch(signal(data), {"phase_rad": phase})

    return draw


def one_point(trials: int, seed: int) -> Batch:
    """Draw a single point with a white phase error."""
    scene = Points([0.01], [0.0], random_phase=True)
    world = TurntableWorld(scene, start_phase=[UniformStartPhase()], snr_db=-5.0)
    recording, truth = simulate_turntable(LADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)))
    return Batch(recording.signal, {"phase_rad": truth.values["phase_rad"]})


def direct(
    snr_db: float, per_row: int = 3, width: float = 0.5, cells: int = CELLS, lit: float = 1.0
) -> Callable[[int, int], Batch]:
    """Draw sums of points in every cell, with white phases, by plain formulas."""

    def draw(trials: int, seed: int) -> Batch:
        clean = still(trials, PULSES, cells, per_row, width, seed)
        clean = clean * (torch.arange(PULSES, dtype=F64) < lit * PULSES)[:, None]
        phase = white(trials, PULSES, seed + 1)
        return Batch(signal(turned(noisy(clean, snr_db, seed + 2), phase)), {"phase_rad": phase})

    return draw


def clutter(snr_db: float, width: float) -> Callable[[int, int], Batch]:
    """Draw homogeneous clutter over a share of the Doppler band, with white phases."""

    def draw(trials: int, seed: int) -> Batch:
        generator = torch.Generator().manual_seed(seed)
        long = 4 * PULSES
        spectrum = torch.view_as_complex(torch.randn(trials, long, CELLS, 2, generator=generator, dtype=F64))
        inside = torch.fft.fftfreq(long, dtype=F64).abs() < width / 2
        clean = torch.fft.ifft(spectrum * inside[:, None], dim=-2)[:, :PULSES]
        phase = white(trials, PULSES, seed + 1)
        return Batch(signal(turned(noisy(clean, snr_db, seed + 2), phase)), {"phase_rad": phase})

    return draw


def aligned(snr_db: float, size: float, even: bool = False) -> Callable[[int, int], Batch]:
    """Draw targets of 24 points within 64 range cells, at any range or in 8 cells with `even`
    spacing, whose pulses drift in range along a parabola of `size` cells.
    """

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed + 9, trials=range(trials))
        u = torch.linspace(-1, 1, PULSES, dtype=F64)
        curve = size * (
            draws.uniform("slope", (), -1, 1)[:, None] * u + draws.uniform("bend", (), -1, 1)[:, None] * u**2
        )
        where, turns = draws.uniform("range", (24,), -32, 32), draws.uniform("cross range", (24,), -0.25, 0.25)
        where = 8 * (where / 8).floor() if even else where
        amplitude = draws.normal("amplitude", (24,), torch.complex128)
        at = torch.fft.fftfreq(128, dtype=F64) * (where[..., None, None] + 64 + curve[:, None, :, None])
        pulses = torch.polar(
            torch.ones((), dtype=F64), 2 * math.pi * (turns[..., None] * torch.arange(PULSES, dtype=F64))
        )
        spectrum = torch.einsum("tk,tkp,tkpf->tpf", amplitude, pulses, torch.exp(-2j * math.pi * at))
        phase = white(trials, PULSES, seed + 1)
        data = turned(math.sqrt(128) * torch.fft.ifft(spectrum), phase)
        return Batch(noisy(data, snr_db, seed + 2).to(SINGLE), {"shift_cells": curve})

    return draw


def _points(draws: Draws, count: int, course: Tensor | float = 0.0, history: Tensor | None = None) -> Tensor:
    """Draw points at any range and cross range, (trial, pulse, range).

    course: Displacement of the pulses in range cells, (..., pulse, 1).
    history: Complex factors of the points, (trial, point, pulse).
    """
    where, turns = draws.uniform("range", (count,), 0, CELLS), draws.uniform("cross range", (count,), -0.4, 0.4)
    pulses = torch.exp(2j * math.pi * turns[..., None] * torch.arange(PULSES, dtype=F64))
    pulses = pulses * draws.normal("amplitude", (count,), torch.complex128)[..., None]
    frequency = torch.fft.fftfreq(CELLS, dtype=F64)
    at = torch.exp(-2j * math.pi * frequency * where[..., None])
    spectrum = torch.einsum("tkp,tkf->tpf", pulses if history is None else pulses * history, at)
    return CELLS**0.5 * torch.fft.ifft(spectrum * torch.exp(-2j * math.pi * course * frequency))


def another(snr_db: float, points: int) -> Callable[[int, int], Batch]:
    """Draw scenes of points that are others from some pulse on; their phases cannot be compared."""

    def draw(trials: int, seed: int) -> Batch:
        before, after = (_points(Draws(seed + k, trials=range(trials)), points) for k in (9, 509))
        change = Draws(seed, trials=range(trials)).uniform("change", (), PULSES / 4, 3 * PULSES / 4)
        scene = torch.where((torch.arange(PULSES) < change[:, None])[..., None], before, after)
        return Batch(signal(turned(noisy(scene, snr_db, seed + 2), white(trials, PULSES, seed + 1))), None)

    return draw


def scintillating(snr_db: float, points: int, pulses: float) -> Callable[[int, int], Batch]:
    """Draw points whose complex amplitudes change at random within so many pulses."""

    def draw(trials: int, seed: int) -> Batch:
        draws, keep = Draws(seed + 9, trials=range(trials)), math.exp(-1 / pulses)
        steps = draws.normal("scintillation", (points, PULSES), torch.complex128)
        values = [steps[..., 0]]
        for step in steps[..., 1:].unbind(-1):
            values.append(keep * values[-1] + math.sqrt(1 - keep**2) * step)
        scene = _points(draws, points, history=torch.stack(values, -1))
        phase = white(trials, PULSES, seed + 1)
        return Batch(signal(turned(noisy(scene, snr_db, seed + 2), phase)), {"phase_rad": phase})

    return draw


def walking(snr_db: float, points: int, pulses: float) -> Callable[[int, int], Batch]:
    """Draw points that stay visible while their phases walk at random within so many pulses."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed + 9, trials=range(trials))
        walk = math.sqrt(2 / pulses) * draws.normal("walk", (points, PULSES)).cumsum(-1)
        phase = white(trials, PULSES, seed + 1)
        scene = _points(draws, points, history=torch.exp(1j * walk))
        return Batch(signal(turned(noisy(scene, snr_db, seed + 2), phase)), {"phase_rad": phase})

    return draw


def displaced(snr_db: float, points: int, jitter: float) -> Callable[[int, int], Batch]:
    """Draw points whose pulses are displaced in range by `jitter` cells rms, with white phases."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed + 9, trials=range(trials))
        moved = _points(draws, points, jitter * draws.normal("displacement", (PULSES, 1)))
        phase = white(trials, PULSES, seed + 1)
        return Batch(signal(turned(noisy(moved, snr_db, seed + 2), phase)), {"phase_rad": phase})

    return draw


def gains(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw focused scenes whose pulses have random gains of 2 dB."""

    def draw(trials: int, seed: int) -> Batch:
        gain = 10 ** (0.1 * Draws(seed, trials=range(trials)).normal("gain", (PULSES,)))
        data = still(trials, PULSES, CELLS, 1, 0.5, seed) * gain[..., None]
        return Batch(noisy(data, snr_db, seed + 2).to(SINGLE), {"gain": gain})

    return draw


def phase_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error without constant and linear phase, which only displace the image."""
    return phase_rmse(found, truth)


def shift_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of shifts without their mean, which displaces the whole image."""
    off = found - truth
    return rms(off - off.mean(-1, keepdim=True))


def gain_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of the logarithm of gains without its mean."""
    off = torch.log(found.double().clamp_min(1e-9) / truth)
    return rms(off - off.mean(-1, keepdim=True))


PHASES = [Quantity("phase_rad", 0.5, phase_error, 0.005)]
WORLDS = (
    *nothing((PULSES, CELLS), signal),
    *(World("own", aircraft(snr), snr) for snr in (-30.0, -20.0, -10.0, -5.0, 0.0, 20.0, 60.0)),
    World("clutter 60 %", clutter(5.0, 0.6), 5.0),
    World("clutter 90 %", clutter(10.0, 0.9), 10.0),
    World("one point", one_point, -5.0),
    World("one row", direct(10.0, cells=1), 10.0),
    World("few points", direct(10.0, 1, cells=4), 10.0),
    World("many points", direct(10.0, 40), 10.0),
    World("partly lit", direct(10.0, lit=0.6), 10.0),
    World("aliased", direct(10.0, 3, 1.5), 10.0),
    World("direct", direct(10.0), 10.0),
    World("direct", direct(-10.0), -10.0),
    *(World("direct pulses", dechirped(snr), snr) for snr in (-5.0, 10.0)),
    *(World(f"displaced {points} points", displaced(15.0, points, 0.6), 15.0) for points in (6, 60)),
    *(World(f"another scene of {points} points", another(20.0, points), 20.0) for points in (8, 40)),
    *(
        World(f"scintillating {points} points", scintillating(snr, points, 16.0), snr)
        for points in (8, 40)
        for snr in (0.0, 20.0)
    ),
    *(World("walking 3 points", walking(snr, 3, 40.0), snr) for snr in (5.0, 20.0)),
)
ALIGN_WORLDS = (
    *unlit(nothing((PULSES, 128))),
    *(World("direct", aligned(snr, 3.0), snr) for snr in SNR_DB),
    World("clutter", lambda trials, seed: Batch(clutter(10.0, 0.6)(trials, seed).data.data, None), 10.0),
    World("far", aligned(10.0, 40.0), 10.0),
    *(World("even rows", aligned(snr, 3.0, even=True), snr) for snr in (10.0, 40.0)),
)


def entries() -> list[Entry]:
    """Entries of the pulse-phase and alignment estimators."""
    phases = {
        "Sca": Sca(),
        "Pga": Pga(),
        "PgaSca": PgaSca(),
        "PgaSca:synchronised": PgaSca("synchronised", "measured"),
        "EntropyFixedPoint": EntropyFixedPoint(),
        "LinkPhases": LinkPhases(),
        "SharpestPhase": SharpestPhase(steps=60),
        "SharpestPhase:contrast": lambda x: sharpest_phase(x.data, objective="contrast", steps=60),
        "Autofocus": Autofocus(),
        "PhasePolish": PhasePolish(),
    }
    shifts = [Quantity("shift_cells", 0.5, shift_error, 0.02)]
    aligners = {
        "align_envelopes": align_envelopes,
        "align_envelopes:single": partial(align_envelopes, method="single"),
        "align_envelopes:amplitude": partial(align_envelopes, method="amplitude"),
        "align_envelopes:running": partial(align_envelopes, method="running"),
        "AlignEnvelopes": lambda x: _in_cells(x),
    }
    return [
        *(Entry(f"compensate.{n}", f, WORLDS, PHASES) for n, f in phases.items()),
        *(Entry(f"compensate.{n}", f, ALIGN_WORLDS, shifts) for n, f in aligners.items()),
        Entry(
            "compensate.pulse_gain",
            pulse_gain,
            (*nothing((PULSES, CELLS)), *(World("direct", gains(snr), snr) for snr in SNR_DB)),
            [Quantity("gain", math.log(10) / 20, gain_error, 0.02)],  # 1 dB
        ),
    ]


def _in_cells(x: Tensor) -> Estimate:
    """The alignment stage with its shifts in cells."""
    found = AlignEnvelopes()(signal(x))
    cell = LADAR.raw_axes(*x.shape[-2:])[1].step
    return replace(
        found,
        value={"shift_cells": found["shift_m"] / cell},
        std={"shift_cells": found.std["shift_m"] / cell},
    )
