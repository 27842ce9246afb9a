"""Image formation from dechirped triangular sweeps of a ladar.

The steps are range compression, removal of the azimuth phase (deramp) and azimuth matched filter.

Reference:
    Remote Sens. 2024, 16, 793.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, check_value, checked_samples, refuse_non_finite, unit_phasor, untraced
from torchsar.radar import TriangularLadar

Ramp = Literal["up", "down"]
# time of the middle of each sweep, as a share of the period
_EPOCH = {"up": 0.25, "down": 0.75}


def video_filter(frequency_hz: Tensor, radar: TriangularLadar, ramp: Ramp = "up") -> Tensor:
    """Compute the filter that removes the residual video phase.

    For the up-sweep it is exp(+j pi f^2 / K) over beat frequency f, with the chirp rate K. For the
    down-sweep it is the conjugate. The sign is that for sweeps dechirped as local oscillator times
    conjugate echo.

    Args:
        frequency_hz: Beat frequencies f in Hz.
        radar: Radar with the chirp rate K.
        ramp: "up" or "down".

    Returns:
        Filter, same shape, complex128.

    Reference:
        Remote Sens. 2024, 16, 793, Eq. (5). Its printed sign holds for the conjugate signal, echo
        times conjugate local oscillator.
    """
    turns = frequency_hz.square() / (2 * radar.chirp_rate_hz_s)
    return unit_phasor(turns if ramp == "up" else -turns, torch.complex128)


def compress_sweeps(sweeps: Tensor, radar: TriangularLadar, ramp: Ramp = "up", video: bool = True) -> Tensor:
    """Compress the up-sweeps or the down-sweeps into range profiles.

    >>> import torch
    >>> from torchsar import focus, radar
    >>> ladar = radar.TriangularLadar(carrier_hz=193.4e12, bandwidth_hz=5e9, period_s=16e-6,
    ...     sample_rate_hz=4e6, speed_m_s=60.0, reference_range_m=3000.0)
    >>> beat = torch.exp(2j * torch.pi * 3 * torch.arange(32) / 32).expand(2, 8, 32)
    >>> focus.compress_sweeps(beat, ladar).abs().argmax(-1) - 32 // 2  # range in cells
    tensor([3, 3, 3, 3, 3, 3, 3, 3])

    A scatterer of amplitude a, RD metres beyond the reference range of the radar in the middle of
    the sweep, has a peak of modulus a and phase +4 pi RD / lambda. The phase has this sign whatever
    `radar.dechirp_sign` is: sweeps with the sign "echo_conj_lo" are conjugated first. Motion within
    a sweep must be compensated before the residual video phase is removed. Differentiable.

    Args:
        sweeps: Dechirped sweeps with N samples each, shape (..., 2, pulse, N), up before down,
            complex. The sign of their phase is `radar.dechirp_sign`.
        radar: Radar of the recording.
        ramp: "up" or "down".
        video: Whether to remove the residual video phase. For the up-sweep it is -pi K dtau^2, with
            the chirp rate K and the delay dtau of the scatterer relative to the reference range.

    Returns:
        Range profiles, shape (..., pulse, N). Relative range rises from -(N // 2) cells; it is zero
        at cell N // 2.

    Raises:
        TypeError: If the sweeps are not complex.
        ValueError: If there are no samples or a sample is not finite, or if the sweeps have another
            shape or are not finite, or `ramp` is not known.

    Reference:
        Remote Sens. 2024, 16, 793, Eq. (5), for the residual video phase.
    """
    sweeps = checked_samples(sweeps, "compress_sweeps", "ramp, pulse, fast time")
    n = radar.sweep_samples
    if not (isinstance(sweeps, Tensor) and sweeps.is_complex()):
        raise TypeError(
            f"compress_sweeps needs complex sweeps (..., 2, pulse, {n}), got "
            f"{getattr(sweeps, 'dtype', type(sweeps).__name__)}"
        )
    if sweeps.ndim < 3 or sweeps.shape[-3] != 2 or sweeps.shape[-2] < 1 or sweeps.shape[-1] != n:
        raise ValueError(
            f"compress_sweeps needs sweeps (..., 2, pulse, {n}), up before down, got shape {tuple(sweeps.shape)}"
        )
    refuse_non_finite(sweeps, "compress_sweeps")
    if ramp not in _EPOCH:
        raise ValueError(f"ramp must be 'up' or 'down', got {ramp!r}")
    data = sweeps[..., 0, :, :] if ramp == "up" else sweeps[..., 1, :, :].flip(-1)
    if radar.dechirp_sign == "echo_conj_lo":
        data = data.conj()
    line = torch.arange(n, dtype=torch.float64, device=sweeps.device) - n // 2
    factor = unit_phasor(line * (n - 1) / (2 * n), torch.complex128) / n
    if video:
        factor = factor * video_filter(line / radar.sweep_s, radar, ramp)
    return torch.fft.fftshift(torch.fft.fft(data), dim=-1) * factor.to(sweeps.dtype)


def profile_axes(pulse: Axis, radar: TriangularLadar, ramp: Ramp = "up") -> tuple[Axis, Axis]:
    """Return the axes of range profiles: slow time in seconds, relative range in metres.

    Slow time refers to the middle of the sweeps; relative range is zero at the reference range of
    the radar.

    Args:
        pulse: Pulse axis of the sweeps.
        radar: Radar of the recording.
        ramp: "up" or "down".

    Returns:
        Axes of slow time and of relative range.
    """
    n = radar.sweep_samples
    middle = Axis("pulse", pulse.n, pulse.start + _EPOCH[ramp] * radar.period_s, pulse.step, "s")
    return middle, Axis("range", n, -(n // 2) * radar.range_step_m, radar.range_step_m, "m")


def azimuth_turns(
    pulse: Axis, range_: Axis, radar: TriangularLadar, device: torch.device | str | None = None
) -> Tensor:
    """Compute the azimuth phase in turns of a scatterer at azimuth zero.

    It is 2 (sqrt(R^2 + (V t)^2) - R) / lambda with slow time t, speed V and R = reference range +
    relative range.

    Args:
        pulse: Slow time of the samples, zero at broadside.
        range_: Range relative to the reference range of the radar.
        radar: Radar of the recording.
        device: Device of the result.

    Returns:
        Phase in turns, shape (pulse, range), float64.

    Raises:
        ValueError: If a range R of the axis is zero or negative.
    """
    across = (radar.speed_m_s * pulse.values(device))[:, None].square()
    r = radar.reference_range_m + range_.values(device)
    check_value(r.min(), _refuse_behind)
    return 2 / radar.wavelength_m * across / (torch.sqrt(r.square() + across) + r)


def _refuse_behind(nearest_m: float) -> None:
    """Raise ValueError for a range axis that reaches the ladar."""
    if nearest_m <= 0:
        raise ValueError(
            "the range axis must lie at positive distances from the ladar, got "
            f"{nearest_m:.4g} m from the ladar; crop it to ranges in front of the ladar"
        )


def _check_profiles(data: Tensor, pulse: Axis, range_: Axis, what: str) -> None:
    """Raise TypeError or ValueError unless data are finite, complex and shaped as their axes."""
    if not (isinstance(data, Tensor) and data.is_complex()):
        raise TypeError(
            f"{what} needs complex profiles (..., pulse, range), got {getattr(data, 'dtype', type(data).__name__)}"
        )
    if data.ndim < 2 or tuple(data.shape[-2:]) != (pulse.n, range_.n):
        raise ValueError(
            f"{what} needs profiles (..., {pulse.n}, {range_.n}) that match their axes, got shape {tuple(data.shape)}"
        )
    refuse_non_finite(data, what)


def deramp_azimuth(data: Tensor, radar: TriangularLadar, pulse: Axis, range_: Axis) -> Tensor:
    """Remove the azimuth phase of a scatterer at azimuth zero from range profiles.

    >>> import torch
    >>> from torchsar import Axis, focus, radar
    >>> ladar = radar.TriangularLadar(carrier_hz=193.4e12, bandwidth_hz=5e9, period_s=16e-6,
    ...     sample_rate_hz=4e6, speed_m_s=60.0, reference_range_m=3000.0)
    >>> pulse, range_ = Axis("pulse", 3, -5e-4, 2.5e-4, "s"), Axis("range", 1, 0.0, 0.03, "m")
    >>> out = focus.deramp_azimuth(torch.ones(3, 1) + 0j, ladar, pulse, range_)
    >>> out[:, 0].real.round(decimals=2)  # unchanged at broadside
    tensor([0.3500, 0.9500, 1.0000])

    The echo of a scatterer at azimuth x and range R is then a tone of -2 V x / (lambda R) Hz over
    slow time, with the speed V. Estimators of one phase error per pulse need such deramped
    profiles. Differentiable.

    Args:
        data: Range profiles, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        pulse: Slow time of the samples (middles of the sweeps), zero at broadside.
        range_: Range relative to the reference range of the radar.

    Returns:
        Deramped profiles, same shape.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If there are no samples, or if the data are not finite or do not fit their axes,
            or the range axis reaches the radar or lies behind it.
    """
    data = checked_samples(data, "deramp_azimuth", "pulse, range", finite=False)
    _check_profiles(data, pulse, range_, "deramp_azimuth")
    return data * unit_phasor(-azimuth_turns(pulse, range_, radar, data.device), data.dtype)


def azimuth_matched_filter(
    data: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    range_: Axis,
    beam_rad: float | None = None,
    weighting: float = 0.0,
) -> Tensor:
    """Form the image of deramped profiles by the azimuth matched filter.

    >>> import torch
    >>> from torchsar import Axis, focus, radar
    >>> ladar = radar.TriangularLadar(carrier_hz=193.4e12, bandwidth_hz=5e9, period_s=16e-6,
    ...     sample_rate_hz=4e6, speed_m_s=60.0, reference_range_m=3000.0)
    >>> pulse, range_ = Axis("pulse", 9, -1e-3, 2.5e-4, "s"), Axis("range", 1, 0.0, 0.03, "m")
    >>> image = focus.azimuth_matched_filter(torch.ones(9, 1) + 0j, ladar, pulse, range_)
    >>> image[:, 0].abs().round(decimals=2)  # focused at azimuth 0
    tensor([0.1200, 0.1300, 0.1400, 0.1500, 1.0000, 0.1500, 0.1400, 0.1300, 0.1200])

    The image at azimuth x and range R is the weighted mean over the pulses of the aperture of
    s(t) exp(-4j pi (sqrt(R^2 + (V t - x)^2) - R) / lambda), where s(t) are the profiles with their
    azimuth phase restored, t is slow time and V the speed. The image is evaluated at the azimuths
    x = V t of the pulses, without wrap-around. A scatterer that is illuminated over its whole
    aperture keeps its amplitude. Differentiable.

    Args:
        data: Deramped profiles, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        pulse: Slow time of the samples, zero at broadside.
        range_: Range relative to the reference range of the radar.
        beam_rad: Angle in rad that sets the length of the aperture, beam_rad * R, centred on every
            azimuth x. None for `radar.beam_rad`; if that is None too, the whole record is used for
            every x.
        weighting: Coefficient a of the weights 1 - a + a cos(2 pi y / L) at the distance y from the
            middle of an aperture of length L. They lower the first side lobes (a = 0: -13.27 dB;
            0.03: -13.9 dB, main lobe 1 % wider; 0.46: Hamming weights).

    Returns:
        Image, shape (..., azimuth, range), complex.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If there are no samples, or if the data are not finite or do not fit their axes,
            the speed of the radar is 0, `beam_rad` is not positive, or `weighting` lies outside
            0..0.5.
    """
    data = checked_samples(data, "azimuth_matched_filter", "pulse, range", finite=False)
    _check_profiles(data, pulse, range_, "azimuth_matched_filter")
    if not 0 <= weighting <= 0.5:
        raise ValueError(f"weighting must lie in 0..0.5, got {weighting}")
    if not radar.speed_m_s > 0:
        raise ValueError(
            f"radar.speed_m_s must be positive for an azimuth image, got {radar.speed_m_s}; a target that does not "
            "move across the line of sight has no such image"
        )
    n = data.shape[-2]
    with untraced():
        half = _half_aperture(radar, pulse, range_, beam_rad, data.device)
        whole = int(half.max()) >= n
    turns = azimuth_turns(pulse, range_, radar, data.device)
    lag = torch.arange(-(n - 1), n, device=data.device)
    across = (radar.speed_m_s * pulse.step * lag.to(torch.float64))[:, None].square()
    r = radar.reference_range_m + range_.values(data.device)
    filter_ = unit_phasor(-2 / radar.wavelength_m * across / (torch.sqrt(r.square() + across) + r), data.dtype) * (
        lag[:, None].abs() <= half
    )
    length = 2 ** math.ceil(math.log2(2 * n - 1 + n - 1))
    lit = torch.minimum(2 * half + 1, torch.full_like(half, n))
    # the aperture is centred on the pixel; that of the whole record is fixed
    weights, fixed = (
        (1.0, _cosine((lag[n - 1 :, None] - (n - 1) / 2) / n, weighting))
        if whole
        else (_cosine(lag[:, None] / lit, weighting), 1.0)
    )
    data, filter_ = (
        x * w.to(x.real.dtype) if isinstance(w, Tensor) else x for x, w in ((data, fixed), (filter_, weights))
    )
    spectrum = torch.fft.fft(data * unit_phasor(turns, data.dtype), length, dim=-2) * torch.fft.fft(
        filter_, length, dim=-2
    )
    image = torch.fft.ifft(spectrum, dim=-2)[..., n - 1 : 2 * n - 1, :]
    return image / (lit * (1 - weighting)).to(data.real.dtype)


def _cosine(share: Tensor, weighting: float) -> Tensor:
    """Window 1 - a + a cos(2 pi y / L), given the positions y / L and the weighting a."""
    return 1 - weighting + weighting * torch.cos(2 * math.pi * share)


def _half_aperture(
    radar: TriangularLadar, pulse: Axis, range_: Axis, beam_rad: float | None, device: torch.device
) -> Tensor:
    """Number of pulses to either side of the middle of the aperture, (range,) int64."""
    beam = radar.beam_rad if beam_rad is None else beam_rad
    r = radar.reference_range_m + range_.values(device)
    if beam is None:
        return torch.full((range_.n,), pulse.n, dtype=torch.int64, device=device)
    if not beam > 0:
        raise ValueError(f"beam_rad must be a positive angle or None, got {beam}")
    return torch.floor(beam * r / (2 * radar.speed_m_s * pulse.step)).to(torch.int64).clamp_min(0)


class CompressSweeps(Stage):
    """Stage that compresses the sweeps of one ramp into range profiles, see `compress_sweeps`.

    Args:
        radar: Radar of the recording.
        ramp: "up" or "down".
        video: Whether to remove the residual video phase.
        window_m: Least and greatest range to keep in metres, relative to the reference range of the
            radar; None for all ranges.

    Raises:
        ValueError: If `ramp` is not known.
    """

    works_on = ("ramp", "pulse", "fast_time")

    def __init__(
        self,
        radar: TriangularLadar,
        ramp: Ramp = "up",
        video: bool = True,
        window_m: tuple[float, float] | list[float] | None = None,
    ) -> None:
        super().__init__()
        if ramp not in _EPOCH:
            raise ValueError(f"ramp must be 'up' or 'down', got {ramp!r}")
        self.radar, self.video, self.window_m = radar, video, window_m
        self.ramp: Ramp = ramp

    def forward(self, signal: Signal) -> Signal:
        """Compress a signal with axes (ramp, pulse, fast_time) into range profiles.

        Args:
            signal: Dechirped sweeps.

        Returns:
            Range profiles of one ramp with axes (pulse, range).

        Raises:
            ValueError: If `window_m` does not lie in the relative ranges of the profiles.
        """
        axes = profile_axes(signal.axis("pulse"), self.radar, self.ramp)
        out = Signal(compress_sweeps(signal.data, self.radar, self.ramp, self.video), axes)
        if self.window_m is None:
            return out
        if len(self.window_m) != 2 or not self.window_m[0] < self.window_m[1]:
            raise ValueError(
                "window_m must be two ranges (low, high) in metres relative to the reference range"
                f" with low < high, got {list(self.window_m)}"
            )
        low, high = (round(float(axes[1].index_of(edge))) for edge in self.window_m)
        if not 0 <= low < high < axes[1].n:
            raise ValueError(
                f"window_m must lie in the relative ranges {axes[1].start:.4g}..{axes[1].stop:.4g} m of the profiles "
                f"and hold more than one range cell, got {tuple(self.window_m)}"
            )
        return out.isel(range=slice(low, high + 1))


class DerampAzimuth(Stage):
    """Stage that removes the azimuth phase of a scatterer at azimuth zero, see `deramp_azimuth`.

    Args:
        radar: Radar of the recording.
    """

    def __init__(self, radar: TriangularLadar) -> None:
        super().__init__()
        self.radar = radar

    def forward(self, signal: Signal) -> Signal:
        """Remove the azimuth phase of a scatterer at azimuth zero from range profiles.

        Args:
            signal: Range profiles with axes (pulse, range).

        Returns:
            Deramped profiles on the same axes.
        """
        return signal.with_data(deramp_azimuth(signal.data, self.radar, *signal.axes))


class AzimuthMatchedFilter(Stage):
    """Stage that forms an image (azimuth, range) in metres from deramped profiles.

    Args:
        radar: Radar of the recording.
        beam_rad: Azimuth angle of the aperture, see `azimuth_matched_filter`.
        weighting: Coefficient of the aperture weights, see `azimuth_matched_filter`.
    """

    def __init__(self, radar: TriangularLadar, beam_rad: float | None = None, weighting: float = 0.0) -> None:
        super().__init__()
        self.radar, self.beam_rad, self.weighting = radar, beam_rad, weighting

    def forward(self, signal: Signal) -> Signal:
        """Form the image of deramped profiles by the azimuth matched filter.

        Args:
            signal: Deramped profiles with axes (pulse, range).

        Returns:
            Image with axes (azimuth, range) in metres.
        """
        pulse, range_ = signal.axes
        image = azimuth_matched_filter(signal.data, self.radar, pulse, range_, self.beam_rad, self.weighting)
        v = self.radar.speed_m_s
        return Signal(image, (Axis("azimuth", pulse.n, v * pulse.start, v * pulse.step, "m"), range_))
