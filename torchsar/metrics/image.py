"""Sharpness and similarity of images."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Signal, host_value, level_of, power_of, unit_level

# quantities of which sharpness can be computed, each with its power of the modulus |I|
_OF = {"intensity": 2, "amplitude": 1}
# dtype in which images of half precision are evaluated
_WORKING = {torch.float16: torch.float32, torch.bfloat16: torch.float32, torch.complex32: torch.complex64}


def _tensor(image: Tensor | Signal) -> Tensor:
    """Samples (..., azimuth, range) of an image, with one row for a Signal of one axis; raises
    TypeError or ValueError for anything else.
    """
    x = image.data if isinstance(image, Signal) else image
    if not isinstance(x, Tensor) or x.dtype == torch.bool:
        raise TypeError(
            f"an image is a Signal or a tensor of numbers, got {x.dtype if isinstance(x, Tensor) else type(x).__name__}"
        )
    if isinstance(image, Signal) and len(image.axes) == 1:
        x = x[..., None, :]
    if x.ndim < 2 or not x.numel():
        raise ValueError(
            f"an image has the dims (..., azimuth, range) and at least one pixel, got the shape {tuple(x.shape)}"
        )
    return x.to(_WORKING.get(x.dtype, x.dtype if x.is_floating_point() or x.is_complex() else torch.float64))


def pair_of(image: Tensor | Signal, reference: Tensor | Signal) -> tuple[Tensor, Tensor]:
    """Return the samples of two complex images of equal size.

    Args:
        image: Image, shape (..., azimuth, range), complex, or a Signal.
        reference: Image of the same size.

    Returns:
        The samples of both.

    Raises:
        TypeError: If one of them is not a tensor of numbers.
        ValueError: If they are not complex images of equal size.
    """
    a, b = _tensor(image), _tensor(reference)
    if not (a.is_complex() and b.is_complex()) or a.shape[-2:] != b.shape[-2:]:
        raise ValueError(
            f"only complex images of equal size can be compared, got {a.dtype} of shape {tuple(a.shape)} "
            f"and {b.dtype} of shape {tuple(b.shape)}"
        )
    return a, b


def _power(image: Tensor) -> tuple[Tensor, Tensor]:
    """Intensity |image|^2 and its sum over the pixels.

    The image is divided by its level if its intensities are too small or too large for single
    precision. On an accelerator it always is, because reading the sum from the device takes longer.
    """
    if image.device.type == "cpu":
        power = _squares(image)
        total = _sum(power)
        least, largest = torch.aminmax(total.detach())
        # between these limits, fourth powers in single precision neither underflow nor overflow
        lowest = 1e-12 * image.shape[-2] * image.shape[-1]
        if host_value(least, 0.0) > lowest and host_value(largest, math.inf) < 1e16:
            return power, total
    power = _squares(unit_level(image))
    return power, _sum(power)


def _squares(image: Tensor) -> Tensor:
    """Squared magnitudes of the pixels."""
    if not image.is_complex():
        return image.square()
    squares = torch.view_as_real(image.resolve_conj()).square()
    return squares[..., 0] + squares[..., 1]


def _levels(image: Tensor | Signal, of: str, mask: Tensor | None, what: str) -> tuple[Tensor, Tensor | None, Tensor]:
    """Intensities or amplitudes relative to the peak of the selected pixels.

    Also returns the weights of the pixels in the same precision, and the weighted sum over the
    pixels.
    """
    if of not in _OF:
        raise ValueError(f"{what} of {of!r} is not defined; choose 'intensity' or 'amplitude'")
    x = _tensor(image)
    weight = None if mask is None else _weights(mask, x, what)
    if weight is not None:
        x = torch.where(weight > 0, x, 0)
    if of == "intensity":
        level, total = _power(x)
    else:  # abs has the gradient 0 at zero, where the gradient of a square root is infinite
        level = unit_level(x).abs()
        total = _sum(level)
    if weight is None:
        return level, None, total
    weight = weight.to(level.dtype)
    return level, weight, _sum(level, weight)


def _weights(mask: Tensor, image: Tensor, what: str) -> Tensor:
    """Expand a mask to the shape of the image; raise TypeError or ValueError for an
    invalid mask.
    """
    if not isinstance(mask, Tensor) or mask.is_complex():
        raise TypeError(
            f"{what}: a mask is a tensor of real weights or of bool, got "
            f"{mask.dtype if isinstance(mask, Tensor) else type(mask).__name__}"
        )
    mask = mask.to(image.device)
    try:
        weight = mask.expand(image.shape)
    except RuntimeError:
        raise ValueError(
            f"{what}: a mask of shape {tuple(mask.shape)} does not broadcast to the image "
            f"{tuple(image.shape)}; give (azimuth, range), with trials in front where they differ"
        ) from None
    if not _holds_weights(mask):
        raise ValueError(
            f"{what}: a mask needs finite weights of 0 or more, got {float(mask.min()):g} to "
            f"{float(mask.max()):g}; a bool mask selects pixels"
        )
    return weight


def _holds_weights(mask: Tensor) -> bool:
    """True if all values of a mask are finite and not negative, or if they cannot be read inside
    vmap.
    """
    return mask.dtype == torch.bool or host_value(((mask >= 0) & torch.isfinite(mask)).all(), True)


def entropy(image: Tensor | Signal, of: str = "intensity", mask: Tensor | None = None) -> Tensor:
    """Compute the image entropy -sum p ln p in nats.

    >>> import torch
    >>> from torchsar import metrics
    >>> two, flat = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.ones(8, 8)
    >>> [round(float(metrics.entropy(image)), 3) for image in (two, flat)]  # ln 2 and ln 64
    [0.693, 4.159]

    p = |I|^2 / sum |I|^2 for the intensity and |I| / sum |I| for the amplitude. The entropy is
    invariant to scale, 0 for an all-zero image, and ln(number of pixels) for a flat one.
    Differentiable. With respect to a pixel of value zero, the entropy of the amplitude has no
    finite derivative; the gradient there is set to 0.

    Args:
        image: Image, shape (..., azimuth, range), real or complex, or a Signal.
        of: "intensity" or "amplitude".
        mask: Bool or real weights >= 0 that broadcast to the image. A pixel of weight w counts as w
            pixels; one of weight 0 has no influence, whatever its value. The entropy is 0 where all
            weights are 0.

    Returns:
        Entropy, shape (...,).

    Raises:
        TypeError: If the image or the mask is not a tensor of numbers.
        ValueError: If `of` is not known, the image has no pixels, or the mask does not broadcast or
            has negative or non-finite weights.
    """
    level, weight, total = _levels(image, of, mask, "entropy")
    tiny = torch.finfo(level.dtype).tiny
    total = total + (total == 0)
    # for any scale: -sum p ln p = ln(total / scale) - sum level ln(level / scale) / total
    scale = total.detach()
    # a small number is added, so that ln p and its derivatives are finite where p is zero
    share = (level / scale[..., None, None]).add_(math.sqrt(tiny))
    summand = torch.log(share) * level if level.requires_grad else share.log_().mul_(level)
    return torch.log(total / scale) - _sum(summand, weight) / total


def contrast(image: Tensor | Signal, of: str = "intensity", mask: Tensor | None = None) -> Tensor:
    """Compute the standard deviation over the mean of the intensity |I|^2, or of the amplitude |I|.

    >>> import torch
    >>> from torchsar import metrics
    >>> image = torch.tensor([[0.0, 0.0], [0.0, 2.0]])  # one of four pixels holds all energy
    >>> round(float(metrics.contrast(image)), 3), float(metrics.contrast(torch.ones(8, 8)))
    (1.732, 0.0)

    0 for an all-zero image; 1 for the intensity of fully developed speckle. Differentiable.

    Args:
        image: Image, shape (..., azimuth, range), real or complex, or a Signal.
        of: "intensity" or "amplitude".
        mask: Bool or real weights >= 0 of the pixels that broadcast to the image; pixels of weight
            0 have no influence. None: all pixels count equally.

    Returns:
        Contrast, shape (...,).

    Raises:
        TypeError: If the image or the mask is not a tensor of numbers.
        ValueError: If `of` is not known, the image has no pixels, or the mask does not broadcast or
            has negative or non-finite weights.
    """
    level, weight, total = _levels(image, of, mask, "contrast")
    count = level.shape[-2] * level.shape[-1] if weight is None else torch.where(_sum(weight) > 0, _sum(weight), 1)
    mean = total / count
    spread = _sum((level - mean[..., None, None]).square(), weight) / count
    flat = spread <= torch.finfo(spread.dtype).tiny
    return torch.where(flat, 0, torch.where(flat, 1, spread).sqrt()) / torch.where(mean == 0, 1, mean)


def _sum(x: Tensor, weight: Tensor | None = None) -> Tensor:
    """Sum of the pixels of each image, with weights if they are given."""
    return (x if weight is None else x * weight).sum((-2, -1))


def _norm(x: Tensor) -> Tensor:
    """Square root of the energy of each image; its gradient is 0 where the image is zero.

    The image is divided by its level, so that squares cannot overflow. The sum is computed in
    float64, because float32 would lose the fourth digit in a sum of a million terms.
    """
    level = level_of(x)
    energy = power_of(x / level).sum((-2, -1), dtype=torch.float64)
    return torch.where(energy == 0, 0.0, torch.where(energy == 0, 1.0, energy).sqrt()) * level[..., 0, 0]


def correlation(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """Compute the correlation rho = |<I, I0>| / (|I| |I0|) of two complex images.

    >>> import torch
    >>> from torchsar import metrics
    >>> image = torch.tensor([[1.0, 2.0], [2j, 0.0]])
    >>> other = torch.tensor([[1.0, 2.0], [0.0, 2.0]]) + 0j
    >>> [round(float(metrics.correlation(x, image)), 3) for x in (5j * image, other)]
    [1.0, 0.556]

    Invariant to a common gain and phase. 0 where one image is all zero. Differentiable, with the
    gradient 0 there.

    Args:
        image: Image I, shape (..., azimuth, range), complex, or a Signal.
        reference: Image I0, same size.

    Returns:
        Correlation in 0..1, shape (...,), float64.

    Raises:
        TypeError: If one of them is not a tensor of numbers.
        ValueError: If they are not complex images of equal size.
    """
    a, b = (unit_level(x) for x in pair_of(image, reference))
    product = (a * b.conj()).sum((-2, -1), dtype=torch.complex128).abs()
    norms = _norm(a) * _norm(b)
    return product / torch.where(norms > 0, norms, 1)


def error_db(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """Compute the relative error |I - I0|^2 / |I0|^2 of an image in dB.

    >>> import torch
    >>> from torchsar import metrics
    >>> image = torch.ones(8, 8, dtype=torch.complex64)
    >>> round(float(metrics.error_db(1.1 * image, image)), 2)
    -20.0

    A difference in gain or phase counts as error; use `correlation` where those are arbitrary.
    Differentiable, with the gradient 0 where there is no error.

    Args:
        image: Image I, shape (..., azimuth, range), complex, or a Signal.
        reference: Image I0, same size.

    Returns:
        Error in dB, shape (...,), float64.

    Raises:
        TypeError: If one of them is not a tensor of numbers.
        ValueError: If they are not complex images of equal size.
    """
    a, b = pair_of(image, reference)
    norm = _norm(b)
    ratio = _norm(a - b) / torch.where(norm == 0, 1, norm)
    return 20 * torch.log10(ratio.clamp_min(torch.finfo(ratio.dtype).tiny))


def error_after_gain_db(images: Tensor, references: Tensor) -> Tensor:
    """Compute the relative errors of images after multiplication by a common complex gain.

    >>> import torch
    >>> from torchsar import metrics
    >>> image = torch.tensor([[1.0, 2.0], [2.0, 1.0]]) + 0j
    >>> changed = 5j * (image + torch.tensor([[0.1, 0.0], [0.0, -0.1]]))
    >>> round(float(metrics.error_db(changed, image)), 1)
    14.2
    >>> round(float(metrics.error_after_gain_db(changed, image)), 1)
    -27.0

    One gain is used for all images: the one that fits them best to the references. Focusing methods
    and echo models may differ by such a constant without any loss of quality.

    Args:
        images: Images I, shape (..., azimuth, range), complex.
        references: Reference images I0, same size.

    Returns:
        Error |gain I - I0|^2 / |I0|^2 in dB, shape (...,), float64.

    Raises:
        TypeError: If one of them is not a tensor of numbers.
        ValueError: If they are not complex images of equal size.
    """
    a, b = pair_of(images, references)
    # a common level of all images, since they have a common gain
    a, b = (x / level_of(x, x.ndim) for x in (a, b))
    energy = power_of(a).sum(dtype=torch.float64)
    gain = (a.conj() * b).sum(dtype=torch.complex128) / torch.where(energy == 0, 1, energy)
    return error_db(a * gain.to(a.dtype), b)


def rolled_to(image: Signal, reference: Signal) -> Signal:
    """Shift an image circularly along both axes onto a reference image of the same scene.

    Autofocus leaves such shifts: a slope of the phase over pulses shifts an image circularly along
    azimuth, and range profiles can be aligned only up to a common shift in range.

    Args:
        image: Image (azimuth, range).
        reference: Image on the same axes.

    Returns:
        The shifted image. Along each axis the shift in whole samples is the difference between the
        circular means of the energy of the two images.
    """
    shifts = [
        round((_circular_centre(reference, dim) - _circular_centre(image, dim)) * image.axes[dim].n) for dim in (0, 1)
    ]
    return image.with_data(image.data.roll(shifts, (0, 1)))


def _circular_centre(image: Signal, dim: int) -> float:
    """Circular centre of the energy along an axis, as a fraction of the extent of the image."""
    n, power = image.axes[dim].n, image.data.abs().double().square().sum(1 - dim)
    turns = torch.arange(n, dtype=torch.float64, device=power.device) / n
    return float(torch.angle(torch.polar(power, 2 * torch.pi * turns).sum())) / (2 * torch.pi)
