"""Reconstruction of missing lines by a model of the power of the focused image.

The image is split by Doppler into a few sub-looks. Every pixel of every sub-look is modelled as
independent zero-mean noise, whose power v varies slowly over the image. The most probable missing
lines minimise the sum of |pixel|^2 / v over all pixels of all sub-looks. This is a linear system in
the missing lines alone, solved by conjugate gradients. Then v is estimated again from the
reconstructed image, and the system is solved again. The first estimate (`bright_fill`) keeps only
the bright part of the image; it finds points but no texture.

The model is better on recorded data than a threshold (`bright_fill`) for three reasons. A local
power estimate follows texture, which a threshold does not. Conjugate gradients converge faster than
plain iteration. The power v differs between sub-looks, and the model thus describes band edges,
noise floor and drift of the Doppler centroid over the scene. It also describes apertures cut by the
ends of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.core import (
    block_bytes_of,
    checked_samples,
    host_largest,
    host_value,
    is_plain,
    level_of,
    over_blocks,
    power_of,
)
from torchsar.focus.stored_omega_k import InvertibleOmegaK, all_pass
from torchsar.radar import StripmapRadar

# relative change in power of the missing lines below which they no longer change, by choice
_SETTLED = 1e-5


def conjugate_fill(quadratic: Callable[[Tensor], Tensor], lines: Tensor, residual: Tensor, steps: int) -> Tensor:
    """Minimise a quadratic form over some lines, by conjugate gradients.

    Args:
        quadratic: Hermitian positive operator on those lines: maps (..., a, b) to the same shape,
            and is zero for all other lines.
        lines: Lines to begin with, shape (..., a, b), complex.
        residual: Steepest descent there, which is zero for lines that are kept, same shape.
        steps: Number of steps; their lengths are chosen per trial.

    Returns:
        Lines of the same shape.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a.conj() * b).real.sum((-2, -1), keepdim=True)

    def over(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b > 0, a / torch.where(b > 0, b, 1), 0)

    direction, left = residual, dot(residual, residual)
    for _ in range(steps):
        image = quadratic(direction)
        length = over(left, dot(direction, image))
        lines, residual = lines + length * direction, residual - length * image
        before, left = left, dot(residual, residual)
        direction = residual + over(left, before) * direction
    return lines


def smooth(power: Tensor, sigma: float, dim: int, circular: bool) -> Tensor:
    """Average power along one dimension with Gaussian weights.

    Args:
        power: Power, any shape.
        sigma: Standard deviation of the weights in samples.
        dim: The dimension.
        circular: Whether the power is continued periodically; otherwise by its edge values.

    Returns:
        Averaged power, same shape.
    """
    n = power.shape[dim]
    half = min(math.ceil(2.5 * sigma), n - 1)
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(half + 1)]
    whole = weights[0] + 2 * sum(weights[1:])
    edges = [power.narrow(dim, n - half, half), power.narrow(dim, 0, half)]
    if not circular:
        edges = [power.narrow(dim, i, 1).expand_as(edge) for i, edge in zip((0, n - 1), edges, strict=True)]
    wide = torch.cat([edges[0], power, edges[1]], dim)
    total = power * (weights[0] / whole)
    for offset in range(1, half + 1):
        beside = wide.narrow(dim, half - offset, n) + wide.narrow(dim, half + offset, n)
        total = total.add_(beside, alpha=weights[offset] / whole)
    return total


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


