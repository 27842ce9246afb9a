"""Periodic jitter of the range converter: correction by interpolation, and exactly.

A converter made of M interleaved ones takes sample n at the instant n + e[n mod M] (in samples). The phase of the pattern is that of
the first sample of every line. A common offset of all instants is a delay, which no record can tell from range: the estimators
put the mean offset to zero (origin "mean"), or the first one (origin "first"). Lines are taken as periodic, as every FFT does, so
that their two ends meet. Source: brief 004, item 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, cis, linear_phasor, real_dtype

MIN_GAP = 0.01


def smallest_gap(offset_samples: Tensor) -> Tensor:
    """Least distance of neighbouring sample instants, in samples. (..., M) -> (...,). Zero or less: they coincide or cross."""
    return 1 + (torch.roll(offset_samples, -1, -1) - offset_samples).amin(-1)


def refuse_crossing(offset_samples: Tensor) -> None:
    """Raise ValueError where offsets (..., M) are not finite or bring sample instants together, which no interpolation can undo."""
    offsets = offset_samples.detach()
    try:
        worst = float(torch.nan_to_num(smallest_gap(offsets), nan=-math.inf).min())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not worst >= MIN_GAP:
        shown = [round(x, 3) for x in offsets.reshape(-1, offsets.shape[-1])[0].tolist()]
        raise ValueError(f"jitter offsets must be finite and keep neighbouring sample instants at least {MIN_GAP} sample apart, got a gap of {worst:.3g} (offsets {shown} ...); check their sign and unit (samples)")


def sample_offsets(offset_samples: Tensor, n: int) -> Tensor:
    """The offset of every sample of a line, (..., M) -> (..., n)."""
    m = offset_samples.shape[-1]
    return offset_samples[..., torch.arange(n, device=offset_samples.device) % m]


def lagrange_weights(offset_samples: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """Weights (..., M, points) of the nearest samples and their first lag (..., M): x[n] = sum_k w[n mod M, k] y[n + first + k].

    The nodes lie at their true, uneven instants. An even number of nodes is centred on the interval that holds the wanted instant.
    """
    m = offset_samples.shape[-1]
    late = offset_samples.detach() > 0
    first = torch.where(late, -(points // 2), -((points - 1) // 2))
    phase = torch.arange(m, device=offset_samples.device)
    lag = first[..., None] + torch.arange(points, device=offset_samples.device)
    instant = lag + torch.gather(offset_samples, -1, ((phase[:, None] + lag) % m).flatten(-2)).reshape(lag.shape)
    own = torch.eye(points, dtype=torch.bool, device=offset_samples.device)
    apart = torch.where(own, 1, instant[..., :, None] - instant[..., None, :])
    return torch.where(own, 1, -instant[..., None, :] / apart).prod(-1), first


def correct_jitter_lagrange(y: Tensor, offset_samples: Tensor, points: int = 8) -> Tensor:
    """Samples at uniform instants by Lagrange interpolation through `points` neighbours. y: (..., pulse, range); offsets: (..., M) or (M,).

    Cheap, and limited by the oversampling: near the edge of the band a polynomial does not follow the signal. Any line length.
    Offsets of zero pass through untouched. Differentiable. Raises ValueError for offsets that coincide or cross.
    """
    refuse_crossing(offset_samples)
    n = y.shape[-1]
    weights, first = lagrange_weights(offset_samples.to(torch.float64), points)
    lowest = -(points // 2)
    shift = (first - lowest)[..., None]  # 0 or 1: both placements share one set of lags lowest .. lowest + points
    lag = torch.arange(points + 1, device=y.device)
    padded = torch.nn.functional.pad(weights, (1, 1))
    table = torch.gather(padded, -1, (lag + 1 - shift).clamp(0, points + 1)).to(real_dtype(y.dtype))
    out = torch.zeros_like(y)
    for k in range(points + 1):
        weight = sample_offsets(table[..., k], n)[..., None, :]
        out = out + weight * torch.roll(y, -(lowest + k), -1)
    return out


def correct_jitter_exact(y: Tensor, offset_samples: Tensor, refinements: int = 12) -> Tensor:
    """Exact periodic non-uniform reconstruction. y: (..., pulse, range) complex; offset_samples: (..., M) or (M,). Same shape.

    The M frequencies that the M decimated lines alias together are separated by one M x M inverse, the same for every group but for
    a diagonal. A line whose length is no multiple of M has a seam: it is solved as if extended to the next multiple, and what that
    leaves at its ends is removed by `refinements` steps of residual correction. Differentiable. Raises ValueError for offsets that
    coincide or cross.
    """
    refuse_crossing(offset_samples)
    offsets, n, m = offset_samples.to(torch.float64), y.shape[-1], offset_samples.shape[-1]
    if n < 2 * m:
        raise ValueError(f"lines of {n} samples hold less than two periods of {m}; give longer lines or a shorter period")
    if n % m == 0:
        return _separate(y, offsets)
    x = _solve_extended(y, offsets)
    for _ in range(refinements):
        x = x + _solve_extended(y - jittered(x, offsets), offsets)
    return x


def _solve_extended(y: Tensor, offsets: Tensor) -> Tensor:
    """_separate on lines continued round their seam to a multiple of M samples."""
    missing = -y.shape[-1] % offsets.shape[-1]
    return _separate(torch.cat([y, y[..., :missing]], -1), offsets)[..., : y.shape[-1]]


def _separate(y: Tensor, offsets: Tensor) -> Tensor:
    """correct_jitter_exact for lengths n = M q. With k = s + j + i q, s = -(n//2): Y_m[j] = e(s + j) sum_i V[m, i] X[k]."""
    n, m = y.shape[-1], offsets.shape[-1]
    q, start = n // m, -(n // 2)
    instant = torch.arange(m, dtype=torch.float64, device=y.device) + offsets
    lines = torch.fft.fft(y.unflatten(-1, (q, m)).mT)
    lines = torch.roll(lines, -start, -1)
    lines = lines * linear_phasor(-instant / n, start, q, y.dtype)[..., None, :, :]
    order = torch.arange(m, dtype=torch.float64, device=y.device)
    vandermonde = cis(2 * math.pi * (instant[..., :, None] * order / m)) / m
    spectrum = torch.linalg.inv(vandermonde).to(y.dtype)[..., None, :, :] @ lines
    return torch.fft.ifft(torch.fft.ifftshift(spectrum.flatten(-2), dim=-1))


def jittered(x: Tensor, offset_samples: Tensor) -> Tensor:
    """What a converter with these offsets makes of uniform samples x (..., pulse, range), band-limited and periodic; any length."""
    n, m = x.shape[-1], offset_samples.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(x), dim=-1)
    phase = torch.arange(n, device=x.device) % m
    out = torch.zeros_like(x)
    for i in range(m):
        turn = linear_phasor(offset_samples[..., i].to(torch.float64) / n, -(n // 2), n, x.dtype)
        moved = torch.fft.ifft(torch.fft.ifftshift(spectrum * turn[..., None, :], dim=-1))
        out = torch.where(phase == i, moved, out)
    return out


@dataclass(frozen=True)
class Lagrange:
    """Correction by Lagrange interpolation through this many neighbours: fast, limited near the band edges."""

    points: int = 8

    def __post_init__(self) -> None:
        if not 2 <= self.points <= 64:
            raise ValueError(f"Lagrange interpolation needs 2..64 points, got {self.points}; 4, 8 and 12 are usual")

    def __call__(self, y: Tensor, offset_samples: Tensor) -> Tensor:
        return correct_jitter_lagrange(y, offset_samples, self.points)


@dataclass(frozen=True)
class Exact:
    """Correction by exact periodic non-uniform reconstruction."""

    def __call__(self, y: Tensor, offset_samples: Tensor) -> Tensor:
        return correct_jitter_exact(y, offset_samples)


def correct_jitter(y: Tensor, offset_samples: Tensor, period: Tensor | None = None, method: Callable[[Tensor, Tensor], Tensor] | None = None) -> Tensor:
    """Correct trials whose periods may differ. offset_samples: (..., P), of which the first `period` (...,) count; None: all P.

    Trials of one period go together; those whose offsets are all zero pass through bitwise.
    """
    method = Exact() if method is None else method
    if offset_samples.ndim > 1 and offset_samples.shape[:-1] != y.shape[:-2]:
        raise ValueError(f"jitter offsets of shape {tuple(offset_samples.shape)} do not match the trial dims {tuple(y.shape[:-2])} of the data; give (M,) or (*trials, M)")
    if period is None:
        return method(y, offset_samples)
    batch = y.shape[:-2]
    rows = y.reshape(-1, *y.shape[-2:])
    offsets = offset_samples.expand(*batch, offset_samples.shape[-1]).reshape(rows.shape[0], -1)
    periods = torch.where((offsets != 0).any(-1), period.expand(batch).reshape(-1), 1)
    out = rows.clone()
    for m in torch.unique(periods).tolist():
        if m > 1:
            chosen = (periods == m).nonzero()[:, 0]
            out = out.index_copy(0, chosen, method(rows[chosen], offsets[chosen, :m]))
    return out.reshape(y.shape)


class CorrectJitter(Stage):
    """Undo periodic jitter with offsets given here or, in a chain, by PilotJitter or BlindJitter.

    Connect both values: `use(CorrectJitter(), offset_samples="pilot", period="pilot")`. method: `Exact()`, `Lagrange(8)`, or any
    function of (samples, offsets (..., M)).
    """

    def __init__(self, offset_samples: Tensor | None = None, method: Callable[[Tensor, Tensor], Tensor] | None = None) -> None:
        super().__init__()
        self.method = Exact() if method is None else method
        self.hold("offset_samples", torch.zeros(1) if offset_samples is None else offset_samples)
        refuse_crossing(self.offset_samples)

    def forward(self, signal: Signal, offset_samples: Tensor | None = None, period: Tensor | None = None) -> Signal:
        offsets = self.offset_samples if offset_samples is None else offset_samples
        return signal.with_data(correct_jitter(signal.data, offsets, period, self.method))
