"""Backprojection of spotlight and turntable recordings, the exact reference for polar format."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, checked_samples, real_dtype
from torchsar.focus.backprojection import direct_sum
from torchsar.radar.spotlight import FarField, Spotlight, frequency_samples, geometry_of


def window_weights(name: str, n: int, device: torch.device | str | None = None) -> Tensor:
    """Compute the weights of a window over the pulses of an aperture or the frequencies of a band.

    Args:
        name: "none" for ones, "hann" for a raised cosine whose zeros lie just outside.
        n: Number of samples.
        device: Device of the result.

    Returns:
        Weights, shape (n,), float64.

    Raises:
        ValueError: If the window is not known.
    """
    if name not in ("none", "hann"):
        raise ValueError(f"window {name!r} is not known; choose 'none' or 'hann'")
    if name == "none":
        return torch.ones(n, dtype=torch.float64, device=device)
    return torch.hann_window(n + 2, periodic=False, dtype=torch.float64, device=device)[1:-1]


def aperture_weights(window: str, geometry: FarField | Spotlight) -> Tensor:
    """Compute the weight of each sample: the product of windows over pulses and over frequencies.

    Args:
        window: "none" or "hann", used in both directions.
        geometry: Geometry of the recording.

    Returns:
        Weights, shape (pulse, frequency), float64.

    Raises:
        ValueError: If the window is not known.
    """
    f = geometry.frequency_hz
    return window_weights(window, geometry.pulses, f.device)[:, None] * window_weights(window, f.shape[0], f.device)


def refuse_other_size(profiles: Tensor, geometry: FarField | Spotlight) -> None:
    """Raise an error unless range profiles are complex and have the size of the geometry.

    Args:
        profiles: Range profiles, shape (..., pulse, range).
        geometry: Geometry of the recording.

    Raises:
        TypeError: If the profiles are not complex.
        ValueError: If their size is not that of the geometry.
    """
    real_dtype(profiles.dtype)
    expected = (geometry.pulses, geometry.frequency_hz.shape[0])
    if tuple(profiles.shape[-2:]) != expected:
        raise ValueError(
            f"profiles of shape {tuple(profiles.shape)} do not end in the (pulse, frequency) = "
            f"{expected} sizes of the geometry; crop profiles and geometry to the same samples"
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
    """Form the image of ground points by exact backprojection of spotlight or turntable data.

    >>> import torch
    >>> from torchsar import focus, radar
    >>> geometry = radar.FarField.turntable(
    ...     1e10 + 2e7 * torch.arange(32).double(), 0.01 * torch.arange(16).double())
    >>> profiles = radar.range_profiles(torch.ones(16, 32) + 0j)
    >>> x_m, y_m = torch.tensor([0.0, 3.0]).double(), torch.zeros(2).double()
    >>> focus.backproject_spotlight(profiles, geometry, x_m, y_m).abs().round()  # on it, off
    tensor([512.,   3.])

        image = sum_k sum_f s_k(f) exp(+4j pi f r_k / c),

    where s_k(f) is the sample of pulse k at frequency f and r_k the range of the pixel in pulse k.
    A point scatterer of unit amplitude has the sum of the window weights as peak (without a window
    the number of samples) and keeps its phase. Range profiles are periodic: a scatterer c / (2
    frequency step) farther appears at the same position. See `direct_sum`, which forms the image.
    Differentiable in profiles, pixel and antenna positions.

    Args:
        profiles: Range profiles, shape (..., pulse, range), complex, as from `read_inverse`; s_k(f)
            are the frequency samples computed from them.
        geometry: `Spotlight` for exact ranges, `FarField` for plane waves.
        x_m: First ground coordinate of the pixels in metres, float64.
        y_m: Second ground coordinate of the pixels in metres, float64; broadcasts against `x_m`.
        window: "none" or "hann", over pulses and over frequencies.
        eps: Relative error of the interpolation in range.
        block_bytes: Size of a working array in bytes.

    Returns:
        Image, shape (..., *pixels), complex, where `pixels` is the broadcast shape of the
        coordinates.

    Raises:
        TypeError: If the profiles are not complex.
        ValueError: If there are no samples, or if the size of the profiles is not that of the
            geometry, there is no pixel, or the window is not known.
    """
    profiles = checked_samples(profiles, "backproject_spotlight", "pulse, range", finite=False)
    refuse_other_size(profiles, geometry)
    x, y = torch.broadcast_tensors(
        *(torch.as_tensor(v, dtype=torch.float64, device=profiles.device) for v in (x_m, y_m))
    )
    shape, x, y = x.shape, x.reshape(-1), y.reshape(-1)
    if not x.numel():
        raise ValueError(f"backprojection needs at least one pixel, got x_m and y_m of the common shape {tuple(shape)}")
    samples = frequency_samples(profiles) * aperture_weights(window, geometry).to(real_dtype(profiles.dtype))
    image = direct_sum(
        samples,
        geometry.frequency_hz,
        lambda pulses, pixels: (2 * geometry.range_m(pulses, x[pixels], y[pixels]), None),
        x.numel(),
        eps=eps,
        wave_speed_m_s=geometry.wave_speed_m_s,
        block_bytes=block_bytes,
    )
    return image.unflatten(-1, shape) if shape else image[..., 0]


@dataclass(frozen=True)
class GroundGrid:
    """A square grid on the ground plane.

    Args:
        extent_m: Side of the square in metres.
        step_m: Sample spacing in metres.
        centre_m: Position of the centre in metres along (range axis, azimuth axis) of the image.
        range_axis_rad: Direction of the range axis of the image in rad, from ground coordinate x
            towards y; the azimuth axis is a quarter turn further. At 0 the range axis is x and the
            azimuth axis y.

    Raises:
        ValueError: If a number is not finite, or 0 < step_m <= extent_m does not hold.
    """

    extent_m: float
    step_m: float
    centre_m: tuple[float, float] = (0.0, 0.0)
    range_axis_rad: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.extent_m, self.step_m, *self.centre_m, self.range_axis_rad)
        if not (all(map(math.isfinite, numbers)) and len(self.centre_m) == 2 and 0 < self.step_m <= self.extent_m):
            raise ValueError(
                "a ground grid needs 0 < step_m <= extent_m, a centre of two coordinates and finite numbers, "
                f"got {self}"
            )

    def axes(self) -> tuple[Axis, Axis]:
        """Return the axes ("azimuth", "range") in metres; of n samples the centre is n // 2."""
        n = round(self.extent_m / self.step_m) + 1
        start_range, start_azimuth = (c - (n // 2) * self.step_m for c in self.centre_m)
        return Axis("azimuth", n, start_azimuth, self.step_m, "m"), Axis("range", n, start_range, self.step_m, "m")


class GroundImager(Stage):
    """Base class of the stages that form an image of the ground plane from range profiles.

    The image has the axes ("azimuth", "range"). One geometry is used for all trials. Where the
    geometry is not known in advance, a chain connects the side data of the recording:

        use(PolarFormat(100.0, 0.25), frequency_hz="aux.frequency_hz",
            position_m="aux.position_m", reference_m="aux.reference_m")

    For a turntable, connect `frequency_hz` and `angle_rad` instead.

    Args:
        extent_m: Side of the image in metres, see `GroundGrid`.
        step_m: Sample spacing in metres.
        centre_m: Position of the centre in metres along (range axis, azimuth axis).
        range_axis_rad: Direction of the range axis in rad, from ground coordinate x towards y.
        height_m: Height z of the imaged plane in metres.
        window: "none" or "hann", over pulses and over frequencies.
        eps: Relative error of the interpolation.
        geometry: Geometry of the recording, if known in advance.

    Raises:
        ValueError: If the window is not known or the grid is not valid.
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
        """Form the image of range profiles on given axes; subclasses implement this method.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            geometry: Geometry in ground coordinates with x along the range axis of the image.
            azimuth: Azimuth axis of the image.
            range_: Range axis of the image.

        Returns:
            Image, shape (..., azimuth, range).
        """
        raise NotImplementedError

    def forward(
        self,
        signal: Signal,
        frequency_hz: Tensor | None = None,
        angle_rad: Tensor | None = None,
        position_m: Tensor | None = None,
        reference_m: Tensor | None = None,
    ) -> Signal:
        """Form the image of a signal with axes (pulse, range).

        Args:
            signal: Range profiles.
            frequency_hz: Frequencies in Hz, shape (range,); None for the geometry of the stage.
            angle_rad: Angle of each pulse of a turntable in rad, shape (pulse,).
            position_m: Antenna position of each pulse in metres, shape (pulse, 3).
            reference_m: Reference range of each pulse in metres, shape (pulse,).

        Returns:
            Image with axes (azimuth, range) in metres.
        """
        geometry = self.geometry
        if geometry is None or frequency_hz is not None:
            geometry = geometry_of(frequency_hz, angle_rad, position_m, reference_m, self.height_m)
        azimuth, range_ = self.grid.axes()
        geometry = geometry.turned(self.grid.range_axis_rad).to(signal.data.device)
        return Signal(self.form(signal.data, geometry, azimuth, range_), (azimuth, range_))


class SpotlightBackprojection(GroundImager):
    """Stage that images the ground plane by backprojection with exact ranges.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> geometry = radar.FarField.turntable(
    ...     1e10 + 2e7 * torch.arange(32).double(), 0.01 * torch.arange(16).double())
    >>> signal = Signal(radar.range_profiles(torch.ones(16, 32) + 0j),
    ...     radar.InverseRadar(1.032e10, 6.4e8, 100.0).raw_axes(16, 32))
    >>> image = focus.SpotlightBackprojection(extent_m=8.0, step_m=0.5, geometry=geometry)(signal)
    >>> divmod(int(image.data.abs().argmax()), 17)  # line and sample of the peak
    (8, 8)

    The exact reference for `PolarFormat`; arguments as in `GroundImager`.
    """

    def form(self, profiles: Tensor, geometry: FarField | Spotlight, azimuth: Axis, range_: Axis) -> Tensor:
        """Form the image of range profiles by exact backprojection.

        Args:
            profiles: Range profiles, shape (..., pulse, range), complex.
            geometry: Geometry in ground coordinates with x along the range axis of the image.
            azimuth: Azimuth axis of the image.
            range_: Range axis of the image.

        Returns:
            Image, shape (..., azimuth, range).
        """
        y, x = azimuth.values(profiles.device), range_.values(profiles.device)
        return backproject_spotlight(profiles, geometry, x, y[:, None], window=self.window, eps=self.eps)
