"""Estimation of the amplitude of every pulse from steady scatterers, and its equalisation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare
from torchsar.core import (
    Estimate,
    Outcome,
    Stage,
    checked_samples,
    cis,
    differentiable,
    power_of,
    refuse_non_finite_values,
)

LEAST_GAIN = 0.05  # least gain of a pulse, so that a lost pulse is not amplified more than 20 times
_PAD = 4  # zero-padding of the transform, with which a peak is found to an eighth of a cell


@differentiable("where ok")
def pulse_gain(data: Tensor, *, assess: bool = True) -> Estimate:
    """Estimate the amplitude of every pulse from steady scatterers.

    >>> import torch
    >>> from torchsar.compensate import pulse_gain
    >>> gain = torch.tensor([0.9, 1.0, 1.1, 1.0])
    >>> pulses = gain[:, None] * torch.ones(4, 2, dtype=torch.complex64)
    >>> pulse_gain(pulses)["gain"]
    tensor([0.9000, 1.0000, 1.1000, 1.0000], dtype=torch.float64)

    Scintillation and pointing errors change the amplitude of the echo from pulse to pulse, which
    changes the side lobes in azimuth: a log-amplitude of 0.1 rms changes the first side lobe by a
    decibel either way. The strongest scatterer of each range cell is taken as a tone of constant
    amplitude, which explains a share of the energy of the cell. One real factor per pulse is fitted
    to the tones of all cells, each weighted with the square of its share. Differentiable, except
    for the peak search that finds the frequencies of the tones.

    Args:
        data: Range-compressed pulses after motion compensation, deramping and autofocus, of which
            only the amplitudes have errors, shape (..., pulse, range), complex.
        assess: False leaves out the outcome.

    Returns:
        `gain` of shape (..., pulse), by which each pulse is to be divided. Its mean is about one,
        and it is never below 0.05, so that a lost pulse is not amplified more than 20 times.
        `quality` is the share of the energy that the tones explain. `assess=True` adds the outcome:
        `Outcome.MISFIT` where that share is half or less, because there are no steady scatterers or
        the noise is too strong; all gains of the trial are then one.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite.
    """
    pulses = prepare(data, "pulse_gain", empty=False)
    rows, n = pulses.rows, pulses.n
    best = torch.fft.fft(rows.detach(), _PAD * n).abs().argmax(-1)
    index = torch.arange(n, dtype=torch.float64, device=rows.device)
    turns = best.to(torch.float64)[..., None] * index / (_PAD * n)
    demodulated = rows * cis((-2 * math.pi * (turns - torch.round(turns))).to(rows.real.dtype))
    level, energy = demodulated.mean(-1), power_of(rows).sum(-1)
    power = power_of(level)
    tiny = torch.finfo(power.dtype).tiny
    share = n * power / energy.clamp_min(tiny)
    explained = ((n * power).sum(-1) / energy.sum(-1).clamp_min(tiny)).detach()
    weight = share.square()
    fitted = (weight[..., None] * (demodulated * level.conj()[..., None]).real).sum(-2) / (weight * power).sum(
        -1, keepdim=True
    ).clamp_min(tiny)
    gain = fitted / fitted.mean(-1, keepdim=True).clamp_min(LEAST_GAIN)
    ok = explained > 0.5
    gain = torch.where(ok[:, None], gain.clamp_min(LEAST_GAIN), 1)
    outcome = Outcome.of(ok, Outcome.MISFIT) if assess else Outcome.NOT_ASSESSED.like(ok)
    return Estimate(
        {"gain": gain.to(torch.float64).reshape(*pulses.trials, n)},
        quality=explained.to(torch.float64).reshape(pulses.trials),
        outcome=outcome.reshape(pulses.trials),
    )


def equalise_pulses(data: Tensor, gain: Tensor) -> Tensor:
    """Divide pulses by their gains.

    >>> import torch
    >>> from torchsar.compensate import equalise_pulses
    >>> gain = torch.tensor([0.5, 1.0, 2.0])
    >>> pulses = gain[:, None] * torch.ones(3, 2, dtype=torch.complex64)
    >>> equalise_pulses(pulses, gain).abs()
    tensor([[1., 1.],
            [1., 1.],
            [1., 1.]])

    Args:
        data: Pulses, shape (..., pulse, range), complex.
        gain: Gains, shape (..., pulse).

    Returns:
        The equalised pulses, shape (..., pulse, range), complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if a gain is not positive.
    """
    data = checked_samples(data, "equalise_pulses", "pulse, range", finite=False)
    refuse_non_finite_values("equalise_pulses", gain=gain)
    if not bool((gain.detach() > 0).all()):
        raise ValueError(
            f"gain must be positive for every pulse, got {float(gain.detach().min()):g}; for a lost pulse, give a gain "
            "of 1 and set its samples to zero"
        )
    return data / gain[..., None].to(data.real.dtype)


PulseGain = Stage.of(pulse_gain, provides=("gain",), neutral={"gain": 1.0}, differentiable="where ok")
EqualisePulses = Stage.of(equalise_pulses)
