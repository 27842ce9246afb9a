"""Dechirped sweeps of a triangular-FMCW ladar, by direct evaluation of the light in float64.

The signal model is that of Remote Sens. 2024, 16, 793, section 2.2. The laser emits light whose
frequency rises and falls linearly without a pause. Every sample is the product of the delayed
laser and the conjugate of the echo, at the true distance from the ladar to the scatterer at the
instant of the reflection: motion and flight of the ladar go on during the sweep and the flight of
the light. After each turning point the beat is another one until the echo has turned as well, the
beam lights a scatterer from one sample on, in the middle of a sweep, and the detector integrates
over a sampling interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# speed of light in m/s
C = 299_792_458.0
F64 = torch.float64
_BLOCK = 1 << 17  # samples times scatterers that are computed at once


@dataclass(frozen=True)
class Ladar:
    """Numbers of a ladar; a sweep is half the period."""

    carrier_hz: float = C / 1.55e-6
    bandwidth_hz: float = 5e9
    period_s: float = 16e-6
    sampling_hz: float = 64e6
    speed_m_s: float = 60.0
    reference_m: float = 3000.0
    beam_rad: float = math.inf
    parts: int = 1  # instants per sampling interval over which the detector integrates
    trigger_s: float = 0.0  # time at which a triangle begins, beside whole and half periods

    def sweep(self, t: Tensor) -> Tensor:
        """Cycles of the laser at the time t; without a trigger time an up sweep ends at zero."""
        half = self.period_s / 2
        late = torch.remainder(t - self.trigger_s + half, self.period_s)
        u = torch.where(late < half, late, late - half) - half / 2
        rise = self.bandwidth_hz / half / 2 * (u.square() - half**2 / 4)
        return torch.where(late < half, rise, -rise)

    def beat(
        self, t: Tensor, x: Tensor, range_m: Tensor, amplitude: Tensor, moved: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Beat at times t on the clock of the delayed laser, any shape, complex128.

        The times of `moved` and of the position of the ladar are those of the reflection at the
        reference range.
        """
        near = self.reference_m + range_m
        flown = self.speed_m_s * self.reference_m / C  # between the reflection and the reception
        late = torch.zeros((), dtype=F64)
        lit = torch.ones((), dtype=F64)
        for _ in range(3):
            reflected = t[..., None] - late / 2
            across = self.speed_m_s * reflected - x
            bent = sum(a.square() / (torch.hypot(near, a) + near) for a in (across - flown, across + flown)) / 2
            late = 2 / C * (range_m + bent + moved(reflected))
            lit = (across.abs() <= self.beam_rad * near / 2).to(F64)
        turns = self.carrier_hz * late + self.sweep(t)[..., None] - self.sweep(t[..., None] - late)
        echoes = torch.polar(lit.expand_as(turns), 2 * math.pi * torch.remainder(turns, 1))
        return echoes @ amplitude.to(torch.complex128)

    def sampled(
        self, t: Tensor, x: Tensor, range_m: Tensor, amplitude: Tensor, moved: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Samples of the detector at times t (line, sample), complex128."""
        lines = max(1, _BLOCK // (t.shape[-1] * len(x)))
        done = []
        for some in t.split(lines):
            total = torch.zeros(some.shape, dtype=torch.complex128)
            for part in range(self.parts):
                apart = (part - (self.parts - 1) / 2) / (self.parts * self.sampling_hz)
                total = total + self.beat(some + apart, x, range_m, amplitude, moved)
            done.append(total / self.parts)
        return torch.cat(done)

    def sweeps(
        self,
        x: Tensor,
        range_m: Tensor,
        amplitude: Tensor,
        periods: int,
        moved: Callable[[Tensor], Tensor] = torch.zeros_like,
    ) -> Tensor:
        """Separated sweeps without noise, (2, period, sample), up sweeps first.

        The turning point of period `periods // 2` lies at the time zero, where the ladar passes
        x = 0; samples lie symmetrically about the middle of a sweep.
        """
        n = round(self.period_s / 2 * self.sampling_hz)
        u = (torch.arange(n, dtype=F64) - (n - 1) / 2) / self.sampling_hz
        start = (torch.arange(periods, dtype=F64) - periods // 2 - 0.5) * self.period_s
        middles = start + self.period_s * torch.tensor([0.25, 0.75], dtype=F64)[:, None]
        return self.sampled(middles.flatten()[:, None] + u, x, range_m, amplitude, moved).view(2, periods, n)

    def record(
        self,
        x: Tensor,
        range_m: Tensor,
        amplitude: Tensor,
        blocks: int,
        samples: int,
        every: int = 1,
        moved: Callable[[Tensor], Tensor] = torch.zeros_like,
    ) -> Tensor:
        """Continuous blocks without noise, one of `every` periods, (block, sample) complex128.

        The first sample lies half a sampling interval after the start of a block. The block
        `blocks // 2` starts half a period before the time zero.
        """
        start = (torch.arange(blocks, dtype=F64) - blocks // 2) * every * self.period_s - self.period_s / 2
        t = start[:, None] + (torch.arange(samples, dtype=F64) + 0.5) / self.sampling_hz
        return self.sampled(t, x, range_m, amplitude, moved)
