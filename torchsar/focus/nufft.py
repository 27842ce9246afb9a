"""One-dimensional non-uniform FFT with separate points in every row, see `core.nufft`."""

from __future__ import annotations

from torch import Tensor

from torchsar.core import checked_samples
from torchsar.core.nufft import Nufft


def nufft_type2(x: Tensor, points: Tensor, eps: float = 1e-6) -> Tensor:
    """Evaluate the spectrum of uniform samples at any frequencies.

    >>> import torch
    >>> from torchsar.focus import nufft_type2
    >>> points = torch.tensor([0.0, 0.125, 0.5], dtype=torch.float64)
    >>> nufft_type2(torch.ones(8, dtype=torch.complex64), points).abs().round(decimals=3)
    tensor([8., 0., 0.])

    At the point p it is sum_j x_j exp(-2j pi p (j - n//2)). Differentiable in samples and points.

    Args:
        x: Samples, shape (..., n), complex.
        points: Points p in cycles per sample, float64 (..., m); leading dims broadcast with those
            of the samples.
        eps: Relative error.

    Returns:
        Spectrum at the points, shape (..., m).

    Raises:
        TypeError: If the points are not float64; float32 does not resolve positions in a long row.
        ValueError: If there are no samples, or if `eps` lies outside 1e-13..0.1.
    """
    x = checked_samples(x, "nufft_type2", "mode", finite=False)
    plan = Nufft(x.shape[-1], eps, x.dtype, x.device)
    return plan.type2(x, plan.points(points))


def nufft_type1(y: Tensor, points: Tensor, n: int, eps: float = 1e-6) -> Tensor:
    """Sum values at arbitrary points into uniform samples, the adjoint of `nufft_type2`.

    >>> import torch
    >>> from torchsar.focus import nufft_type1
    >>> points = torch.tensor([0.0, 0.125], dtype=torch.float64)
    >>> nufft_type1(torch.ones(2, dtype=torch.complex64), points, n=8).abs().round(decimals=3)
    tensor([0.0000, 0.7650, 1.4140, 1.8480, 2.0000, 1.8480, 1.4140, 0.7650])

    The samples are x_j = sum_k y_k exp(+2j pi p_k (j - n//2)), j = 0..n-1. Differentiable in values
    and points.

    Args:
        y: Values y_k at the points p_k, shape (..., m), complex.
        points: Points p_k in cycles per sample, float64 (..., m).
        n: Number of uniform samples.
        eps: Relative error.

    Returns:
        Uniform samples, shape (..., n).

    Raises:
        TypeError: If the points are not float64.
        ValueError: If there are no samples, or if `eps` lies outside 1e-13..0.1.
    """
    y = checked_samples(y, "nufft_type1", "point", finite=False)
    plan = Nufft(n, eps, y.dtype, y.device)
    return plan.type1(y, plan.points(points))
