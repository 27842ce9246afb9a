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
        raise TypeError(
            f"an image is a Signal or a tensor of numbers, got {x.dtype if isinstance(x, Tensor) else type(x).__name__}"
        )
    if x.ndim < 2 or not x.shape[-2] * x.shape[-1]:
        raise ValueError(
            f"an image has the dims (..., azimuth, range) and at least one pixel, got the shape {tuple(x.shape)}"
        )
    return x


def _pair(image: Tensor | Signal, reference: Tensor | Signal) -> tuple[Tensor, Tensor]:
    a, b = _tensor(image), _tensor(reference)
    if not (a.is_complex() and b.is_complex()) or a.shape[-2:] != b.shape[-2:]:
        raise ValueError(
            f"complex images of one size can be compared, got {a.dtype} of shape {tuple(a.shape)} "
            f"and {b.dtype} of shape {tuple(b.shape)}"
        )
    return a, b


def _power(image: Tensor) -> Tensor:
    """|image|^2 over its peak."""
    unit = _over_peak(image)
    return unit.real.square() + unit.imag.square() if unit.is_complex() else unit.square()


def _levels(image: Tensor | Signal, of: str, mask: Tensor | None, what: str) -> tuple[Tensor, Tensor | None]:
    """Intensities or amplitudes relative to the peak of the pixels that count, and the weights of
    the pixels in the same precision.
    """
    if of not in _OF:
        raise ValueError(f"{what} of {of!r} is not defined; choose 'intensity' or 'amplitude'")
    x = _tensor(image)
    weight = None if mask is None else _weights(mask, x, what)
    if weight is not None:
        x = torch.where(weight > 0, x, 0)
    level = (
        _power(x) if of == "intensity" else _over_peak(x).abs()
    )  # abs has the gradient 0 at 0, where a root of the power has none
    return level, None if weight is None else weight.to(level.dtype)


def _weights(mask: Tensor, image: Tensor, what: str) -> Tensor:
    """The mask at the shape of the image.

    Raises TypeError or ValueError unless it broadcasts and holds finite weights of 0 or more.
    """
    if not isinstance(mask, Tensor) or mask.is_complex():
        raise TypeError(
            f"{what}: a mask is a tensor of real weights or of bool, got "
            f"{mask.dtype if isinstance(mask, Tensor) else type(mask).__name__}"
        )
    try:
        weight = mask.to(image.device).expand(image.shape)
    except RuntimeError:
        raise ValueError(
            f"{what}: a mask of shape {tuple(mask.shape)} does not broadcast to the image "
            f"{tuple(image.shape)}; give (azimuth, range), with trials in front where they differ"
        ) from None
    if not _holds_weights(mask):
        raise ValueError(
            f"{what}: a mask needs finite weights of 0 or more, got {float(mask.min()):g} to "
            f"{float(mask.max()):g}; a bool mask marks the pixels that count"
        )
    return weight


def _holds_weights(mask: Tensor) -> bool:
    try:
        return mask.dtype == torch.bool or not mask.numel() or bool(((mask >= 0) & torch.isfinite(mask)).all())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return True


def entropy(image: Tensor | Signal, of: str = "intensity", mask: Tensor | None = None) -> Tensor:
    """Image entropy in nats, -sum p ln p with p = |I|^2 / sum |I|^2, or of the amplitude p = |I| /
    sum |I|. (..., azimuth, range) -> (...,).

    Invariant to scale; 0 for an all-zero image; ln(number of pixels) for a flat one. mask: bool or
    real weights >= 0 that broadcast to the image: a pixel of weight w counts as w pixels, one of
    weight 0 not at all, whatever it holds; 0 where nothing counts. Differentiable, also where
    pixels are zero: there the amplitude has an infinite slope, of which the gradient is 0. Raises
    ValueError for an `of` or a mask that does not fit.
    """
    level, weight = _levels(image, of, mask, "entropy")
    total = _sum(level, weight)[..., None, None]
    p = level / torch.where(total > 0, total, 1)
    return -_sum(p * torch.log(p.clamp_min(torch.finfo(p.dtype).tiny)), weight)


def contrast(image: Tensor | Signal, of: str = "intensity", mask: Tensor | None = None) -> Tensor:
    """Standard deviation over mean of the intensity |I|^2 (or the amplitude |I|).

    (..., azimuth, range) -> (...,).

    0 for an all-zero image. mask, gradients and errors as in `entropy`.
    """
    level, weight = _levels(image, of, mask, "contrast")
    count = level.shape[-2] * level.shape[-1] if weight is None else torch.where(_sum(weight) > 0, _sum(weight), 1)
    mean = _sum(level, weight) / count
    spread = _sum((level - mean[..., None, None]).square(), weight) / count
    varied = spread > torch.finfo(spread.dtype).tiny
    return torch.where(varied, torch.where(varied, spread, 1).sqrt(), 0) / torch.where(mean > 0, mean, 1)


def _sum(x: Tensor, weight: Tensor | None = None) -> Tensor:
    return (x if weight is None else x * weight).sum((-2, -1))


def _norm(x: Tensor) -> Tensor:
    """Root of the energy of each image, summed in float64: a million float32 terms would lose the
    fourth digit.
    """
    return (x.real.square() + x.imag.square()).sum((-2, -1), dtype=torch.float64).sqrt()


def _over_peak(x: Tensor) -> Tensor:
    """An image over its detached peak, per trial, so that its squares neither under- nor overflow.

    All-zero stays zero.
    """
    peak = x.detach().abs().amax((-2, -1), keepdim=True)
    return x / torch.where(peak > 0, peak, 1)


def correlation(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """rho = |<I, I0>| / (|I| |I0|) of two complex images, (...,) float64 in 0..1.

    Blind to a common gain and phase; 0 where one is all zero.
    """
    a, b = (_over_peak(x) for x in _pair(image, reference))
    product = (a * b.conj()).sum((-2, -1), dtype=torch.complex128).abs()
    norms = _norm(a) * _norm(b)
    return product / torch.where(norms > 0, norms, 1)


def error_db(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """10 lg of |I - I0|^2 / |I0|^2 in dB, (...,) float64.

    Sees gain and phase; use `correlation` where those are free.
    """
    a, b = _pair(image, reference)
    peak = b.detach().abs().amax((-2, -1), keepdim=True)
    scale = torch.where(peak > 0, peak, 1)
    norm = _norm(b / scale)
    ratio = _norm((a - b) / scale) / torch.where(norm > 0, norm, 1)
    return 20 * torch.log10(ratio.clamp_min(torch.finfo(ratio.dtype).tiny))
