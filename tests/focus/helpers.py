"""Scenes with known answers for the focusers."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Signal
from torchsar.echo import simulate
from torchsar.focus.reference import flat_reference
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, StripmapWorld


@dataclass(frozen=True)
class PointCase:
    """Targets on one image line at several ranges, with their image positions and the focusing
    arguments.
    """

    radar: StripmapRadar
    raw: Tensor
    line: int
    cells: tuple[float, ...]
    arguments: dict

    def phase_rad(self, cell: float) -> float:
        """Phase that a focused target must have, -4 pi R / lambda."""
        range_m = self.radar.near_range_m + cell * self.radar.range_step_m
        return -4 * math.pi * math.fmod(range_m, self.radar.wavelength_m / 2) / self.radar.wavelength_m

    def signal(self, dtype: torch.dtype) -> Signal:
        return Signal(self.raw.to(dtype), self.radar.raw_axes(*self.raw.shape))


def point_case(
    radar: StripmapRadar, n_pulse: int, n_range: int, dwell_s: float, doppler_hz: float, offsets_m: tuple[float, ...]
) -> PointCase:
    """Echo of unit targets on the middle line, complex128, each offset from the middle of the
    swath.
    """
    world = StripmapWorld(Points([0.0] * len(offsets_m), list(offsets_m)), Dwell(dwell_s), doppler_hz=doppler_hz)
    recording, _ = simulate(radar, world, n_pulse, n_range, Draws(0), dtype=torch.complex128)
    middle = (n_range - radar.pulse_samples) / 2
    arguments = {"doppler_hz": doppler_hz, "reference": flat_reference(radar.pulse, n_range, radar.sampling_hz)}
    raw = recording.signal.data.reshape(n_pulse, n_range)
    return PointCase(radar, raw, n_pulse // 2, tuple(middle + o / radar.range_step_m for o in offsets_m), arguments)


def kondor_case(squint_deg: float = 0.0) -> PointCase:
    """S band from orbit, 0.75 m, targets 330 m to either side of the swath's middle."""
    radar = StripmapRadar(3.2e9, LinearFM(200e6, 1e-6), 250e6, 4000.0, 7000.0, 700e3)
    doppler = 2 * radar.velocity_m_s * math.sin(math.radians(squint_deg)) / radar.wavelength_m
    return point_case(radar, 3072, 1536, 0.6, doppler, (-330.0, 0.0, 330.0))


def radarsat_case() -> PointCase:
    """C band from orbit, squint 1.6 degrees, down-chirp, targets 1.6 km to either side."""
    radar = StripmapRadar(5.3e9, LinearFM(30.116e6, 10e-6, -1), 32.317e6, 1256.98, 7066.0, 988647.0)
    return point_case(radar, 1536, 1280, 0.7, -7050.0, (-1600.0, 0.0, 1600.0))


def airborne_case(doppler_hz: float = 0.0) -> PointCase:
    """S band at 7 km, where the migration differs by a cell over the swath: bulk + refocus is not
    enough.
    """
    radar = StripmapRadar(3.2e9, LinearFM(200e6, 1e-6), 250e6, 400.0, 150.0, 7e3)
    return point_case(radar, 2048, 1536, 3.0, doppler_hz, (-330.0, 0.0, 330.0))


@functools.lru_cache(maxsize=1)
def spectrum_of(image: Tensor) -> Tensor:
    """Spectrum of a whole image, kept for the next look at the same one."""
    return torch.fft.fftshift(torch.fft.fft2(image))


def at_position(image: Tensor, line: Tensor, cell: Tensor) -> Tensor:
    """Band-limited interpolation of a whole image (line, cell) on the grid of fractional lines x
    cells.
    """
    spectrum = spectrum_of(image)
    rows, columns = (torch.arange(n, dtype=torch.float64) - n // 2 for n in image.shape)
    left = torch.exp(2j * math.pi * line[:, None] * rows / image.shape[0])
    right = torch.exp(2j * math.pi * cell[:, None] * columns / image.shape[1])
    return left @ spectrum @ right.T / image.numel()


def peak_offset(image: Tensor, line: float, cell: float, reach: float = 1.0, steps: int = 41) -> tuple[float, float]:
    """Distance from (line, cell) to the interpolated maximum, in samples."""
    offset = torch.linspace(-reach, reach, steps, dtype=torch.float64)
    fine = at_position(image, line + offset, cell + offset).abs()
    i, j = divmod(int(fine.argmax()), steps)
    step = float(offset[1] - offset[0])

    def refined(curve: Tensor, k: int) -> float:
        k = min(max(k, 1), steps - 2)
        a, b, c = (float(curve[k + m]) for m in (-1, 0, 1))
        return float(offset[k]) + step * 0.5 * (a - c) / (a - 2 * b + c)

    return refined(fine[:, j], i), refined(fine[i], j)


def phase_error_deg(image: Tensor, case: PointCase, cell: float) -> float:
    """Phase of the image at the true position of a target relative to -4 pi R / lambda, in
    degrees.
    """
    position = (torch.tensor([float(v)], dtype=torch.float64) for v in (case.line, cell))
    value = at_position(image, *position)[0, 0]
    return math.degrees(math.remainder(float(torch.angle(value)) - case.phase_rad(cell), 2 * math.pi))
