"""Backprojection of spotlight and turntable recordings: exact at every point, the yardstick of
polar format.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, real_dtype, unit_phasor
from torchsar.focus.nufft import Nufft, Points, interpolate
from torchsar.radar.spotlight import FarField, Spotlight, frequency_samples, frequency_step_hz, geometry_of


def window_weights(name: str, n: int, device: torch.device | str | None = None) -> Tensor:
    """Weights over an aperture or a band, float64 (n,): "none" is all ones, "hann" a raised cosine
    whose zeros lie just outside, so that all count.
    """
    if name not in ("none", "hann"):
        raise ValueError(f"window {name!r} is not known; choose 'none' or 'hann'")
    if name == "none":
        return torch.ones(n, dtype=torch.float64, device=device)
    return torch.hann_window(n + 2, periodic=False, dtype=torch.float64, device=device)[1:-1]


def aperture_weights(window: str, geometry: FarField | Spotlight) -> Tensor:
    """The window over pulses times the window over frequencies, float64 (pulse, range)."""
    f = geometry.frequency_hz
    return window_weights(window, geometry.pulses, f.device)[:, None] * window_weights(window, f.shape[0], f.device)


def refuse_other_size(profiles: Tensor, geometry: FarField | Spotlight) -> None:
    """Raise where profiles (..., pulse, range) are not complex or of another size than the geometry
    describes.
    """
    real_dtype(profiles.dtype)
    expected = (geometry.pulses, geometry.frequency_hz.shape[0])
    if tuple(profiles.shape[-2:]) != expected:
        raise ValueError(
            f"profiles of shape {tuple(profiles.shape)} do not end in the (pulse, frequency) = "
            f"{expected} of the geometry; crop both alike"
        )


def backproject_spotlight(
    profiles: Tensor,
    geometry: FarField | Spotlight,
    x_m: Tensor,
    y_m: Tensor,
    *,
    window: str = "none",
    eps: float = 1e-10,
    block_bytes: int = 1 << 23,
) -> Tensor:
    """Sum over pulses and frequencies of s_k(f) exp(+4j pi f r_k / c), r_k the range of the pixel
    in pulse k. Complex (..., *pixels).

    profiles: (..., pulse, range) as `read_inverse` gives them, whose frequency samples are s.
    geometry: `Spotlight` for exact ranges, `FarField` for plane waves. x_m, y_m: float64 ground
    coordinates that broadcast to `pixels`. A point of unit amplitude gives the sum of the window
    weights (their number without a window) with its own phase. Between range samples the profile
    comes from a non-uniform FFT of relative error eps. Profiles are periodic in range: what lies c
    / (2 frequency step) farther appears in the same place. Costs pulses x pixels x 40 operations.
    Differentiable in profiles, pixel and antenna positions; blocks of pulses take about block_bytes
    an array.
    """
    refuse_other_size(profiles, geometry)
    x, y = torch.broadcast_tensors(
        *(torch.as_tensor(v, dtype=torch.float64, device=profiles.device) for v in (x_m, y_m))
    )
    shape, x, y = x.shape, x.reshape(-1), y.reshape(-1)
    if not x.numel():
        raise ValueError(f"backprojection needs at least one pixel, got coordinates of shape {tuple(shape)}")
    samples = frequency_samples(profiles) * aperture_weights(window, geometry).to(real_dtype(profiles.dtype))
    between = _BetweenSamples(geometry, eps, samples)
    trials = max(1, math.prod(samples.shape[:-2]))
    # each of the about 20 working arrays of a block takes up to 16 bytes a pulse and pixel
    pixels_at_once = min(x.numel(), 4096)
    height = max(1, min(samples.shape[-2], block_bytes // (16 * trials * max(pixels_at_once, 2 * samples.shape[-1]))))
    sums = [
        samples.new_zeros((*samples.shape[:-2], pixels.stop - pixels.start))
        for pixels in _slices(x.numel(), pixels_at_once)
    ]
    for pulses in _slices(samples.shape[-2], height):
        grid = between.grid(samples[..., pulses, :])
        for i, pixels in enumerate(_slices(x.numel(), pixels_at_once)):
            sums[i] = sums[i] + between.at(grid, geometry.range_m(pulses, x[pixels], y[pixels])).sum(-2)
    return torch.cat(sums, -1).reshape((*samples.shape[:-2], *shape))


def _slices(n: int, step: int) -> Iterator[slice]:
    yield from (slice(first, min(first + step, n)) for first in range(0, n, step))


class _BetweenSamples:
    """Profiles at any range, carrier restored, from their frequency samples."""

    def __init__(self, geometry: FarField | Spotlight, eps: float, like: Tensor) -> None:
        f, per_metre = geometry.frequency_hz, 2 / geometry.wave_speed_m_s
        self.plan = Nufft(f.shape[0], eps, like.dtype, like.device)
        self.step_cycles_m = per_metre * frequency_step_hz(f)
        self.carrier_cycles_m = per_metre * float(f[f.shape[0] // 2])

    def grid(self, samples: Tensor) -> Tensor:
        return self.plan.grid(samples)

    def at(self, grid: Tensor, range_m: Tensor) -> Tensor:
        """sum_f s(f) exp(+4j pi f r / c).

        grid: (..., pulse, length), range_m: float64 (pulse, pixel). Returns (..., pulse, pixel).
        """
        # exp(+2j pi k q) asks for points of the other sign
        points = Points.of(
            self.plan.kernel,
            -range_m * (self.step_cycles_m * self.plan.length),
            self.plan.length,
            real_dtype(grid.dtype),
        )
        return interpolate(grid, points) * unit_phasor(self.carrier_cycles_m * range_m, grid.dtype)


@dataclass(frozen=True)
class GroundGrid:
    """A square of the ground plane: extent_m wide, sampled every step_m, about centre_m = (x, y).

    range_axis_rad: direction of the image's range axis, from x towards y; the azimuth axis lies a
    quarter turn further. At 0 the range axis is x and the azimuth axis y. Centre and axes are in
    the turned coordinates.
    """

    extent_m: float
    step_m: float
    centre_m: tuple[float, float] = (0.0, 0.0)
    range_axis_rad: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.extent_m, self.step_m, *self.centre_m, self.range_axis_rad)
        if not (all(map(math.isfinite, numbers)) and len(self.centre_m) == 2 and 0 < self.step_m <= self.extent_m):
            raise ValueError(
                f"a ground grid needs 0 < step_m <= extent_m, a centre (x, y) and a finite direction, got {self}"
            )

    def axes(self) -> tuple[Axis, Axis]:
        """("azimuth", "range") axes in metres; the centre is sample n // 2."""
        n = round(self.extent_m / self.step_m) + 1
        start_range, start_azimuth = (c - (n // 2) * self.step_m for c in self.centre_m)
        return Axis("azimuth", n, start_azimuth, self.step_m, "m"), Axis("range", n, start_range, self.step_m, "m")


class GroundImager(Stage):
    """Base of the stages that turn range profiles into an image of the ground plane, with the axes
    ("azimuth", "range").

    extent_m, step_m, centre_m, range_axis_rad: see `GroundGrid`. height_m: z of the imaged plane.
    window: "none" or "hann", over pulses and over frequencies. eps: relative error of the
    interpolation. geometry: where it is known beforehand; otherwise connect recorded side data:
    `use(PolarFormat(100.0, 0.25), frequency_hz="aux.frequency_hz", position_m="aux.position_m",
    reference_m="aux.reference_m")`, or frequency_hz and angle_rad for a turntable. One geometry
    serves all trials.
    """

    def __init__(
        self,
        extent_m: float,
        step_m: float,
        centre_m: tuple[float, float] = (0.0, 0.0),
        range_axis_rad: float = 0.0,
        height_m: float = 0.0,
        window: str = "hann",
        eps: float = 1e-3,
        geometry: FarField | Spotlight | None = None,
    ) -> None:
        super().__init__()
        window_weights(window, 1)
        self.grid = GroundGrid(
            float(extent_m), float(step_m), (float(centre_m[0]), float(centre_m[1])), float(range_axis_rad)
        )
        self.height_m, self.window, self.eps, self.geometry = height_m, window, eps, geometry

    def form(self, profiles: Tensor, geometry: FarField | Spotlight, azimuth: Axis, range_: Axis) -> Tensor:
        """The image (..., azimuth, range); geometry is in the turned coordinates of the axes."""
        raise NotImplementedError

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor | None = None,
        angle_rad: Tensor | None = None,
        position_m: Tensor | None = None,
        reference_m: Tensor | None = None,
    ) -> Signal:
        geometry = self.geometry
        if geometry is None or frequency_hz is not None:
            geometry = geometry_of(frequency_hz, angle_rad, position_m, reference_m, self.height_m)
        azimuth, range_ = self.grid.axes()
        geometry = geometry.turned(self.grid.range_axis_rad).to(signal.data.device)
        return Signal(self.form(signal.data, geometry, azimuth, range_), (azimuth, range_))


class SpotlightBackprojection(GroundImager):
    """Image the ground plane by backprojection with exact ranges.

    Arguments as `GroundImager`; the exact reference for `PolarFormat`.
    """

    def form(self, profiles: Tensor, geometry: FarField | Spotlight, azimuth: Axis, range_: Axis) -> Tensor:
        y, x = azimuth.values(profiles.device), range_.values(profiles.device)
        return backproject_spotlight(profiles, geometry, x, y[:, None], window=self.window, eps=self.eps)
