"""What estimators of uneven rotation share: how the data are sampled, the motion in the form in
which it enters phases, and its removal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import outer_phasor, phasor_tables, unit_phasor
from torchsar.core.warp import warp
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.warped_sums import slow_times

SEARCH_EPS = 1e-3  # of the transform: enough for estimates; images take less
LEAST_PULSES = 8


@dataclass(frozen=True)
class Sampling:
    """Where the samples of a recording lie.

    first_m, step_m: range of cell 0 and of one cell, from where the processor takes the centre to
    be.
    """

    wavelength_m: float
    prf_hz: float
    pulses: int
    cells: int
    first_m: float
    step_m: float

    @property
    def duration_s(self) -> float:
        return self.pulses / self.prf_hz

    @property
    def turns_per_square(self) -> float:
        """Turns of phase per metre of range and rad^2: half of 2 / wavelength."""
        return 1 / self.wavelength_m

    def times(self, device: torch.device) -> Tensor:
        return slow_times(self.pulses, self.prf_hz, device)

    def range_m(self, cell: Tensor) -> Tensor:
        return self.first_m + self.step_m * cell


@dataclass(frozen=True)
class Motion:
    """Rotation in the form in which phases are linear in it: the warp k (trial, order - 1), w =
    Om^2 and v (trial,), float64.

    The range term of a scatterer at y_n is (c4/2) (w (y_n + centre_m) + v) phi^2: centre_m (trial,)
    is the range centre deviation that is known, v what is found beyond it. Only w and v show in
    data; both may start at zero, and may come out negative where noise is all there is.
    """

    k: Tensor
    w: Tensor
    v: Tensor
    centre_m: Tensor

    @staticmethod
    def still(k: Tensor, centre_m: Tensor | None = None) -> Motion:
        """A warp, and no rate yet."""
        zero = k.new_zeros(k.shape[0])
        return Motion(k, zero, zero, zero if centre_m is None else centre_m)

    @property
    def omega_rad_s(self) -> Tensor:
        return self.w.clamp_min(torch.finfo(torch.float64).tiny).sqrt()

    @property
    def offset(self) -> Tensor:
        """w yc, what the centre adds to w y_n."""
        return self.w * self.centre_m + self.v

    @property
    def yc_m(self) -> Tensor:
        """The range centre deviation; the known one where the rate is not positive."""
        return self.centre_m + torch.where(self.w > 0, self.v / torch.where(self.w > 0, self.w, 1), 0)

    def possible(self, sampling: Sampling) -> Tensor:
        """Whether the numbers are finite and the range term changes by less than half a turn from
        pulse to pulse in every cell, as in data it must, (trial,).
        """
        ends = sampling.range_m(torch.tensor([0.0, sampling.cells - 1.0], dtype=torch.float64, device=self.w.device))
        whole = warp(torch.tensor([sampling.duration_s], dtype=torch.float64, device=self.w.device), self.k)
        turns = sampling.turns_per_square * (self.w[:, None] * ends + self.offset[:, None]).abs() * whole.square()
        return torch.isfinite(self.k).all(-1) & (turns < sampling.pulses / 4).all(-1)

    def where(self, keep: Tensor, other: Motion) -> Motion:
        """This motion in trials where `keep` (trial,) holds, the other elsewhere."""
        w, v = (torch.where(keep, getattr(self, name), getattr(other, name)) for name in ("w", "v"))
        return Motion(torch.where(keep[:, None], self.k, other.k), w, v, self.centre_m)


@dataclass(frozen=True)
class Warped:
    """The warp at some times (trial, m): phi (s), u = phi / phi(T), and du/dk_i (trial, order - 1,
    m).
    """

    phi: Tensor
    u: Tensor
    slopes: Tensor

    @staticmethod
    def of(k: Tensor, times_s: Tensor, duration_s: float) -> Warped:
        """times_s: (m,) or (trial, m)."""
        end = torch.tensor([duration_s], dtype=torch.float64, device=k.device)
        whole, phi = warp(end, k), warp(times_s, k)
        u = phi / whole
        rows = [
            (times_s ** (i + 2) - u * duration_s ** (i + 2)) / (math.factorial(i + 2) * whole)
            for i in range(k.shape[-1])
        ]
        slopes = torch.stack(rows, -2) if rows else u.new_zeros((*u.shape[:-1], 0, u.shape[-1]))
        return Warped(phi, u, slopes)


def without_range_term(data: Tensor, sampling: Sampling, motion: Motion, phi: Tensor) -> Tensor:
    """data (trial, pulse, range) times exp(-j (c4/2) (w y_n + offset) phi^2). phi: (trial,
    pulse).
    """
    square = -sampling.turns_per_square * phi.square()
    fine, coarse = phasor_tables(
        square * (motion.w[:, None] * sampling.step_m), sampling.first_m / sampling.step_m, sampling.cells, data.dtype
    )
    return data * outer_phasor(
        fine, coarse * unit_phasor(square * motion.offset[:, None], data.dtype)[..., None], sampling.cells
    )


def image_of(data: Tensor, sampling: Sampling, motion: Motion, oversampling: float = 2.0) -> Tensor:
    """Image (trial, line, range) of data (trial, pulse, range) with this motion taken out, lines of
    1 / oversampling Doppler cells about zero.
    """
    phi = warp(sampling.times(data.device), motion.k)
    return matched_fourier(
        without_range_term(data, sampling, motion, phi),
        motion.k,
        sampling.prf_hz,
        oversampling=oversampling,
        eps=SEARCH_EPS,
    )
