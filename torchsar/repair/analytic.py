"""Analytic signal of real samples, and delays of lines by a fraction of a sample."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import host_value, linear_phasor


def delayed(lines: Tensor, fraction: Tensor, analytic: bool = False) -> Tensor:
    """Interpolate lines at the instants i + fraction, where i is the number of the sample.

    Lines are taken as periodic. Differentiable.

    Args:
        lines: Lines, shape (..., line, n), real or complex.
        fraction: Shift of the instants in samples, -0.5..0.5, positive for later instants; a number
            or shape (...,), float64.
        analytic: Whether to return the analytic signal: positive frequencies only, doubled, so that
            its real part is the real line.

    Returns:
        Complex lines of the same shape; the lines themselves if all shifts are zero and `analytic`
        is False.
    """
    n = lines.shape[-1]
    # inside vmap, where values cannot be read, the shift may differ from zero
    if not analytic and not fraction.requires_grad and not host_value(fraction.any(), True):
        return lines
    spectrum = torch.fft.fft(lines)
    turn = torch.fft.ifftshift(linear_phasor(fraction / n, -(n // 2), n, spectrum.dtype), dim=-1)[..., None, :]
    if analytic:
        order = torch.arange(n, device=lines.device)
        turn = turn * ((2 * order < n).int() + ((2 * order <= n) & (order > 0)).int())
    return torch.fft.ifft(spectrum * turn)
