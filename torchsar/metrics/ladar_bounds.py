"""Cramer-Rao bounds of velocity and range of a triangular ladar, for one point in white noise.

`snr` is the power of the point over the variance of the complex noise, of one sample before
compression. Functions take numbers or tensors that broadcast, and return float64. With g =
samples_per_sweep * snr every velocity bound is (lambda / 2) sqrt(c / g) / (2 pi T), where T is the
duration of one sweep.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

Value = Tensor | float


def _double(value: Value) -> Tensor:
    """Value as a float64 tensor."""
    return torch.as_tensor(value, dtype=torch.float64)


def _velocity_m_s(c: float, snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Velocity bound with the factor c of the module docstring."""
    energy = _double(samples_per_sweep) * _double(snr)
    return _double(wavelength_m) / 2 * torch.sqrt(c / energy) / (2 * math.pi * _double(sweep_s))


def velocity_free_offset_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Compute the velocity bound of one period with unknown phases of both sweeps.

    The factor c of the module docstring is 3. An estimate from the spectral peaks of the full
    sweeps reaches the bound.

    Args:
        snr: Signal-to-noise ratio per sample.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength in metres.
        sweep_s: Duration of one sweep in seconds.

    Returns:
        Standard deviation in m/s.
    """
    return _velocity_m_s(3.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_segmented_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Compute the velocity bound of estimates from the phases of half sweeps.

    The factor c of the module docstring is 4. This is the bound of segmented interference; it
    is 1.25 dB above `velocity_free_offset_bound_m_s`.

    Args:
        snr: Signal-to-noise ratio per sample.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength in metres.
        sweep_s: Duration of one sweep in seconds.

    Returns:
        Standard deviation in m/s.

    Reference:
        Remote Sens. 2024, 16, 793, Eqs. (14)-(17), for the estimator.
    """
    return _velocity_m_s(4.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_known_offset_bound_m_s(
    snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value
) -> Tensor:
    """Compute the velocity bound if the phases of both sweeps agree at the turning point.

    The up-sweep and the down-sweep have equal phases there if the trigger is exact. The factor c of
    the module docstring is then 0.75. The bound is 7.3 dB
    below `velocity_segmented_bound_m_s`.

    Args:
        snr: Signal-to-noise ratio per sample.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength in metres.
        sweep_s: Duration of one sweep in seconds.

    Returns:
        Standard deviation in m/s.
    """
    return _velocity_m_s(0.75, snr, samples_per_sweep, wavelength_m, sweep_s)


def range_per_sweep_bound_m(snr: Value, samples_per_sweep: Value, wavelength_m: Value) -> Tensor:
    """Compute the bound of the range from the carrier phase of a sweep, lambda / (4 pi sqrt(2 g)).

    All other parameters are known. The error does not accumulate over sweeps.

    Args:
        snr: Signal-to-noise ratio per sample.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength in metres.

    Returns:
        Standard deviation in metres.
    """
    return _double(wavelength_m) / (4 * math.pi) / torch.sqrt(2 * _double(samples_per_sweep) * _double(snr))


def integrated_range_detrended_bound_m(velocity_std_m_s: Value, pulse_step_s: Value, n_period: Value) -> Tensor:
    """Compute the rms range error of integrated velocities, std * step * sqrt(M / 15).

    The velocities have independent errors; the range error is a random walk from which the best
    line is removed. At 10 dB, 512 samples and 8 us per sweep, 1024 segmented velocities every 16 us
    give 57 nm.

    Args:
        velocity_std_m_s: Standard deviation of one velocity in m/s.
        pulse_step_s: Interval between velocities in seconds.
        n_period: Number of velocities M, 30 or more.

    Returns:
        Rms range error over the record in metres.
    """
    return _double(velocity_std_m_s) * _double(pulse_step_s) * torch.sqrt(_double(n_period) / 15)
