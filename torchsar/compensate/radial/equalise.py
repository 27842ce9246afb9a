"""The amplitude of every pulse against steady scatterers: scintillation and fading taken out."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare
from torchsar.core import Estimate, cis

LEAST_GAIN = 0.05
_PAD = 4


def pulse_gain(data: Tensor) -> Estimate:
    """Amplitude of every pulse, with value["gain"] (..., pulse), mean one, to be divided by.

    data: (..., pulse, range) complex, focused but for amplitudes: compensated, deramped, its phases
    corrected. Air and pointing make the echo scintillate, which changes the side lobes in azimuth
    (a log-amplitude of 0.1 rms the first one by a decibel either way). The strongest scatterer of
    each range cell is a tone of constant amplitude; one real factor a pulse is fitted to the tones
    of all cells, each weighted by the share of its cell's energy that the tone explains. Never
    below 0.05: a pulse that was lost is not blown up. Trials without steady scatterers, whose tones
    explain less than half of the energy, keep gain one and are not ok.

    quality: that share. Differentiable around the detached peaks. Raises TypeError or ValueError
    for samples that are not finite and complex.
    """
    pulses = prepare(data, "pulse_gain")
    rows, n = pulses.rows, pulses.n
    best = torch.fft.fft(rows.detach(), _PAD * n).abs().argmax(-1)
    index = torch.arange(n, dtype=torch.float64, device=rows.device)
    turns = best.to(torch.float64)[..., None] * index / (_PAD * n)
    still = rows * cis((-2 * math.pi * (turns - torch.round(turns))).to(rows.real.dtype))
    level = still.mean(-1)
    energy = (rows.real.square() + rows.imag.square()).sum(-1)
    power = level.real.square() + level.imag.square()
    tiny = torch.finfo(power.dtype).tiny
    share = n * power / energy.clamp_min(tiny)
    explained = ((n * power).sum(-1) / energy.sum(-1).clamp_min(tiny)).detach()
    weight = share.detach().square()
    fitted = (weight[..., None] * (still * level.conj()[..., None]).real).sum(-2) / (weight * power).sum(
        -1, keepdim=True
    ).clamp_min(tiny)
    gain = fitted / fitted.mean(-1, keepdim=True).clamp_min(LEAST_GAIN)
    ok = explained > 0.5
    gain = torch.where(ok[:, None], gain.clamp_min(LEAST_GAIN), 1)
    shape = pulses.trials
    return Estimate(
        {"gain": gain.to(torch.float64).reshape(*shape, n)},
        quality=explained.to(torch.float64).reshape(shape),
        ok=ok.reshape(shape),
    )


def equalise_pulses(data: Tensor, gain: Tensor) -> Tensor:
    """data (..., pulse, range) over gain (..., pulse).

    Raises ValueError where a gain is not positive.
    """
    if not bool((gain.detach() > 0).all()):
        raise ValueError(
            f"gains of pulses must be positive, got {float(gain.detach().min()):g}; mark lost pulses instead"
        )
    return data / gain[..., None].to(data.real.dtype)
