"""Periodic jitter of the range converter: correction by interpolation, and exactly.

A converter made of M interleaved ones takes sample n at the instant n + e[n mod M] (in samples).
The phase of the pattern is that of the first sample of every line. A common offset of all instants
is a delay, which no record can tell from range: the estimators put the mean offset to zero (origin
"mean"), or the first one (origin "first"). Lines are taken as periodic, as every FFT does, so that
their two ends meet. Source: brief 004, item 4.
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
    """Least distance of neighbouring sample instants, in samples. (..., M) -> (...,).

    Zero or less: they coincide or cross.
    """
    return 1 + (torch.roll(offset_samples, -1, -1) - offset_samples).amin(-1)


def refuse_crossing(offset_samples: Tensor) -> None:
    """Raise ValueError where offsets (..., M) are not finite or bring sample instants together,
    which no interpolation can undo.
    """
    offsets = offset_samples.detach()
    try:
        worst = float(torch.nan_to_num(smallest_gap(offsets), nan=-math.inf).min())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if not worst >= MIN_GAP:
        shown = [round(x, 3) for x in offsets.reshape(-1, offsets.shape[-1])[0].tolist()]
        gap = f"at least {MIN_GAP} sample apart, got a gap of {worst:.3g} (offsets {shown} ...)"
        raise ValueError(
            f"jitter offsets must be finite and keep neighbouring sample instants {gap}; check "
            "their sign and unit (samples)"
        )


def sample_offsets(offset_samples: Tensor, n: int) -> Tensor:
    """The offset of every sample of a line, (..., M) -> (..., n)."""
    m = offset_samples.shape[-1]
    return offset_samples[..., torch.arange(n, device=offset_samples.device) % m]


def neighbours(offset_samples: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """True instants (..., M, points) of the nearest samples relative to the wanted uniform one, and
    the lag (..., M) of the first.

    An even number of nodes is centred on the interval that holds the wanted instant.
    """
    m, device = offset_samples.shape[-1], offset_samples.device
    first = torch.where(offset_samples.detach() > 0, -(points // 2), -((points - 1) // 2))
    lag = first[..., None] + torch.arange(points, device=device)
    phase = (torch.arange(m, device=device)[:, None] + lag) % m
    return lag + torch.gather(offset_samples, -1, phase.flatten(-2)).reshape(lag.shape), first


def lagrange_weights(instants: Tensor) -> Tensor:
    """Weights of samples at uneven instants for the polynomial through them at instant 0.

    (..., points) -> (..., points).
    """
    own = torch.eye(instants.shape[-1], dtype=torch.bool, device=instants.device)
    apart = torch.where(own, 1, instants[..., :, None] - instants[..., None, :])
    return torch.where(own, 1, -instants[..., None, :] / apart).prod(-1)


def band_limited_weights(instants: Tensor, band: float, floor: float = 1e-9) -> Tensor:
    """Weights of least mean square error for a flat spectrum over the fraction `band` of the
    sampling rate, at instant 0.

    Solves sinc(band (t_i - t_j)) w = sinc(band t_i); `floor` (relative power of white noise) keeps
    the solve well posed.
    """
    eye = torch.eye(instants.shape[-1], dtype=instants.dtype, device=instants.device)
    gram = torch.sinc(band * (instants[..., :, None] - instants[..., None, :])) + floor * eye
    return torch.linalg.solve(gram, torch.sinc(band * instants)[..., None])[..., 0]


def _combine(y: Tensor, weights: Tensor, first: Tensor) -> Tensor:
    """x[n] = sum_k weights[n mod M, k] y[n + first[n mod M] + k], lines taken as periodic.

    weights: (..., M, points); first: (..., M).
    """
    points = weights.shape[-1]
    lowest = -(points // 2)
    # 0 or 1: both placements share the lags lowest .. lowest + points
    shift = (first - lowest)[..., None]
    lag = torch.arange(points + 1, device=y.device)
    table = torch.gather(torch.nn.functional.pad(weights, (1, 1)), -1, (lag + 1 - shift).clamp(0, points + 1)).to(
        real_dtype(y.dtype)
    )
    out = torch.zeros_like(y)
    for k in range(points + 1):
        out = out + sample_offsets(table[..., k], y.shape[-1])[..., None, :] * torch.roll(y, -(lowest + k), -1)
    return out


def correct_jitter_lagrange(y: Tensor, offset_samples: Tensor, points: int = 8) -> Tensor:
    """Samples at uniform instants by Lagrange interpolation through `points` neighbours.

    y: (..., pulse, range); offsets: (..., M) or (M,).

    Cheap, and limited by the oversampling: near the edge of the band a polynomial does not follow
    the signal. Any line length. Offsets of zero pass through untouched. Differentiable. Raises
    ValueError for offsets that coincide or cross.
    """
    refuse_crossing(offset_samples)
    instants, first = neighbours(offset_samples.to(torch.float64), points)
    return _combine(y, lagrange_weights(instants), first)


def correct_jitter_band_limited(y: Tensor, offset_samples: Tensor, points: int = 8, band: float = 0.95) -> Tensor:
    """As correct_jitter_lagrange at the same cost, with the weights that are best for a signal that
    fills `band` of the sampling rate.

    At a band of 0.8 and offsets up to 0.18 sample: -29, -43, -55 dB for 4, 8, 12 points, where
    Lagrange reaches -23, -28, -32 dB.
    """
    refuse_crossing(offset_samples)
    instants, first = neighbours(offset_samples.to(torch.float64), points)
    return _combine(y, band_limited_weights(instants, band), first)


def correct_jitter_exact(y: Tensor, offset_samples: Tensor, refinements: int | None = None) -> Tensor:
    """Exact periodic non-uniform reconstruction.

    y: (..., pulse, range) complex; offset_samples: (..., M) or (M,). Same shape.

    The M frequencies that the M decimated lines alias together are separated by one M x M inverse,
    the same for every group but for a diagonal. A line whose length is no multiple of M has a seam:
    it is solved as if extended to the next multiple, and what that leaves at its ends is removed by
    `refinements` steps of residual correction (default 6 in complex64, 12 in complex128).
    Differentiable. Raises ValueError for offsets that coincide or cross.
    """
    refuse_crossing(offset_samples)
    offsets, n, m = offset_samples.to(torch.float64), y.shape[-1], offset_samples.shape[-1]
    if n < 2 * m:
        raise ValueError(
            f"lines of {n} samples hold less than two periods of {m}; give longer lines or a shorter period"
        )
    if n % m == 0:
        return _separate(y, offsets)
    x = _solve_extended(y, offsets)
    for _ in range((6 if y.dtype == torch.complex64 else 12) if refinements is None else refinements):
        x = x + _solve_extended(y - jittered(x, offsets), offsets)
    return x


def _solve_extended(y: Tensor, offsets: Tensor) -> Tensor:
    """_separate on lines continued round their seam to a multiple of M samples."""
    missing = -y.shape[-1] % offsets.shape[-1]
    return _separate(torch.cat([y, y[..., :missing]], -1), offsets)[..., : y.shape[-1]]


def _separate(y: Tensor, offsets: Tensor) -> Tensor:
    """correct_jitter_exact for lengths n = M q.

    With k = s + j + i q, s = -(n//2): Y_m[j] = e(s + j) sum_i V[m, i] X[k].
    """
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
    """What a converter with these offsets makes of uniform samples x (..., pulse, range),
    band-limited and periodic; any length.
    """
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
    """Correction by Lagrange interpolation through this many neighbours: fast, limited near the
    band edges.
    """

    points: int = 8

    def __post_init__(self) -> None:
        if not 2 <= self.points <= 64:
            raise ValueError(f"Lagrange interpolation needs 2..64 points, got {self.points}; 4, 8 and 12 are usual")

    def __call__(self, y: Tensor, offset_samples: Tensor) -> Tensor:
        return correct_jitter_lagrange(y, offset_samples, self.points)


@dataclass(frozen=True)
class BandLimited:
    """Correction by the best local weights for a signal of this bandwidth over sampling rate: the
    cost of Lagrange, far more exact.
    """

    points: int = 8
    band: float = 0.95

    def __post_init__(self) -> None:
        if not (2 <= self.points <= 64 and 0 < self.band <= 1):
            raise ValueError(
                "band-limited interpolation needs 2..64 points and a band in 0..1 of the sampling "
                f"rate, got {self.points} and {self.band}"
            )

    def __call__(self, y: Tensor, offset_samples: Tensor) -> Tensor:
        return correct_jitter_band_limited(y, offset_samples, self.points, self.band)


@dataclass(frozen=True)
class Exact:
    """Correction by exact periodic non-uniform reconstruction."""

    def __call__(self, y: Tensor, offset_samples: Tensor) -> Tensor:
        return correct_jitter_exact(y, offset_samples)


def correct_jitter(
    y: Tensor,
    offset_samples: Tensor,
    period: Tensor | None = None,
    method: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Tensor:
    """Correct trials whose periods may differ.

    offset_samples: (..., P), of which the first `period` (...,) count; None: all P.

    Trials of one period go together; those whose offsets are all zero pass through bitwise.
    """
    method = Exact() if method is None else method
    if offset_samples.ndim > 1 and offset_samples.shape[:-1] != y.shape[:-2]:
        raise ValueError(
            f"jitter offsets of shape {tuple(offset_samples.shape)} do not match the trial dims "
            f"{tuple(y.shape[:-2])} of the data; give (M,) or (*trials, M)"
        )
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

    Connect both values: `use(CorrectJitter(), offset_samples="pilot", period="pilot")`. method:
    `Exact()`, `BandLimited(8, 0.8)`, `Lagrange(8)`, or any function of (samples, offsets (..., M)).
    """

    offset_samples: Tensor

    def __init__(
        self, offset_samples: Tensor | None = None, method: Callable[[Tensor, Tensor], Tensor] | None = None
    ) -> None:
        super().__init__()
        self.method = Exact() if method is None else method
        self.hold("offset_samples", torch.zeros(1) if offset_samples is None else offset_samples)
        refuse_crossing(self.offset_samples)

    def forward(self, signal: Signal, offset_samples: Tensor | None = None, period: Tensor | None = None) -> Signal:
        offsets = self.offset_samples if offset_samples is None else offset_samples
        return signal.with_data(correct_jitter(signal.data, offsets, period, self.method))
