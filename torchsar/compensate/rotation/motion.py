"""Common parts of the estimators of non-uniform rotation: sampling, motion, and its removal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import outer_phasor, phasor_tables, unit_phasor
from torchsar.core.warp import warp
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.transforms import Gridding
from torchsar.focus.warped_sums import slow_times

SEARCH_EPS = 1e-3  # accuracy of the transform in estimates; images use a better one
LEAST_PULSES = 8  # least number of pulses, a convention


@dataclass(frozen=True)
class Sampling:
    """Sampling of a recording.

    Args:
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        pulses: Number of pulses.
        cells: Number of range cells.
        first_m: Range of cell 0 in metres, from the assumed rotation centre.
        step_m: Range spacing of the cells in metres.
    """

    wavelength_m: float
    prf_hz: float
    pulses: int
    cells: int
    first_m: float
    step_m: float

    @property
    def duration_s(self) -> float:
        """Duration of the aperture in seconds."""
        return self.pulses / self.prf_hz

    @property
    def turns_per_square(self) -> float:
        """Phase in turns per metre of range and rad^2: half of 2 / wavelength."""
        return 1 / self.wavelength_m

    def times(self, device: torch.device) -> Tensor:
        """Compute the slow times of the pulses in seconds, shape (pulse,).

        Args:
            device: Device of the result.

        Returns:
            The times, from 0 at the first pulse.
        """
        return slow_times(self.pulses, self.prf_hz, device)

    def range_m(self, cell: Tensor) -> Tensor:
        """Convert range cells to range in metres.

        Args:
            cell: Range cells, any shape.

        Returns:
            The range, same shape.
        """
        return self.first_m + self.step_m * cell


@dataclass(frozen=True)
class Motion:
    """Rotation in the form in which phases are linear in it.

    The range term of a scatterer at y_n is (c4/2) (w (y_n + centre_m) + v) phi^2, with c4 = 4 pi /
    lambda. Only w and v show in the data. Both may start at zero, and may become negative where the
    data are noise.

    Args:
        k: Warp, shape (trial, order - 1), float64.
        w: Square of the rotation rate in rad^2/s^2, shape (trial,), float64.
        v: w times the range centre deviation found beyond `centre_m`, shape (trial,), float64.
        centre_m: Range centre deviation known a priori in metres, shape (trial,), float64.
    """

    k: Tensor
    w: Tensor
    v: Tensor
    centre_m: Tensor

    @staticmethod
    def still(k: Tensor, centre_m: Tensor | None = None) -> Motion:
        """Make a motion with a warp and rate zero.

        Args:
            k: Warp, shape (trial, order - 1).
            centre_m: Range centre deviation known a priori in metres, shape (trial,); by default 0.

        Returns:
            The motion.
        """
        zero = k.new_zeros(k.shape[0])
        return Motion(k, zero, zero, zero if centre_m is None else centre_m)

    @property
    def omega_rad_s(self) -> Tensor:
        """Rotation rate at the first pulse in rad/s, shape (trial,); nearly 0 where w < 0."""
        return self.w.clamp_min(torch.finfo(torch.float64).tiny).sqrt()

    @property
    def offset(self) -> Tensor:
        """The product w yc, which the centre adds to w y_n, shape (trial,)."""
        return self.w * self.centre_m + self.v

    @property
    def yc_m(self) -> Tensor:
        """Range centre deviation in metres, shape (trial,); `centre_m` where w <= 0."""
        return self.centre_m + torch.where(self.w > 0, self.v / torch.where(self.w > 0, self.w, 1), 0)

    def possible(self, sampling: Sampling) -> Tensor:
        """Check whether a motion can occur in the data.

        Its numbers must be finite, and the range term must change by less than half a turn from
        pulse to pulse in every cell.

        Args:
            sampling: Sampling of the data.

        Returns:
            True where the motion is possible, shape (trial,), bool.
        """
        ends = sampling.range_m(torch.tensor([0.0, sampling.cells - 1.0], dtype=torch.float64, device=self.w.device))
        whole = warp(torch.tensor([sampling.duration_s], dtype=torch.float64, device=self.w.device), self.k)
        turns = sampling.turns_per_square * (self.w[:, None] * ends + self.offset[:, None]).abs() * whole.square()
        return torch.isfinite(self.k).all(-1) & (turns < sampling.pulses / 4).all(-1)

    def where(self, keep: Tensor, other: Motion) -> Motion:
        """Combine two motions by trial.

        Args:
            keep: True where this motion is kept, shape (trial,), bool.
            other: The motion of the other trials.

        Returns:
            The motion.
        """
        w, v = (torch.where(keep, getattr(self, name), getattr(other, name)) for name in ("w", "v"))
        return Motion(torch.where(keep[:, None], self.k, other.k), w, v, self.centre_m)


@dataclass(frozen=True)
class Warped:
    """The warp of slow time at some times.

    Args:
        phi: Warp in seconds, shape (trial, m).
        u: Normalised warp phi / phi(T), shape (trial, m).
        slopes: Derivatives du/dk_i, shape (trial, order - 1, m).
    """

    phi: Tensor
    u: Tensor
    slopes: Tensor

    @staticmethod
    def of(k: Tensor, times_s: Tensor, duration_s: float) -> Warped:
        """Evaluate a warp.

        Args:
            k: Warp, shape (trial, order - 1).
            times_s: Times in seconds, shape (m,) or (trial, m).
            duration_s: Duration T of the aperture in seconds.

        Returns:
            The warp at these times.
        """
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
    """Multiply data by exp(-j (c4/2) (w y_n + offset) phi^2).

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Motion.
        phi: Warp in seconds, shape (trial, pulse).

    Returns:
        The data without the range term, shape (trial, pulse, range), complex.
    """
    square = -sampling.turns_per_square * phi.square()
    fine, coarse = phasor_tables(
        square * (motion.w[:, None] * sampling.step_m), sampling.first_m / sampling.step_m, sampling.cells, data.dtype
    )
    return data * outer_phasor(
        fine, coarse * unit_phasor(square * motion.offset[:, None], data.dtype)[..., None], sampling.cells
    )


def image_of(data: Tensor, sampling: Sampling, motion: Motion, oversampling: float = 2.0) -> Tensor:
    """Form the image of data with a motion compensated.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Motion.
        oversampling: Image lines per Doppler cell.

    Returns:
        The image, shape (trial, line, range), with zero Doppler in the middle.
    """
    phi = warp(sampling.times(data.device), motion.k)
    return matched_fourier(
        without_range_term(data, sampling, motion, phi),
        motion.k,
        sampling.prf_hz,
        lines=DopplerLines(oversampling),
        transform=Gridding(eps=SEARCH_EPS),
    )
