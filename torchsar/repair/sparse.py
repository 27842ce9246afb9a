"""Reconstruction of missing lines by a model of the power of the focused image.

The image is split by Doppler into a few sub-looks. Every pixel of every sub-look is modelled as
independent zero-mean noise, whose power v varies slowly over the image. The most probable missing
lines minimise the sum of |pixel|^2 / v over all pixels of all sub-looks. This is a linear system in
the missing lines alone, solved by conjugate gradients. Then v is estimated anew from the
reconstructed image, and the system is solved again.

The first estimate (`bright_fill`) keeps only the bright part of the image; it finds points but no
texture. The model is better on recorded data for three reasons. A local power estimate follows
texture, which a threshold does not. Conjugate gradients converge faster than plain iteration. As v
differs between sub-looks, the model accounts for properties of the azimuth spectrum such as band
edges, noise floor, drift of the Doppler centroid over the scene, and apertures cut by the ends of
the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from torchsar.core import checked_samples, level_of
from torchsar.focus.defocus import InvertibleOmegaK, all_pass
from torchsar.radar import StripmapRadar


def power_of(x: Tensor) -> Tensor:
    """Return |x|^2 of complex samples of any shape.

    Args:
        x: Samples, any shape, complex.

    Returns:
        Powers, same shape, real.
    """
    return x.real.square() + x.imag.square()


def conjugate_fill(quadratic: Callable[[Tensor], Tensor], lines: Tensor, mask: Tensor, steps: int) -> Tensor:
    """Minimise the quadratic form <lines, quadratic(lines)> over the lines inside a mask.

    The method is conjugate gradients. Lines outside the mask are kept.

    Args:
        quadratic: Hermitian positive operator on lines (..., pulse, range).
        lines: Lines to begin with, shape (..., pulse, range), complex.
        mask: True for lines that may change, broadcasts against the lines, bool.
        steps: Number of steps; their lengths are chosen per trial.

    Returns:
        Lines of the same shape.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a.conj() * b).real.sum((-2, -1), keepdim=True)

    def over(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)

    residual = torch.where(mask, -quadratic(lines), 0)
    direction, left = residual, dot(residual, residual)
    for _ in range(steps):
        image = torch.where(mask, quadratic(direction), 0)
        length = over(left, dot(direction, image))
        lines, residual = lines + length * direction, residual - length * image
        before, left = left, dot(residual, residual)
        direction = residual + over(left, before) * direction
    return lines


def smooth(power: Tensor, azimuth: float, range_: float) -> Tensor:
    """Average power locally with Gaussian weights.

    Args:
        power: Power, shape (..., range, azimuth); continued periodically in azimuth and by its edge
            values in range.
        azimuth: Standard deviation of the weights in azimuth, in pixels.
        range_: Standard deviation of the weights in range, in pixels.

    Returns:
        Averaged power, same shape.
    """
    return _smooth_last(_smooth_last(power, azimuth, "circular").mT, range_, "replicate").mT


def _smooth_last(x: Tensor, sigma: float, edges: str) -> Tensor:
    """Gaussian average along the last dimension."""
    half = min(math.ceil(2.5 * sigma), x.shape[-1] - 1)
    offset = torch.arange(-half, half + 1, dtype=x.dtype, device=x.device)
    kernel = torch.exp(-0.5 * (offset / sigma).square())
    rows = pad(x.reshape(-1, 1, x.shape[-1]), (half, half), mode=edges)
    return conv1d(rows, (kernel / kernel.sum())[None, None]).reshape(x.shape)


