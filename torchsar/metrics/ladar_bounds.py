"""Cramer-Rao bounds of velocity and range of a triangular ladar, for one point in white noise.

`snr` is the power of the point over the variance of the complex noise, in one sample of the beat
signal before compression. Functions take numbers or tensors that broadcast, and return float64.
Every velocity bound is (lambda / 2) sqrt(c / g) / (2 pi T), where g = samples_per_sweep * snr, T is
the duration of one sweep, and the factor c depends on what is known about the phases.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.metrics.bounds import nonnegative

Value = Tensor | float


def _velocity_m_s(c: float, snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Velocity bound of the module docstring for the factor c."""
    energy = nonnegative(samples_per_sweep) * nonnegative(snr)
    return nonnegative(wavelength_m) / 2 * torch.sqrt(c / energy) / (2 * math.pi * nonnegative(sweep_s))


def velocity_free_offset_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Compute the velocity bound of one period if the phases of up and down sweep are unknown.

    >>> from torchsar import metrics
    >>> ladar = {"snr": 10.0, "samples_per_sweep": 512, "wavelength_m": 1.55e-6, "sweep_s": 8e-6}
    >>> round(1e3 * float(metrics.velocity_free_offset_bound_m_s(**ladar)), 2)  # mm/s
    0.37

    The bound is (lambda / 2) sqrt(3 / g) / (2 pi T) with g = samples_per_sweep * snr and the
    duration T of one sweep. An estimate from the spectral peaks of the full sweeps reaches it.

    Args:
        snr: Signal-to-noise power ratio per sample before compression.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength lambda in metres.
        sweep_s: Duration T of one sweep in seconds.

    Returns:
        Standard deviation in m/s.
    """
    return _velocity_m_s(3.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_segmented_bound_m_s(snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value) -> Tensor:
    """Compute the velocity bound of estimates from the phases of half sweeps.

    >>> from torchsar import metrics
    >>> ladar = {"snr": 10.0, "samples_per_sweep": 512, "wavelength_m": 1.55e-6, "sweep_s": 8e-6}
    >>> round(1e3 * float(metrics.velocity_segmented_bound_m_s(**ladar)), 2)  # mm/s
    0.43

    Each sweep is split into two halves, and the velocity follows from the phase between their
    spectra (segmented interference). The bound is (lambda / 2) sqrt(4 / g) / (2 pi T) with g =
    samples_per_sweep * snr and the duration T of one sweep, 1.25 dB above
    `velocity_free_offset_bound_m_s`.

    Args:
        snr: Signal-to-noise power ratio per sample before compression.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength lambda in metres.
        sweep_s: Duration T of one sweep in seconds.

    Returns:
        Standard deviation in m/s.

    Reference:
        Remote Sens. 2024, 16, 793, Eqs. (14)-(17), for the estimator.
    """
    return _velocity_m_s(4.0, snr, samples_per_sweep, wavelength_m, sweep_s)


def velocity_known_offset_bound_m_s(
    snr: Value, samples_per_sweep: Value, wavelength_m: Value, sweep_s: Value
) -> Tensor:
    """Compute the velocity bound of one period if both sweeps join in phase at the turning point.

    >>> from torchsar import metrics
    >>> ladar = {"snr": 10.0, "samples_per_sweep": 512, "wavelength_m": 1.55e-6, "sweep_s": 8e-6}
    >>> round(1e3 * float(metrics.velocity_known_offset_bound_m_s(**ladar)), 2)  # mm/s
    0.19

    They do so if the sampling of the sweeps is triggered exactly at the turning point. The bound is
    (lambda / 2) sqrt(0.75 / g) / (2 pi T) with g = samples_per_sweep * snr and the duration T of
    one sweep, 7.3 dB below `velocity_segmented_bound_m_s`.

    Args:
        snr: Signal-to-noise power ratio per sample before compression.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength lambda in metres.
        sweep_s: Duration T of one sweep in seconds.

    Returns:
        Standard deviation in m/s.
    """
    return _velocity_m_s(0.75, snr, samples_per_sweep, wavelength_m, sweep_s)


def range_per_sweep_bound_m(snr: Value, samples_per_sweep: Value, wavelength_m: Value) -> Tensor:
    """Compute the bound of the range from the carrier phase of a sweep, lambda / (4 pi sqrt(2 g)).

    >>> from torchsar import metrics
    >>> bound = metrics.range_per_sweep_bound_m(10.0, samples_per_sweep=512, wavelength_m=1.55e-6)
    >>> round(1e9 * float(bound), 2)  # nm
    1.22

    Here g = samples_per_sweep * snr. All other parameters are known. Errors of successive sweeps
    are independent and do not accumulate.

    Args:
        snr: Signal-to-noise power ratio per sample before compression.
        samples_per_sweep: Number of samples of one sweep.
        wavelength_m: Carrier wavelength lambda in metres.

    Returns:
        Standard deviation in metres.
    """
    return nonnegative(wavelength_m) / (4 * math.pi) / torch.sqrt(2 * nonnegative(samples_per_sweep) * nonnegative(snr))


def integrated_range_detrended_bound_m(velocity_std_m_s: Value, pulse_step_s: Value, n_period: Value) -> Tensor:
    """Compute the rms error of a range history that is integrated from estimated velocities.

    >>> from torchsar import metrics
    >>> bound = metrics.integrated_range_detrended_bound_m(0.43e-3, 16e-6, n_period=1024)
    >>> round(1e9 * float(bound), 1)  # nm
    56.8

    The errors of M velocities are independent, so that the range error is a random walk. After
    removal of the best line from it, its rms is velocity_std_m_s * pulse_step_s * sqrt(M / 15). At
    10 dB, 512 samples and 8 us per sweep, 1024 velocities with the error of
    `velocity_segmented_bound_m_s`, one every 16 us, give 57 nm.

    Args:
        velocity_std_m_s: Standard deviation of one velocity in m/s.
        pulse_step_s: Interval between velocities in seconds.
        n_period: Number of velocities M, 30 or more.

    Returns:
        Rms range error over the record in metres.
    """
    return nonnegative(velocity_std_m_s) * nonnegative(pulse_step_s) * torch.sqrt(nonnegative(n_period) / 15)
