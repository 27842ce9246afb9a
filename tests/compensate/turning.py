"""Range-compressed pulses of small targets with non-uniform rotation, made by plain formulas.

Remote Sens. 2025, 17, 3447, Eq. (3), with exact sine and cosine.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.radar.warp import warp
from torchsar.study.bench.rotations import points

F64 = torch.float64
WAVELENGTH, PRF, PULSES, BINS, CELL, OMEGA = 1.55e-6, 40e3, 800, 24, 0.3, 0.02
K = torch.tensor([10.0, 1000.0], dtype=F64)
RANGE_M = CELL * (torch.arange(BINS, dtype=F64) - BINS // 2)
RADAR = InverseRadar(LIGHT_M_S / WAVELENGTH, LIGHT_M_S / (2 * CELL), PRF)
OPTIONS = {"wavelength_m": WAVELENGTH, "prf_hz": PRF, "range_m": RANGE_M}


def echo(x: Tensor, y: Tensor, amplitude: Tensor, k: Tensor = K, yc_m: float = 0.0, n_pulse: int = PULSES) -> Tensor:
    """Echo of points, (pulse, range) complex128."""
    angle = OMEGA * warp(torch.arange(n_pulse, dtype=F64) / PRF, k)
    path_m = x[:, None] * torch.sin(angle) - (y + yc_m)[:, None] * 2 * torch.sin(angle / 2).square()
    return (torch.exp(-4j * math.pi / WAVELENGTH * path_m) * amplitude[:, None]).mT @ response(
        (RANGE_M - y[:, None]) / CELL, BINS
    )


def response(x: Tensor, cells: int) -> Tensor:
    """Response of range cells x cells away from a scatterer.

    It is the mean of the `cells` frequencies of an FFT of so many samples.
    """
    frequency = (torch.arange(cells, dtype=F64) - cells // 2) / cells
    return torch.exp(2j * math.pi * x[..., None] * frequency).mean(-1)


def noise(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(1000 + seed))


def noise_std(clean: Tensor, snr_db: float) -> Tensor:
    """Standard deviation of the noise.

    The SNR is the mean power of all samples over the noise power.
    """
    return (clean.abs().square().mean() * 10 ** (-snr_db / 10)).sqrt()


def target(
    seed: int = 0, snr_db: float = 20.0, k: Tensor = K, yc_m: float = 0.0, n_pulse: int = PULSES, draw: int = 0
) -> Tensor:
    """One scene with one draw of the noise."""
    clean = echo(*points(seed), k, yc_m, n_pulse)
    return clean + noise_std(clean, snr_db) * noise(100 * seed + draw, *clean.shape)


def targets(count: int, **options) -> Tensor:
    """Several scenes, (trial, pulse, range)."""
    return torch.stack([target(seed, **options) for seed in range(count)])