def look_windows(n: int, looks: int, doppler_turns: Tensor) -> Tensor:
    """Return overlapping cosine windows that divide the Doppler spectrum into sub-looks.

    The squares of the windows sum to one at every frequency.

    Args:
        n: Number of Doppler cells.
        looks: Number of windows, evenly spaced about the Doppler centroid.
        doppler_turns: Doppler centroid in cycles per line, shape (...,), float64.

    Returns:
        Windows in FFT order, shape (look, ..., n), float64.
    """
    axis = torch.arange(n, dtype=torch.float64, device=doppler_turns.device) / n - doppler_turns[..., None]
    centre = ((torch.arange(looks, dtype=torch.float64, device=axis.device) + 0.5) / looks - 0.5).reshape(
        -1, *(1,) * axis.ndim
    )
    distance = torch.remainder(axis - centre + 0.5, 1) - 0.5
    window = torch.where(distance.abs() * looks < 1, torch.cos(torch.pi / 2 * looks * distance), 0)
    return window / window.square().sum(0).sqrt()


class SubLooks:
    """Covariance model of lines from the focused scene, divided by Doppler into sub-looks.

    Every pixel of every sub-look is modelled as independent zero-mean noise with a slowly varying
    power. Powers and weights of the sub-looks have the shape (look, ..., range, pulse): azimuth is
    last, which halves the time of the azimuth FFTs.

    Args:
        operator: Invertible focusing of the lines.
        windows: Amplitude weights over the n Doppler cells, shape (look, ..., n).
    """

    def __init__(self, operator: InvertibleOmegaK, windows: Tensor) -> None:
        self.operator = operator
        self.windows = windows[..., None, :]
        self.share = windows.square().mean(-1)[..., None, None]

    def power(self, lines: Tensor, unexplained: Tensor) -> Tensor:
        """Estimate the local power of every sub-look of the focused lines.

        The local power is the geometric mean of two estimates: the locally averaged power of the
        sub-look; and the mean power of the sub-look times the local power of the whole image
        relative to its mean.

        Args:
            lines: Lines, shape (..., pulse, range), complex.
            unexplained: Power in every pixel due to errors of the reconstructed lines, which is
                added to the local power; broadcasts against (..., range, pulse).

        Returns:
            Local power, shape (look, ..., range, pulse).
        """
        spectra = self.operator.to_doppler(lines).mT.contiguous()
        whole = power_of(torch.fft.ifft(spectra))
        mean = whole.mean((-2, -1), keepdim=True)
        local = smooth(whole, 1.0, 1.0) / torch.where(mean > 0, mean, 1)
        floor = torch.maximum(unexplained, 1e-9 * mean + torch.finfo(mean.dtype).tiny)
        result = []
        for window, share in zip(self.windows.to(mean.dtype), self.share.to(mean.dtype), strict=True):
            own = power_of(torch.fft.ifft(spectra * window)) / share
            expected = own.mean((-2, -1), keepdim=True) * local
            result.append(torch.sqrt(smooth(own, max(1.0, 0.8 * len(self.share)), 1.0) * expected) + floor)
        return torch.stack(result)

    def precision(self, lines: Tensor, weight: Tensor) -> Tensor:
        """Multiply lines by the inverse covariance matrix of the scene model.

        The product is the derivative, with respect to the conjugate lines, of the sum of weight
        |pixel|^2 over all pixels of all sub-looks.

        Args:
            lines: Lines, shape (..., pulse, range), complex.
            weight: Inverse powers of the pixels, shape (look, ..., range, pulse).

        Returns:
            Product of the same shape as the lines.
        """
        spectra = self.operator.to_doppler(lines).mT.contiguous()
        total = torch.zeros_like(spectra)
        for window, w in zip(self.windows.to(weight.dtype), weight, strict=True):
            total = total + window * torch.fft.fft(w * torch.fft.ifft(spectra * window))
        return self.operator.from_doppler(total.mT)


