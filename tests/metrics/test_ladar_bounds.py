"""Bounds of a triangular ladar against Fisher information that is summed and inverted
numerically.
"""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.metrics import (
    integrated_range_detrended_bound_m,
    range_per_sweep_bound_m,
    velocity_free_offset_bound_m_s,
    velocity_known_offset_bound_m_s,
    velocity_segmented_bound_m_s,
)

N, SWEEP, WAVELENGTH, SNR = 512, 8e-6, 1.55e-6, 10.0
U = (torch.arange(N, dtype=torch.float64) - (N - 1) / 2) * SWEEP / N
ONE, NONE = torch.ones_like(U), torch.zeros_like(U)


def least_std(*columns: tuple[torch.Tensor, torch.Tensor]) -> float:
    """Least standard deviation of the first parameter; a column holds the derivative of the phase
    (rad) of up-sweep and down-sweep by each parameter.
    """
    derivative = torch.stack([torch.cat(column) for column in columns])
    return float(torch.linalg.inv(2 * SNR * derivative @ derivative.mT)[0, 0].sqrt())


def turning(per_m_s: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Derivative by a velocity in units of 1 / per_m_s whose phase is zero at the turning point."""
    return 2 * math.pi * per_m_s * (U - SWEEP / 2), 2 * math.pi * per_m_s * (U + SWEEP / 2)


def test_velocity_bounds_are_inverse_fisher_information():
    beat = (2 * math.pi * U / SWEEP, -2 * math.pi * U / SWEEP)
    velocity = turning(2 / WAVELENGTH)
    free = least_std(velocity, beat, (ONE, NONE), (NONE, ONE))
    known = least_std(velocity, beat, (ONE, ONE))
    assert float(velocity_free_offset_bound_m_s(SNR, N, WAVELENGTH, SWEEP)) == pytest.approx(free, rel=1e-4)
    assert float(velocity_known_offset_bound_m_s(SNR, N, WAVELENGTH, SWEEP)) == pytest.approx(known, rel=1e-4)


def test_segmented_bound_is_that_of_four_phases_of_half_sweeps():
    phase = 1 / math.sqrt(2 * SNR * N / 2)
    assert float(velocity_segmented_bound_m_s(SNR, N, WAVELENGTH, SWEEP)) == pytest.approx(
        2 * phase * WAVELENGTH / (4 * math.pi * SWEEP), rel=1e-12
    )


def test_range_of_one_sweep():
    per_m = 4 * math.pi / WAVELENGTH
    assert float(range_per_sweep_bound_m(SNR, N, WAVELENGTH)) == pytest.approx(
        least_std((per_m * ONE, NONE)), rel=1e-12
    )


@pytest.mark.parametrize(
    "db, free, known, phase_nm",
    [(-10, 3.73, 1.87, 12.2), (0, 1.18, 0.59, 3.85), (10, 0.373, 0.187, 1.22), (30, 0.037, 0.019, 0.122)],
)
def test_figures_of_an_independent_model(db, free, known, phase_nm):
    snr = 10 ** (db / 10)
    assert 1e3 * float(velocity_free_offset_bound_m_s(snr, N, WAVELENGTH, SWEEP)) == pytest.approx(free, rel=0.02)
    assert 1e3 * float(velocity_known_offset_bound_m_s(snr, N, WAVELENGTH, SWEEP)) == pytest.approx(known, rel=0.02)
    assert 1e9 * float(range_per_sweep_bound_m(snr, N, WAVELENGTH)) == pytest.approx(phase_nm, rel=0.01)


def test_integrated_range_is_the_detrended_random_walk():
    generator = torch.Generator().manual_seed(1)
    m, step, std = 512, 16e-6, 0.4e-3
    walk = step * std * torch.cumsum(torch.randn(1000, m, dtype=torch.float64, generator=generator), -1)
    line = torch.stack([torch.ones(m, dtype=torch.float64), torch.linspace(-1, 1, m, dtype=torch.float64)], -1)
    left = walk - (line @ torch.linalg.lstsq(line, walk.mT).solution).mT
    assert float(integrated_range_detrended_bound_m(std, step, m)) == pytest.approx(
        float(left.square().mean().sqrt()), rel=0.03
    )
    segmented = velocity_segmented_bound_m_s(SNR, N, WAVELENGTH, SWEEP)
    assert 1e9 * float(integrated_range_detrended_bound_m(segmented, 16e-6, 1024)) == pytest.approx(57, rel=0.01)


def test_bounds_broadcast():
    assert velocity_free_offset_bound_m_s(torch.tensor([0.1, 10.0]), N, WAVELENGTH, SWEEP).shape == (2,)
