"""Azimuth lines of an image formed by the matched Fourier transform, in Doppler or in metres.

The rotation angle of the target is Om phi(t), with the rotation rate Om at the first pulse and the
warp phi(t) = t + k1 t^2 / 2! + k2 t^3 / 3! + ... With the aperture time T = pulses / PRF, the mean
rotation rate is Om phi(T) / T. Doppler frequencies of the image are those at this mean rate. The
step between image lines is given in Doppler cells of 1 / T.

Reference:
    Remote Sens. 2025, 17, 3447, Eqs. (9)-(10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import per_trial
from torchsar.focus.warped_sums import whole_warp


def mean_rate(omega_rad_s: Tensor | float, k: Tensor, duration_s: float) -> Tensor:
    """Return the mean rotation rate over the aperture: the whole rotation angle over its duration.

    This rate converts the Doppler axis of `matched_fourier`, and of an image formed without the
    warp, to cross range.

    Args:
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,) or a number.
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1).
        duration_s: Aperture time in seconds.

    Returns:
        Mean rotation rate in rad/s, shape (...,), float64.

    Raises:
        ValueError: If the duration is not positive and finite.
    """
    if not 0 < duration_s < math.inf:
        raise ValueError(f"duration_s of an aperture must be positive and finite, got {duration_s}")
    total = whole_warp(k.to(torch.float64), duration_s)[..., 0]
    return per_trial(omega_rad_s, 0, total) * total / duration_s


def cross_range_of(
    doppler_hz: Tensor | float, omega_rad_s: Tensor | float, k: Tensor, wavelength_m: float, duration_s: float
) -> Tensor:
    """Convert Doppler frequencies f of the image axis to cross range, wavelength f / (2 mean rate).

    The mean rate is the rotation rate averaged over the aperture. If it is 1 % too large, the cross
    range is 1 % too small. The data do not show the sign of the rotation rate, so that the image
    may be mirrored in cross range.

    Args:
        doppler_hz: Doppler frequencies in Hz, shape (f,) or a number.
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,) or a number.
        k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s, 1/s^2,
            ..., shape (..., order - 1).
        wavelength_m: Carrier wavelength in metres.
        duration_s: Aperture time in seconds.

    Returns:
        Cross range in metres, shape (..., f), or (...,) for a single frequency.

    Raises:
        ValueError: If the duration is not positive and finite.
    """
    rate = mean_rate(omega_rad_s, k, duration_s)
    doppler = torch.as_tensor(doppler_hz, dtype=torch.float64, device=rate.device)
    return wavelength_m / 2 * doppler / (rate[..., None] if doppler.ndim else rate)


@dataclass(frozen=True)
class DopplerLines:
    """Image lines at equal steps of Doppler.

    >>> import torch
    >>> from torchsar import focus
    >>> lines = focus.DopplerLines(oversampling=2.0, lines=16)
    >>> pulses = torch.ones(64, 3, dtype=torch.complex64)
    >>> focus.matched_fourier(pulses, torch.zeros(0), prf_hz=100.0, lines=lines).shape
    torch.Size([16, 3])

    Doppler zero is line n // 2 of n lines. Every trial has the same Doppler axis.

    Args:
        oversampling: Lines per Doppler cell, which is 1 / aperture time.
        lines: Number of lines about Doppler zero; None for the whole pulse rate,
            round(oversampling * pulses).

    Raises:
        ValueError: If `oversampling` is not positive or `lines` is below 1.
    """

    oversampling: float = 2.0
    lines: int | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.oversampling) and self.oversampling > 0) or (
            self.lines is not None and self.lines < 1
        ):
            raise ValueError(
                f"oversampling must be positive and lines at least 1 or None, got oversampling={self.oversampling} "
                f"and lines={self.lines}"
            )

    def number(self, n_pulse: int) -> int:
        """Return the number of image lines for a number of pulses.

        Args:
            n_pulse: Number of pulses.
        """
        return self.lines or round(self.oversampling * n_pulse)

    def cells_per_line(self, k: Tensor, duration_s: float) -> Tensor:
        """Return the step between image lines in Doppler cells of 1 / T, a float64 scalar tensor.

        Args:
            k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
                1/s^2, ..., shape (..., order - 1), float64.
            duration_s: Aperture time T in seconds.
        """
        return torch.full((), 1 / self.oversampling, dtype=torch.float64, device=k.device)


@dataclass(frozen=True)
class CrossRangeLines:
    """Image lines at equal steps of cross range in metres, the same axis for all trials.

    >>> import torch
    >>> from torchsar import focus
    >>> lines = focus.CrossRangeLines(step_m=0.5, count=21, omega_rad_s=0.02, wavelength_m=0.03)
    >>> point = torch.exp(-4j * torch.pi / 0.03 * 2.0 * 0.02 * torch.arange(64)[:, None] / 100.0)
    >>> image = focus.matched_fourier(point, torch.zeros(0), 100.0, lines=lines)
    >>> (int(image.abs().argmax()) - 21 // 2) * 0.5  # cross range in metres
    2.0

    Line i lies at (i - count // 2) step_m.

    Args:
        step_m: Step between lines in metres.
        count: Number of lines.
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,) or a number.
        wavelength_m: Carrier wavelength in metres.

    Raises:
        ValueError: If `step_m` is not positive or `count` is below 1.
    """

    step_m: float
    count: int
    omega_rad_s: Tensor | float
    wavelength_m: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.step_m) and self.step_m > 0 and self.count >= 1):
            raise ValueError(
                "image lines in metres need a positive step and at least one line, got "
                f"step_m={self.step_m} and count={self.count}"
            )

    def number(self, n_pulse: int) -> int:
        """Return the number of image lines, which does not depend on the number of pulses.

        Args:
            n_pulse: Number of pulses.
        """
        return self.count

    def cells_per_line(self, k: Tensor, duration_s: float) -> Tensor:
        """Return the step between image lines in Doppler cells of 1 / T, shape (...,), float64.

        The step in metres is fixed, so that the step in Doppler cells depends on the mean rotation
        rate of each trial.

        Args:
            k: Coefficients k1, k2, ... of the warp t + k1 t^2 / 2! + k2 t^3 / 3! + ... in 1/s,
                1/s^2, ..., shape (..., order - 1), float64.
            duration_s: Aperture time T in seconds.
        """
        return 2 * self.step_m / self.wavelength_m * duration_s * mean_rate(self.omega_rad_s, k, duration_s)