def bright_fill(
    lines: Tensor,
    mask: Tensor,
    operator: InvertibleOmegaK,
    steps: int = 20,
    first: float = 0.7,
    fall: float = 0.75,
    last: float = 2.0,
) -> Tensor:
    """Reconstruct missing lines from the bright part of the image, by iteration.

    Each step focuses the lines, sets pixels below a threshold to zero, defocuses the rest, and
    takes the missing lines from the result. This finds isolated bright points across gaps of any
    length, but no texture.

    Args:
        lines: Lines, zero where they are missing, shape (..., pulse, range), complex.
        mask: Missing lines, shape (..., pulse, 1), bool.
        operator: Invertible focusing of the lines.
        steps: Number of steps.
        first: First threshold, relative to the amplitude of the strongest pixel of each trial.
        fall: Factor by which the threshold is multiplied in each step.
        last: Lowest threshold, relative to the rms amplitude of the image.

    Returns:
        Lines of the same shape.
    """
    filled, threshold = lines, None
    for _ in range(steps):
        image = operator.focus(filled)
        size = image.detach().abs()
        rms = size.square().mean((-2, -1), keepdim=True).sqrt()
        threshold = (
            first * size.amax((-2, -1), keepdim=True)
            if threshold is None
            else torch.maximum(fall * threshold, last * rms)
        )
        filled = torch.where(mask, operator.defocus(torch.where(size > threshold, image, 0)), lines)
    return filled


def sparse_fill(
    lines: Tensor,
    missing: Tensor,
    radar: StripmapRadar,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    reference: Tensor | None = None,
    looks: int = 4,
    rounds: int = 2,
    steps: int = 4,
) -> Tensor:
    """Reconstruct the missing lines that are most probable under a model of the focused scene.

    The image is split by Doppler into sub-looks, whose pixels are modelled as independent noise of
    slowly varying local power. The first estimate is that of `bright_fill`. Two looks are enough
    for scenes of points; four or more are useful for speckle that fills the PRF band. More than two
    rounds or four steps are useful only in long gaps. With the default values the computation takes
    as long as about 110 two-dimensional FFTs. Received lines are kept bit for bit. Differentiable
    in the lines, with thresholds and local powers held fixed.

    Args:
        lines: Lines, shape (..., pulse, range), complex.
        missing: Missing lines, shape (..., pulse), bool.
        radar: Radar parameters.
        doppler_hz: Absolute Doppler centroid in Hz, a number or shape (...,); errors of a few Hz
            have little effect.
        velocity_m_s: Effective velocity in m/s, a number or shape (...,), by default that of the
            radar; small relative errors have little effect.
        reference: Range reference spectrum of raw lines, shape (range,), of which only the phase is
            used; None for range-compressed lines.
        looks: Number of sub-looks in Doppler.
        rounds: Number of estimates of the local powers.
        steps: Steps of conjugate gradients in each round.

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite.
    """
    lines = checked_samples(lines, "sparse_fill", "line, range")
    mask = missing.bool().expand(lines.shape[:-1])[..., None]
    x = torch.where(mask, 0, lines)
    level = level_of(x)
    x = x / level
    flat = None if reference is None else all_pass(reference)
    operator = InvertibleOmegaK(radar, x, doppler_hz=doppler_hz, velocity_m_s=velocity_m_s, reference=flat)
    turns = torch.as_tensor(doppler_hz, dtype=torch.float64, device=x.device) / radar.prf_hz
    model = SubLooks(operator, look_windows(x.shape[-2], looks, turns))
    missing_share = mask.to(x.real.dtype).mean((-2, -1), keepdim=True)
    unexplained = 0.5 * missing_share * power_of(x.detach()).mean((-2, -1), keepdim=True)
    x = bright_fill(x, mask, operator)
    for _ in range(rounds):
        power = model.power(x.detach(), unexplained)
        weight = power.mean((0, -2, -1), keepdim=True) / power
        x = conjugate_fill(lambda y, w=weight: model.precision(y, w), x, mask, steps)
        # variance of a missing line given all others, spread over the image
        unexplained = missing_share * (1 / (1 / power).mean((0, -1), keepdim=True))[0]
    return torch.where(mask, x * level, lines)
