"""Benchmark `alignment`: range shifts and gains of the pulses of a target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchsar.compensate import AlignEnvelopes, align_envelopes, pulse_gain
from torchsar.core import Draws, Estimate
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World, rms
from torchsar.study.bench.nothing import nothing, unlit
from torchsar.study.bench.pulses import (
    CELLS,
    F64,
    LADAR,
    PULSES,
    SINGLE,
    clutter,
    noisy,
    observed,
    signal,
    still,
    turned,
    white,
)


def _clutter(trials: int, seed: int) -> Batch:
    """Draw homogeneous clutter, which has no range profiles."""
    return Batch(observed(clutter(0.6), 10.0)(trials, seed).data.data, None)


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


def gains(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw focused scenes whose pulses have random gains of 2 dB."""

    def draw(trials: int, seed: int) -> Batch:
        gain = 10 ** (0.1 * Draws(seed, trials=range(trials)).normal("gain", (PULSES,)))
        data = still(trials, PULSES, CELLS, 1, 0.5, seed) * gain[..., None]
        return Batch(noisy(data, snr_db, seed + 2).to(SINGLE), {"gain": gain})

    return draw


def shift_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of shifts without their mean, which displaces the whole image."""
    off = found - truth
    return rms(off - off.mean(-1, keepdim=True))


def gain_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of the logarithm of gains without its mean."""
    off = torch.log(found.double().clamp_min(1e-9) / truth)
    return rms(off - off.mean(-1, keepdim=True))


# worlds, with settings by choice
WORLDS = (
    *unlit(nothing((PULSES, 128))),
    *(World("direct", aligned(snr, 3.0), snr) for snr in SNR_DB),
    World("clutter", _clutter, 10.0),
    World("far", aligned(10.0, 40.0), 10.0),
    *(World("even rows", aligned(snr, 3.0, even=True), snr) for snr in (10.0, 40.0)),
)


def entries() -> list[Entry]:
    """Methods of alignment, and the gain of pulses."""
    shifts = [Quantity("shift_cells", 0.5, shift_error, 0.02)]
    aligners = {
        "align_envelopes": align_envelopes,
        "align_envelopes:single": partial(align_envelopes, method="single"),
        "align_envelopes:amplitude": partial(align_envelopes, method="amplitude"),
        "align_envelopes:running": partial(align_envelopes, method="running"),
        "AlignEnvelopes": _in_cells,
    }
    return [
        *(Entry(name, method, WORLDS, shifts) for name, method in aligners.items()),
        Entry(
            "pulse_gain",
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


BENCH = Bench("alignment", "range shifts and gains of pulses", entries)