class IncompleteLines:
    """Lines of which some are missing, and their focused azimuth spectra.

    Lines are represented by their range spectra: a line is missing at all range frequencies alike,
    so that the range FFTs of the lines are needed once, and not at every focusing. Arrays have the
    shape (..., range, azimuth), which doubles the speed of the azimuth FFTs. They are processed in
    blocks that stay in the cache, except for gradients and inside torch.func transforms.

    Args:
        operator: Invertible focusing of the lines.
        lines: Lines, zero where they are missing, shape (..., pulse, range), complex.
        mask: Missing lines, shape (..., pulse), bool. m is their largest number in a trial; trials
            with fewer of them have zeros in place of the others.
    """

    def __init__(self, operator: InvertibleOmegaK, lines: Tensor, mask: Tensor) -> None:
        self.operator = operator
        self.received = torch.fft.fft(lines).mT.contiguous()
        self.energy = power_of(self.received.detach()).sum((-2, -1), keepdim=True)
        most = max(1, host_largest(mask.sum(-1), mask.shape[-1]))
        order = torch.sort(mask.to(torch.uint8), dim=-1, descending=True, stable=True).indices
        self._index = order[..., None, :most]
        self._there = mask[..., None, :].gather(-1, self._index)
        tensors = (self.received, operator.bulk, operator.fine)
        tracked = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
        self._whole = tracked or not all(is_plain(x) for x in (*tensors, self._index))

    def lines(self, missing: Tensor) -> Tensor:
        """Return lines that are zero but for the missing ones.

        Args:
            missing: Range spectra of missing lines, shape (..., range frequency, m).

        Returns:
            Lines, shape (..., pulse, range).
        """
        return self._put(torch.zeros_like(self.received), torch.fft.ifft(missing, dim=-2)).mT

    def spectra(self, missing: Tensor, received: bool = True) -> Tensor:
        """Compute the focused azimuth spectra of the lines.

        Args:
            missing: Range spectra of missing lines, shape (..., range frequency, m).
            received: Whether to include the received lines.

        Returns:
            Azimuth spectra, shape (..., range, Doppler).
        """

        def azimuth(rows: slice) -> Tensor:
            others = self.received[..., rows, :]
            return torch.fft.fft(self._put(others if received else torch.zeros_like(others), missing[..., rows, :]))

        spectra = self.in_blocks(azimuth, _spaced(self.received, self.received.shape), -2)
        return self.in_blocks(
            lambda columns: self.operator.compress(spectra[..., columns].mT.contiguous(), columns).mT, spectra, -1
        )

    def missing(self, spectra: Tensor) -> Tensor:
        """Compute the missing lines from focused azimuth spectra.

        Args:
            spectra: Azimuth spectra, shape (..., range, Doppler); may be overwritten.

        Returns:
            Range spectra of missing lines, shape (..., range frequency, m).
        """
        expanded = self.in_blocks(
            lambda columns: self.operator.expand(spectra[..., columns].mT.contiguous(), columns).mT, spectra, -1
        )
        return self.in_blocks(
            lambda rows: torch.where(self._there, self.taken(torch.fft.ifft(expanded[..., rows, :])), 0),
            expanded.new_empty((*expanded.shape[:-1], self._index.shape[-1])),
            -2,
        )

    def in_blocks(self, make: Callable[[slice], Tensor], out: Tensor, dim: int) -> Tensor:
        """Compute an array in blocks of rows or of columns.

        Args:
            make: Function of a slice of the rows or columns, which returns this part of the array.
            out: Array that receives the result, shape (..., row, column).
            dim: -2 for blocks of rows, -1 for blocks of columns.

        Returns:
            The array: `out`, or a new one where a block may not be written.
        """
        if self._whole:
            return make(slice(None))
        n, beside = out.shape[dim], max(1, self.received.numel() // self.received.shape[dim])
        # The least number of columns was measured: with fewer, reading and writing takes longer.
        # Four arrays share the cache.
        least = 32 if dim == -1 else 1
        size = block_bytes_of(out.device) // (4 * beside * self.received.element_size())
        step = max(1, size // least) * least

        def work(part: slice) -> None:
            out[(..., part) if dim == -1 else (..., part, slice(None))] = make(part)

        over_blocks(work, (slice(first, min(n, first + step)) for first in range(0, n, step)), out)
        return out

    def _put(self, others: Tensor, missing: Tensor) -> Tensor:
        """Add missing lines (..., f, m) to lines (..., f, pulse)."""
        return others.scatter_add(-1, self._index.expand(missing.shape), missing)

    def taken(self, lines: Tensor) -> Tensor:
        """Return the missing lines (..., f, m) of lines (..., f, pulse)."""
        return lines.gather(-1, self._index.expand(*lines.shape[:-1], -1))


def _spaced(like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Empty array whose rows begin at distances of an odd number of cache lines.

    If the distance were a power of two, the samples of a column would share a few places in the
    cache.
    """
    line = 64 // like.element_size()  # a cache line has 64 bytes
    wide = like.new_empty((*shape[:-1], line * (-(-shape[-1] // line) | 1)))
    return wide[..., : shape[-1]]


class SubLooks:
    """Covariance model of lines from the focused scene, divided by Doppler into sub-looks.

    Every pixel of every sub-look is modelled as independent zero-mean noise with a slowly varying
    power. A sub-look fills 2 / looks of the Doppler band, so that every `step`-th pixel in azimuth
    holds it; the step divides the number of lines. Powers and weights of the sub-looks have the
    shape (look, ..., range, pixel).

    Args:
        scene: Lines of which some are missing.
        windows: Amplitude weights over the n Doppler cells, shape (look, ..., n).
    """

    def __init__(self, scene: IncompleteLines, windows: Tensor) -> None:
        self.scene = scene
        real = scene.received.real.dtype
        self.windows = windows[..., None, :].to(real)
        looks, n = len(windows), windows.shape[-1]
        self.step = max(q for q in range(1, max(1, looks // 2) + 1) if n % q == 0)
        # the factor `step` is included because the inverse FFT of the folded spectrum is larger by
        # it
        self.share = self.step**2 * windows.square().mean(-1)[..., None, None].to(real)

    def _pixels(self, spectra: Tensor, window: Tensor) -> Tensor:
        """Pixels (..., n / step) of a sub-look from azimuth spectra (..., n)."""
        return torch.fft.ifft((spectra * window).unflatten(-1, (self.step, -1)).sum(-2))

    def power(self, missing: Tensor, unexplained: Tensor) -> Tensor:
        """Estimate the local power of every sub-look of the focused lines.

        The local power is the geometric mean of two estimates. The first is the locally averaged
        power of the sub-look. The second is the mean power of the sub-look times the local power of
        the whole image relative to its mean.

        Args:
            missing: Range spectra of missing lines, shape (..., range frequency, m).
            unexplained: Power in every pixel due to errors of the reconstructed lines, which is
                added to the local power; broadcasts against (..., range, 1).

        Returns:
            Local power, shape (look, ..., range, pixel).
        """
        spectra = self.scene.spectra(missing)
        sigma = max(1.0, 0.8 * len(self.windows) / self.step)

        def images(rows: slice) -> Tensor:
            whole = smooth(power_of(torch.fft.ifft(spectra[..., rows, :])), 1.0, -1, True)[..., :: self.step]
            own = power_of(self._pixels(spectra[..., rows, :], self.windows)) / self.share
            return torch.cat([smooth(own, sigma, -1, True), whole[None]])

        shape = (len(self.windows) + 1, *spectra.shape[:-1], spectra.shape[-1] // self.step)
        smoothed = self.scene.in_blocks(images, _spaced(spectra.real, shape), -2)
        means = smoothed.mean((-2, -1), keepdim=True)
        own_mean, mean = means[:-1], means[-1]
        floor = torch.maximum(unexplained, 1e-9 * mean)

        def local(columns: slice) -> Tensor:
            both = smooth(smoothed[..., columns], 1.0, -2, False)
            expected = own_mean * (both[-1] / torch.where(mean > 0, mean, 1))
            return torch.sqrt((both[:-1] * expected).clamp_min(torch.finfo(mean.dtype).tiny)) + floor

        return self.scene.in_blocks(local, torch.empty_like(smoothed[:-1]), -1)

    def precision(self, missing: Tensor, weight: Tensor, received: bool = False) -> Tensor:
        """Multiply lines by the inverse covariance matrix of the scene model.

        The product is the derivative, with respect to the conjugate lines, of the sum of weight
        |pixel|^2 over all pixels of all sub-looks.

        Args:
            missing: Range spectra of missing lines, shape (..., range frequency, m).
            weight: Inverse powers of the pixels, shape (look, ..., range, pixel).
            received: Whether to include the received lines.

        Returns:
            Product in the missing lines, shape (..., range frequency, m).
        """
        spectra = self.scene.spectra(missing, received)

        def weighted(rows: slice) -> Tensor:
            total = torch.zeros_like(spectra[..., rows, :])
            for window, w in zip(self.windows, weight, strict=True):
                # adjoint of `_pixels`
                folded = torch.fft.fft(w[..., rows, :] * self._pixels(spectra[..., rows, :], window))
                total = total + window * torch.cat([folded] * self.step, -1)
            return total

        return self.scene.missing(self.scene.in_blocks(weighted, spectra, -2))


def bright_fill(
    scene: IncompleteLines, steps: int = 20, first: float = 0.7, fall: float = 0.6, last: float = 2.0
) -> Tensor:
    """Reconstruct missing lines from the bright part of the image, by iteration.

    Each step focuses the lines, sets pixels below a threshold to zero, defocuses the rest, and
    takes the missing lines from the result. This finds isolated bright points across gaps of any
    length, but no texture.

    Args:
        scene: Lines of which some are missing.
        steps: Largest number of steps. A trial ends earlier once its threshold no longer falls and
            its missing lines no longer change.
        first: First threshold, relative to the amplitude of the strongest pixel of each trial.
        fall: Factor by which the threshold is multiplied in each step.
        last: Lowest threshold, relative to the rms amplitude of the image.

    Returns:
        Range spectra of missing lines, shape (..., range frequency, m).
    """
    missing, threshold = torch.zeros_like(scene.taken(scene.received)), None
    active = torch.ones_like(missing[..., :1, :1], dtype=torch.bool)
    for _ in range(steps):
        spectra = scene.spectra(missing)
        # lowest threshold: a multiple of the mean power of the pixels of the image
        energy = scene.energy + power_of(missing.detach()).sum((-2, -1), keepdim=True)
        lowest = last**2 * (energy / (scene.received.shape[-2] ** 2 * scene.received.shape[-1]))
        if threshold is None:
            peaks = scene.in_blocks(
                lambda rows, of=spectra: power_of(torch.fft.ifft(of.detach()[..., rows, :])).amax(-1, keepdim=True),
                spectra.real.new_empty((*spectra.shape[:-1], 1)),
                -2,
            )
            threshold = first**2 * peaks.amax(-2, keepdim=True)
        else:
            threshold = torch.maximum(fall**2 * threshold, lowest)

        def bright(rows: slice, spectra: Tensor = spectra, threshold: Tensor = threshold) -> Tensor:
            image = torch.fft.ifft(spectra[..., rows, :])
            return torch.fft.fft(torch.where(power_of(image) > threshold, image, 0))

        before, found = missing, scene.missing(scene.in_blocks(bright, spectra, -2))
        missing = torch.where(active, found, before)
        change, size = (power_of(x.detach()).sum((-2, -1), keepdim=True) for x in (found - before, found))
        active = active & ((threshold > lowest) | (change > _SETTLED * size))
        if not host_value(active.any(), True):
            break
    return missing


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
    steps: int = 2,
) -> Tensor:
    """Reconstruct the missing lines that are most probable under a model of the focused scene.

    >>> import torch
    >>> from torchsar import radar, repair
    >>> sensor = radar.StripmapRadar(3.2e9, radar.LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4e3)
    >>> lines = torch.exp(-0.0015j * torch.arange(-32, 32) ** 2)[:, None] * torch.eye(16)[8]
    >>> missing = torch.arange(64) % 16 == 3
    >>> (repair.sparse_fill(lines, missing, sensor, doppler_hz=0.0) - lines).abs().max() < 0.05
    tensor(True)

    The image is split by Doppler into sub-looks, whose pixels are modelled as independent noise of
    slowly varying local power. The first estimate is that of `bright_fill`. Two looks are enough
    for scenes of points; four or more are useful for speckle that fills the PRF band. More than two
    rounds or two steps are useful only in long gaps. With the default values and 1 % of the lines
    missing, the FFTs of the computation are those of about 65 two-dimensional ones. Received lines
    are kept bit for bit. Differentiable in the lines.

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
    mask = missing.bool().expand(lines.shape[:-1])
    x = torch.where(mask[..., None], 0, lines)
    level = level_of(x)
    x = x / level
    operator = InvertibleOmegaK(
        radar,
        x,
        doppler_hz=doppler_hz,
        velocity_m_s=velocity_m_s,
        reference=None if reference is None else all_pass(reference),
    )
    turns = torch.as_tensor(doppler_hz, dtype=torch.float64, device=x.device) / radar.prf_hz
    scene = IncompleteLines(operator, x, mask)
    model = SubLooks(scene, look_windows(x.shape[-2], looks, turns.expand(x.shape[:-2])))
    missing_share = mask.to(x.real.dtype).mean(-1)[..., None, None]
    unexplained = 0.5 * missing_share * power_of(x).mean((-2, -1), keepdim=True)
    found = bright_fill(scene)
    for _ in range(rounds):
        power = model.power(found, unexplained)
        inverse = 1 / power
        weight = power.mean((0, -2, -1), keepdim=True) * inverse
        residual = -model.precision(found, weight, received=True)
        found = conjugate_fill(lambda y, w=weight: model.precision(y, w), found, residual, steps)
        # variance of a missing line given all others, spread over the pixels of the image
        unexplained = missing_share * (1 / inverse.mean((0, -1), keepdim=True))[0]
    return torch.where(mask[..., None], scene.lines(found) * level, lines)
