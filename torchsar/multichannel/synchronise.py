"""Errors of phase and time between the clocks of transmitter and receiver, seen in the direct path
and taken out of every channel.

The satellite's signal also reaches the receiver directly. Its range is known from the ephemeris, so
that what is left of phase and delay after compression is the error of the clocks, one of each per
pulse, common to all channels. Source: brief 001; own estimator (maximum likelihood for one echo of
a known band).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, linear_phasor, unit_phasor
from torchsar.radar import BistaticRadar

_OVERSAMPLING, _NEWTON = 4, 4
_LEAST_SNR = 10.0


def estimate_synchronisation(direct: Tensor, radar: BistaticRadar) -> Estimate:
    """`phase_rad` in -pi..pi and `delay_s` (..., pulse) of the direct path: data carry exp(j phase)
    and come later by the delay.

    direct: complex (..., pulse, sample), range compressed at the sampling rate of the echoes, a
    rectangular band of the pulse's width whose peak lies at sample n // 2 when the clocks agree. Of
    maximum likelihood, pulse by pulse. info: `snr_db` (..., pulse) of the compressed peak over the
    noise in the band. Not ok: a trial with a pulse below 10 dB, whose values are then those of
    noise; such pulses have zeros. Raises ValueError for direct paths of fewer than 8 samples.
    """
    if not direct.is_complex() or direct.ndim < 2 or direct.shape[-1] < 8:
        raise ValueError(
            "estimate_synchronisation works on a complex direct path (..., pulse, sample) of 8 "
            f"samples or more, got {direct.dtype} of shape {tuple(direct.shape)}"
        )
    band, frequency = _direct_band(direct, radar)
    delay = _refined_delay(band, frequency, _coarse_delay(direct, radar))
    peak = (band * unit_phasor(delay[..., None] * frequency, band.dtype)).sum(-1)
    snr = _snr(band, peak)
    seen = snr >= _LEAST_SNR
    phase_std = (2 * snr).clamp_min(0.05).rsqrt()
    std = {"phase_rad": phase_std, "delay_s": phase_std / (2 * math.pi * frequency.square().mean().sqrt())}
    value = {"phase_rad": torch.where(seen, torch.angle(peak), 0.0), "delay_s": torch.where(seen, delay, 0.0)}
    quality = (1 - phase_std.square().mean(-1).sqrt()).clamp(0, 1)
    return Estimate(value, quality, seen.all(-1), std, {"snr_db": 10 * torch.log10(snr.clamp_min(1e-6))})


def _direct_band(direct: Tensor, radar: BistaticRadar) -> tuple[Tensor, Tensor]:
    """Spectrum of the direct path in the pulse's band against its middle sample, complex128 (...,
    pulse, frequency), and the frequencies (Hz).
    """
    n = direct.shape[-1]
    spectrum = torch.fft.fft(torch.fft.ifftshift(direct.to(torch.complex128), dim=-1))
    frequency = radar.range_frequency_hz(n, direct.device)
    inside = frequency.abs() <= radar.pulse.bandwidth_hz / 2
    return spectrum[..., inside], frequency[inside]


def _coarse_delay(direct: Tensor, radar: BistaticRadar) -> Tensor:
    """Delay (s) of the strongest of finely interpolated samples, (..., pulse)."""
    n = direct.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(direct), dim=-1)
    fine = torch.fft.ifft(torch.nn.functional.pad(spectrum, (0, (_OVERSAMPLING - 1) * n))).abs()
    return (fine.argmax(-1).to(torch.float64) / _OVERSAMPLING - n // 2) / radar.sampling_hz


def _refined_delay(band: Tensor, frequency: Tensor, delay: Tensor) -> Tensor:
    """Newton's method on the power |sum_f X(f) exp(j 2 pi f delay)|^2, within a quarter of a sample
    of the start.
    """
    rate = 2j * math.pi * frequency
    reach = 0.5 / (frequency.max() - frequency.min())
    start = delay
    for _ in range(_NEWTON):
        turned = band * unit_phasor(delay[..., None] * frequency, band.dtype)
        p, slope, bend = turned.sum(-1), (turned * rate).sum(-1), (turned * rate.square()).sum(-1)
        first, second = (p.conj() * slope).real, (p.conj() * bend).real + slope.abs().square()
        step = torch.where(second < 0, -first / torch.where(second < 0, second, -1.0), 0.0)
        delay = start + (delay + step - start).clamp(-reach, reach)
    return delay


def _snr(band: Tensor, peak: Tensor) -> Tensor:
    """Energy of the fitted echo over the noise of one frequency, (..., pulse)."""
    n = band.shape[-1]
    fitted = peak.abs().square() / n
    noise = (band.abs().square().sum(-1) - fitted) / max(n - 2, 1)
    return fitted / torch.maximum(noise, 1e-14 * fitted).clamp_min(torch.finfo(torch.float64).tiny)


def remove_synchronisation(
    data: Tensor, radar: BistaticRadar, phase_rad: Tensor, delay_s: Tensor | None = None, with_range: bool = True
) -> Tensor:
    """Every pulse of all channels times exp(-j phase), and earlier by the delay, which moves
    envelopes only.

    data: (..., channel, pulse, range), or (..., channel, pulse) where not with_range; phase_rad,
    delay_s: float64 (..., pulse). Differentiable. Raises ValueError for errors of another number of
    pulses, or a delay of data without range.
    """
    pulses = data.shape[-2] if with_range else data.shape[-1]
    for name, value in (("phase_rad", phase_rad), ("delay_s", delay_s)):
        if value is not None and value.shape[-1:] != (pulses,):
            raise ValueError(
                f"remove_synchronisation needs {name} (..., {pulses}), one number a pulse, got shape "
                f"{tuple(value.shape)}"
            )
    turn = unit_phasor(-phase_rad.to(torch.float64) / (2 * math.pi), data.dtype)[..., None, :]
    if not with_range:
        if delay_s is not None and bool((delay_s != 0).any()):
            raise ValueError("data without a range axis cannot be shifted along it; leave delay_s out")
        return data * turn
    if delay_s is None:
        return data * turn[..., None]
    n = data.shape[-1]
    advance = torch.fft.ifftshift(linear_phasor(delay_s * (radar.sampling_hz / n), -(n // 2), n, data.dtype), dim=-1)[
        ..., None, :, :
    ]
    return torch.fft.ifft(torch.fft.fft(data * turn[..., None]) * advance)


class EstimateSynchronisation(Stage):
    """`estimate_synchronisation` of a direct path recorded beside the channels:
    `use(EstimateSynchronisation(radar), direct_path="aux.direct_path")`. The signal is left alone.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    provides = ("phase_rad", "delay_s")

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar

    def forward(self, signal: Signal, direct_path: Tensor) -> Estimate:
        if direct_path.shape[-2:-1] != (signal.axis("pulse").n,):
            raise ValueError(
                f"the direct path needs a line for each of the {signal.axis('pulse').n} pulses, got "
                f"shape {tuple(direct_path.shape)}"
            )
        return estimate_synchronisation(direct_path, self.radar)


class RemoveSynchronisation(Stage):
    """`remove_synchronisation` by values of `EstimateSynchronisation`, or known ones."""

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar) -> None:
        super().__init__()
        self.radar = radar

    def forward(self, signal: Signal, phase_rad: Tensor, delay_s: Tensor | None = None) -> Signal:
        return signal.with_data(
            remove_synchronisation(signal.data, self.radar, phase_rad, delay_s, "range" in signal.names)
        )
