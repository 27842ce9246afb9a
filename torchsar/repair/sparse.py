"""Missing lines from a model of the scene: where the focused image is dark, and when.

Model: the image, split by Doppler into a few sub-looks, is independent zero-mean noise of slowly
varying power v(look, pixel). The most probable missing lines minimise sum |image|^2 / v, a linear
system in the missing lines alone, solved by conjugate gradients; v is then estimated from the
repaired image, and again. It begins from "focus, keep the bright part, defocus, take the missing
lines" (brief 004, item 2), which alone finds points but no texture, and goes on with three changes
that each lower the error on recorded data: the threshold becomes a local power estimate (a soft
decision that follows texture), plain iteration becomes conjugate gradients, and sub-looks add what
the azimuth spectrum knows: band edges, noise floor, drift of the Doppler centroid over the scene,
apertures cut by the ends of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from torchsar.focus.defocus import InvertibleOmegaK, all_pass
from torchsar.radar import StripmapRadar


def unit_level(lines: Tensor) -> tuple[Tensor, Tensor]:
    """Lines over their largest sample, per trial, and that level (..., 1, 1): neither 1e-25 nor
    1e19 may under- or overflow when squared.
    """
    level = lines.detach().abs().amax((-2, -1), keepdim=True)
    level = torch.where(level > 0, level, 1)
    return lines / level, level


def power_of(x: Tensor) -> Tensor:
    return x.real.square() + x.imag.square()


def conjugate_fill(quadratic: Callable[[Tensor], Tensor], lines: Tensor, mask: Tensor, steps: int) -> Tensor:
    """Change lines under the mask so that <lines, quadratic(lines)> becomes least, by conjugate
    gradients from where they are.

    quadratic: Hermitian, positive, (..., pulse, range) -> same. mask: bool (..., pulse, 1). Step
    lengths are per trial.
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
    """Local mean of (..., range, azimuth) with Gaussian weights of these standard deviations;
    circular in azimuth, edges held in range.
    """
    return _smooth_last(_smooth_last(power, azimuth, "circular").mT, range_, "replicate").mT


def _smooth_last(x: Tensor, sigma: float, edges: str) -> Tensor:
    half = min(math.ceil(2.5 * sigma), x.shape[-1] - 1)
    offset = torch.arange(-half, half + 1, dtype=x.dtype, device=x.device)
    kernel = torch.exp(-0.5 * (offset / sigma).square())
    rows = pad(x.reshape(-1, 1, x.shape[-1]), (half, half), mode=edges)
    return conv1d(rows, (kernel / kernel.sum())[None, None]).reshape(x.shape)


def look_windows(n: int, looks: int, doppler_turns: Tensor) -> Tensor:
    """Overlapping cosine windows over the Doppler axis, squares summing to 1, centred evenly about
    the centroid. (look, ..., n), float64.

    doppler_turns: centroid in cycles per line, (...,).
    """
    axis = torch.arange(n, dtype=torch.float64, device=doppler_turns.device) / n - doppler_turns[..., None]
    centre = ((torch.arange(looks, dtype=torch.float64, device=axis.device) + 0.5) / looks - 0.5).reshape(
        -1, *(1,) * axis.ndim
    )
    distance = torch.remainder(axis - centre + 0.5, 1) - 0.5
    window = torch.where(distance.abs() * looks < 1, torch.cos(torch.pi / 2 * looks * distance), 0)
    return window / window.square().sum(0).sqrt()


class SubLooks:
    """The precision (inverse covariance) of lines under the scene model.

    windows: (look, ..., n) amplitude weights over Doppler.

    Powers and weights of sub-looks are held with azimuth last, (look, ..., range, pulse), where
    azimuth FFTs take half the time.
    """

    def __init__(self, operator: InvertibleOmegaK, windows: Tensor) -> None:
        self.operator = operator
        self.windows = windows[..., None, :]
        self.share = windows.square().mean(-1)[..., None, None]

    def power(self, lines: Tensor, unexplained: Tensor) -> Tensor:
        """v: local power of each sub-look, the geometric mean of its own and of what the whole
        image says of it.

        unexplained: power that errors of the filled lines may have in every pixel, broadcast
        against (..., range, pulse).
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
        """Lines -> gradient of sum weight |sub-look|^2."""
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
    """Focus, keep the bright part, defocus, take the missing lines from it, again and again: the
    iteration of brief 004 as it stands.

    The threshold falls from `first` of the strongest pixel by the factor `fall` a step, down to
    `last` times the rms of the image, per trial. Finds isolated bright points however long the gap;
    leaves texture to the model of powers. lines: zero under the mask (..., pulse, 1).
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
    """Missing lines that make the focused image most probable under a model of locally varying
    power. lines: (..., pulse, range).

    missing: bool (..., pulse). doppler_hz, velocity_m_s: absolute centroid and effective velocity,
    (...,); errors of a few Hz and a small fraction of the velocity cost little, since the model
    only asks where the image is dark. reference: range reference spectrum (range,) of raw lines, of
    which the phase is used; None for range-compressed lines. Begins from bright_fill. Two looks are
    enough for point-like scenes; more (4) pay for speckle that fills the PRF band; rounds beyond 2
    and steps beyond 4 pay only in long gaps. Costs about 110 two-dimensional FFTs by default.
    Received lines are kept bit for bit. Differentiable in lines, with thresholds and local powers
    held fixed.
    """
    mask = missing.bool().expand(lines.shape[:-1])[..., None]
    x, level = unit_level(torch.where(mask, 0, lines))
    flat = None if reference is None else all_pass(reference)
    operator = InvertibleOmegaK(radar, x, doppler_hz=doppler_hz, velocity_m_s=velocity_m_s, reference=flat)
    turns = torch.as_tensor(doppler_hz, dtype=torch.float64, device=x.device) / radar.prf_hz
    model = SubLooks(operator, look_windows(x.shape[-2], looks, turns))
    lost = mask.to(x.real.dtype).mean((-2, -1), keepdim=True)
    unexplained = 0.5 * lost * power_of(x.detach()).mean((-2, -1), keepdim=True)
    x = bright_fill(x, mask, operator)
    for _ in range(rounds):
        power = model.power(x.detach(), unexplained)
        weight = power.mean((0, -2, -1), keepdim=True) / power
        x = conjugate_fill(lambda y, w=weight: model.precision(y, w), x, mask, steps)
        # what a missing line keeps of its variance once the rest is known, spread over the image
        unexplained = lost * (1 / (1 / power).mean((0, -1), keepdim=True))[0]
    return torch.where(mask, x * level, lines)
