"""What no estimator can beat in a triangular ladar: bounds of velocity and range, one point in
white noise (brief 000, section 6).

snr is everywhere the power of the point over the variance of the complex noise, of one sample
before compression. Functions take numbers or tensors that broadcast and return float64. With g =
samples_per_sweep * snr, every velocity bound is (lambda / 2) sqrt(c / g) / (2 pi T).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

Value = Tensor | float


def _double(value: Value) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def _velocity_m_s(c: float, snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    energy = _double(samples_per_sweep) * _double(snr)
    return _double(wavelength_m) / 2 * torch.sqrt(c / energy) / (2 * math.pi * _double(sweep_s))


def velocity_free_offset_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Bound of the velocity of one period where the phases of the up and of the down sweep are
    unknown: c = 3. Peaks of full sweeps reach it.
    """
    return _velocity_m_s(3.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_segmented_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """What phases of half sweeps reach at best (segmented interference): c = 4, a loss of
    1.25 dB.
    """
    return _velocity_m_s(4.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_known_offset_bound_m_s(
    snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value
) -> Tensor:
    """Bound where up and down sweep are known to have one phase at the turning point (exact
    trigger): c = 0.75, 7.3 dB better than segmented.
    """
    return _velocity_m_s(0.75, snr, samples_per_sweep, wavelength_m, sweep_s)


def range_per_sweep_bound_m(snr: Value, samples_per_sweep: Value, wavelength_m: Value) -> Tensor:
    """Bound of the range at one sweep from its carrier phase, all else known: lambda / (4 pi sqrt(2
    g)). It does not accumulate.
    """
    return _double(wavelength_m) / (4 * math.pi) / torch.sqrt(2 * _double(samples_per_sweep) * _double(snr))


def integrated_range_detrended_bound_m(velocity_std_m_s: Value, pulse_step_s: Value, n_period: Value) -> Tensor:
    """Rms over a record of the range that velocities with independent errors integrate to, line
    removed: std * step * sqrt(M / 15).

    A random walk: at 10 dB, 512 samples and 8 us a sweep, 1024 segmented velocities every 16 us
    give 57 nm. n_period M: 30 or more.
    """
    return _double(velocity_std_m_s) * _double(pulse_step_s) * torch.sqrt(_double(n_period) / 15)
