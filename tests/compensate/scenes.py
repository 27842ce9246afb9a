"""Range-compressed pulses of point targets with random phases, made by plain formulas."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.compensate import autofocus, entropy_fixed_point, pga, pga_sca, sca
from torchsar.core import Draws, Estimate, unit_phasor
from torchsar.study.bench.pulses import noisy, still, turned, white

DOUBLE = torch.complex128
__all__ = ["noisy", "still", "turned", "white"]  # and those defined here
METHODS: dict[str, Callable[[Tensor], Estimate]] = {
    "sca": sca,
    "pga": pga,
    "pga_sca": pga_sca,
    "entropy_fixed_point": entropy_fixed_point,
    "autofocus": autofocus,
}
EQUIVARIANT = ("sca", "pga_sca", "entropy_fixed_point", "autofocus")


def doppler_image(x: Tensor, phase_rad: Tensor) -> Tensor:
    """Form the image of pulses with their phases removed, (..., Doppler, range)."""
    return torch.fft.fft(turned(x, -phase_rad), dim=-2, norm="ortho")


def noise(trials: int, n_pulse: int, n_range: int, dtype: torch.dtype = torch.complex64, seed: int = 6) -> Tensor:
    """Draw circular noise, (trial, pulse, range)."""
    return Draws(seed, trials=range(trials)).normal("alone", (n_pulse, n_range), dtype)


def hamming_response(away: Tensor) -> Tensor:
    """Response in range of a point with a Hamming window, at a distance in cells, as complex."""
    return (0.54 * torch.sinc(away) + 0.23 * (torch.sinc(away - 1) + torch.sinc(away + 1))).to(DOUBLE)


def spread_points(
    trials: int, points: int, snr_db: float, seed: int, n_pulse: int = 128, n_range: int = 64, seen: float | None = None
) -> tuple[Tensor, Tensor]:
    """Make noisy points anywhere within the range and half of the Doppler band, with any phases.

    The amplitudes are Rayleigh distributed, and the responses in range have a Hamming window.

    Args:
        trials: Number of trials.
        points: Number of points.
        snr_db: Mean power of all samples over the noise variance in dB.
        seed: Seed of the random numbers.
        n_pulse: Number of pulses.
        n_range: Number of range cells.
        seen: Width in pulses of the lobe (sinc) in which a point is seen; by default always.

    Returns:
        Pulses, shape (trial, pulse, range), complex128, and their phases in rad, (trial, pulse).
    """
    draws, k = Draws(seed, trials=range(trials)), torch.arange(n_pulse, dtype=torch.float64)
    amplitude = draws.normal("amplitude", (points, 1), DOUBLE)
    slow = amplitude * unit_phasor(draws.uniform("cycles", (points, 1), -0.25, 0.25) * k, DOUBLE)
    if seen is not None:
        slow = slow * torch.sinc((k - draws.uniform("middle", (points, 1), 0.0, n_pulse)) / seen)
    away = torch.arange(n_range) - draws.uniform("cell", (points, 1), 4.0, n_range - 4.0)
    data = torch.einsum("tkp,tkr->tpr", slow, hamming_response(away))
    phase_rad = white(trials, n_pulse, seed)
    return turned(noisy(data, snr_db, seed), phase_rad), phase_rad
