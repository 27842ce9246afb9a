"""Sharpness and similarity of whole images."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Signal

_OF = {"intensity": 2, "amplitude": 1}


def _tensor(image: Tensor | Signal) -> Tensor:
    """The samples (..., azimuth, range). Raises TypeError or ValueError for what is no image."""
    x = image.data if isinstance(image, Signal) else image
    if not isinstance(x, Tensor) or x.dtype == torch.bool:
        raise TypeError(f"an image is a Signal or a tensor of numbers, got {x.dtype if isinstance(x, Tensor) else type(x).__name__}")
    if x.ndim < 2 or not x.shape[-2] * x.shape[-1]:
        raise ValueError(f"an image has the dims (..., azimuth, range) and at least one pixel, got the shape {tuple(x.shape)}")
    return x


def _pair(image: Tensor | Signal, reference: Tensor | Signal) -> tuple[Tensor, Tensor]:
    a, b = _tensor(image), _tensor(reference)
    if not (a.is_complex() and b.is_complex()) or a.shape[-2:] != b.shape[-2:]:
        raise ValueError(f"complex images of one size can be compared, got {a.dtype} of shape {tuple(a.shape)} and {b.dtype} of shape {tuple(b.shape)}")
    return a, b


def _power(image: Tensor) -> Tensor:
    """|image|^2 over its detached peak, per trial, so that neither 1e-25 nor 1e19 under- or overflows. All-zero stays zero."""
    peak = torch.amax(image.detach().abs(), (-2, -1), keepdim=True)
    unit = image / torch.where(peak > 0, peak, 1)
    return unit.real.square() + unit.imag.square() if unit.is_complex() else unit.square()


def entropy(image: Tensor | Signal) -> Tensor:
    """Image entropy in nats, -sum p ln p with p = |I|^2 / sum |I|^2. (..., azimuth, range) -> (...,).

    Invariant to scale; 0 for an all-zero image; ln(number of pixels) for a flat one. Differentiable, also where pixels are zero.
    """
    power = _power(_tensor(image))
    tiny = torch.finfo(power.dtype).tiny
    total = power.sum((-2, -1), keepdim=True)
    p = power / torch.where(total > 0, total, 1)
    return -(p * torch.log(p.clamp_min(tiny))).sum((-2, -1))


def contrast(image: Tensor | Signal, of: str = "intensity") -> Tensor:
    """Standard deviation over mean of the intensity |I|^2 (or the amplitude |I|). (..., azimuth, range) -> (...,). 0 for an all-zero image."""
    if of not in _OF:
        raise ValueError(f"contrast of {of!r} is not defined; choose 'intensity' or 'amplitude'")
    power = _power(_tensor(image))
    x = power if of == "intensity" else torch.sqrt(power.clamp_min(torch.finfo(power.dtype).tiny))
    mean = x.mean((-2, -1))
    spread = (x - mean[..., None, None]).square().mean((-2, -1))
    return torch.sqrt(spread.clamp_min(torch.finfo(power.dtype).tiny)) / torch.where(mean > 0, mean, 1)


def _norm(x: Tensor) -> Tensor:
    """Root of the energy of each image, summed in float64: a million float32 terms would lose the fourth digit."""
    return (x.real.square() + x.imag.square()).sum((-2, -1), dtype=torch.float64).sqrt()


def _over_peak(x: Tensor) -> Tensor:
    """A complex image over its detached peak, so that its squares neither under- nor overflow. All-zero stays zero."""
    peak = x.detach().abs().amax((-2, -1), keepdim=True)
    return x / torch.where(peak > 0, peak, 1)


def correlation(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """rho = |<I, I0>| / (|I| |I0|) of two complex images, (...,) float64 in 0..1. Blind to a common gain and phase; 0 where one is all zero."""
    a, b = (_over_peak(x) for x in _pair(image, reference))
    product = (a * b.conj()).sum((-2, -1), dtype=torch.complex128).abs()
    norms = _norm(a) * _norm(b)
    return product / torch.where(norms > 0, norms, 1)


def error_db(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """10 lg of |I - I0|^2 / |I0|^2 in dB, (...,) float64. Sees gain and phase; use `correlation` where those are free."""
    a, b = _pair(image, reference)
    peak = b.detach().abs().amax((-2, -1), keepdim=True)
    scale = torch.where(peak > 0, peak, 1)
    norm = _norm(b / scale)
    ratio = _norm((a - b) / scale) / torch.where(norm > 0, norm, 1)
    return 20 * torch.log10(ratio.clamp_min(torch.finfo(ratio.dtype).tiny))
