"""The analytic signal of one-channel samples, and delays of lines by parts of a sample."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import linear_phasor


def delayed(lines: Tensor, fraction: Tensor, analytic: bool = False) -> Tensor:
    """Lines at the instants n + fraction, taken as periodic: (..., line, n), fraction (...,) or a
    number, -0.5..0.5 samples.

    analytic: keep positive frequencies only, doubled: of real lines the complex signal whose real
    part they are. Differentiable.
    """
    n = lines.shape[-1]
    if not analytic and _all_zero(fraction):
        return lines
    spectrum = torch.fft.fft(lines)
    turn = torch.fft.ifftshift(linear_phasor(fraction / n, -(n // 2), n, spectrum.dtype), dim=-1)[..., None, :]
    if analytic:
        turn = turn * _positive(n, lines.device)
    return torch.fft.ifft(spectrum * turn)


def _positive(n: int, device: torch.device) -> Tensor:
    """2 at positive frequencies, 1 at zero and at half the sampling rate, 0 at negative ones, (n,)
    in FFT order.
    """
    order = torch.arange(n, device=device)
    return (2 * order < n).int() + ((2 * order <= n) & (order > 0)).int()


def _all_zero(x: Tensor) -> bool:
    try:
        return not x.requires_grad and not bool(x.any())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return False
