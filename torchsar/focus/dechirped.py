"""Range compression of dechirped pulses and azimuth transform of a rotating target.

A dechirped echo is exp(-2j pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2)), with the carrier f0,
the chirp rate gamma, the delay dtau relative to the reference range and the time t' from the middle
of the pulse. Azimuth transforms over the pulses use exp(+j), so that a positive cross range x lies
at positive coordinates of the image axis.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, centred_ifft, checked_samples, fft_lines, real_dtype, unit_phasor
from torchsar.radar import InverseRadar

# windows over the pulses that `AzimuthTransform` accepts
WINDOWS = ("none", "hann")


def compress_dechirped(
    raw: Tensor, radar: InverseRadar, velocity_m_s: Tensor | float | None = None, residual_video: bool = True
) -> Tensor:
    """Compress dechirped pulses in range.

    >>> import torch
    >>> from torchsar import focus, radar
    >>> ladar = radar.InverseRadar(193.4e12, bandwidth_hz=150e9, prf_hz=2000.0, pulse_s=1e-4)
    >>> beat = torch.exp(-2j * torch.pi * 3 * torch.arange(32) / 32)[None]
    >>> int(focus.compress_dechirped(beat, ladar).abs().argmax()) - 32 // 2  # range in cells
    3

    Of n samples, fast-time sample i lies (i - n // 2) pulse_s / n from the middle of the pulse, and
    range sample i at (i - n // 2) range_step_m from the reference range. Where a velocity v is
    given, the phase 2 pi (2 v / c) (f0 t' + gamma t'^2) that it causes within the pulse is removed
    first, with the time t' from the middle of the pulse, the carrier f0 and the chirp rate gamma.
    This corrects the range shift v f0 / gamma, also where it wraps around, and the blur by range
    walk. Differentiable in samples and velocity.

    Args:
        raw: Dechirped pulses, shape (..., pulse, fast_time), complex.
        radar: Radar of the recording, with its pulse length.
        velocity_m_s: Range rate dR/dt within pulses in m/s, receding positive, a number or shape
            (...,); None for no correction.
        residual_video: Remove the residual video phase pi gamma (2 r / c)^2 at each range r
            relative to the reference range.

    Returns:
        Range-compressed pulses, shape (..., pulse, range); an echo of unit amplitude has a unit
        peak.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if a velocity is given and the radar has no pulse
            length.
    """
    raw = checked_samples(raw, "compress_dechirped", "pulse, fast time", finite=False)
    n = raw.shape[-1]
    cell = torch.arange(n, dtype=torch.float64, device=raw.device) - n // 2
    if velocity_m_s is not None:
        fast_s = cell * (_pulse_s(radar) / n)
        doubled = 2 / radar.wave_speed_m_s * torch.as_tensor(velocity_m_s, dtype=torch.float64, device=raw.device)
        turns = doubled[..., None] * (radar.carrier_hz + radar.chirp_rate_hz_s * fast_s) * fast_s
        raw = raw * unit_phasor(turns, raw.dtype)[..., None, :]
    lines = centred_ifft(raw)
    if not residual_video:
        return lines
    delay = 2 * radar.range_step_m * cell / radar.wave_speed_m_s
    return lines * unit_phasor(-0.5 * radar.chirp_rate_hz_s * delay.square(), raw.dtype)


def azimuth_transform(pulses: Tensor, window: str = "none", oversampling: int = 1) -> Tensor:
    """Form the image of phase-corrected pulses by a centred transform with exp(+j) over the pulses.

    With P pulses s[k], the window w_k and n = oversampling * P lines, line q of the image is

        sum_k w_k s[k] exp(2j pi (q - n // 2) (k - P // 2) / n) / sqrt(n).

    Without a window the energy of the pulses is preserved. Rounding errors do not depend on the
    number of trials. Differentiable.

    Args:
        pulses: Range-compressed pulses, shape (..., pulse, range), complex.
        window: "none" or "hann". The window has unit mean square, so that it does not change the
            power of white noise.
        oversampling: Image lines per pulse, by zero padding.

    Returns:
        Image, shape (..., oversampling * pulse, range).

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples.
    """
    pulses = checked_samples(pulses, "azimuth_transform", "pulse, range", finite=False)
    k = pulses.shape[-2]
    n = oversampling * k
    if window == "hann":
        pulses = pulses * _hann(k, pulses)[:, None]
    before = n // 2 - k // 2
    padded = torch.nn.functional.pad(pulses, (0, 0, before, n - k - before)) if n > k else pulses
    return torch.fft.fftshift(fft_lines(torch.fft.ifftshift(padded, dim=-2), inverse=True), dim=-2) * math.sqrt(n)


def _hann(n: int, like: Tensor) -> Tensor:
    """Hann window of unit mean square, (n,)."""
    w = torch.sin(math.pi * (torch.arange(n, dtype=torch.float64, device=like.device) + 0.5) / n).square()
    return (w / w.square().mean().sqrt()).to(real_dtype(like.dtype))


def _pulse_s(radar: InverseRadar) -> float:
    """Pulse length of the radar; raises ValueError where it is not set."""
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; give the length of the dechirped pulses in seconds")
    return radar.pulse_s


class CompressDechirped(Stage):
    """Stage that compresses dechirped pulses (pulse, fast_time) in range, see `compress_dechirped`.

    Data that are range-compressed already (pulse, range) pass unchanged, so that one chain serves
    echoes of either kind.

    For pulses of 100 us duration and 150 GHz bandwidth, the velocity must be known to 5 m/s, which
    leaves a quadratic phase of pi / 4; see `inverse_requirements`.

    Args:
        radar: Radar of the recording, with its pulse length.
        residual_video: Remove the residual video phase.
        velocity_m_s: Range rate within pulses in m/s, receding positive; None for no correction. A
            value passed to `forward` takes precedence, such as an estimate that a chain connects.

    Raises:
        ValueError: If the radar has no pulse length.
    """

    works_on = ("pulse", "fast_time")
    also_on = (("pulse", "range"),)

    velocity_m_s: Tensor | None

    def __init__(
        self, radar: InverseRadar, residual_video: bool = True, velocity_m_s: Tensor | float | None = None
    ) -> None:
        super().__init__()
        _pulse_s(radar)
        self.radar, self.residual_video = radar, residual_video
        if velocity_m_s is None:
            self.velocity_m_s = None
        else:
            self.hold("velocity_m_s", velocity_m_s)

    def forward(self, signal: Signal, velocity_m_s: Tensor | None = None) -> Signal:
        """Compress a signal with axes (pulse, fast_time).

        Args:
            signal: Dechirped recording, or range-compressed data, which are returned as they are.
            velocity_m_s: Range rate within pulses in m/s; None for that of the stage.

        Returns:
            Range-compressed signal with axes (pulse, range).

        Raises:
            ValueError: If the fast-time samples do not span the pulse about its middle.
        """
        if signal.names == self.also_on[0]:
            return signal
        pulse, fast = signal.axes
        self._check_sampling(fast)
        lines = compress_dechirped(
            signal.data, self.radar, self.velocity_m_s if velocity_m_s is None else velocity_m_s, self.residual_video
        )
        return Signal(lines, (pulse, self.radar.raw_axes(pulse.n, fast.n)[1]))

    def _check_sampling(self, fast: Axis) -> None:
        """Raise ValueError where the fast-time samples do not span the pulse about its middle."""
        step = _pulse_s(self.radar) / fast.n
        if abs(fast.step - step) > 1e-9 * step or abs(fast.start + (fast.n // 2) * step) > 1e-6 * step:
            raise ValueError(
                f"{fast.n} fast-time samples from {fast.start:.6g} s by {fast.step:.6g} s do not fill "
                f"the pulse of {_pulse_s(self.radar):g} s about its middle; set radar.pulse_s to the pulse length"
            )


class AzimuthTransform(Stage):
    """Stage that transforms range-compressed pulses of a rotating target into an image.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> ladar = radar.InverseRadar(193.4e12, bandwidth_hz=150e9, prf_hz=2e3, rotation_rad_s=0.005)
    >>> pulses = Signal(torch.ones(64, 32) + 0j, ladar.raw_axes(64, 32))
    >>> image = focus.AzimuthTransform(ladar)(pulses)
    >>> image.names, float(image.data[32, 0].abs())  # sqrt(64) in the middle
    (('azimuth', 'range'), 8.0)

    The azimuth axis is cross range, or Doppler where the radar has no rotation rate.

    Args:
        radar: Radar of the recording.
        window: "none" or "hann" over the pulses.
        oversampling: Lines per cross-range cell, by zero padding.

    Raises:
        ValueError: If `window` is not known or `oversampling` is not a whole number of 1 or more.
    """

    def __init__(self, radar: InverseRadar, window: str = "none", oversampling: int = 1) -> None:
        super().__init__()
        if window not in WINDOWS:
            raise ValueError(f"azimuth window {window!r} is unknown; choose one of {WINDOWS}")
        if oversampling < 1 or oversampling != int(oversampling):
            raise ValueError(f"oversampling must be a whole number of 1 or more, got {oversampling}")
        self.radar, self.window, self.oversampling = radar, window, int(oversampling)

    def forward(self, signal: Signal) -> Signal:
        """Form the image of a signal with axes (pulse, range) by a transform over the pulses.

        Args:
            signal: Range-compressed pulses.

        Returns:
            Image with axes (azimuth, range); azimuth in metres, or in Hz without a rotation rate.
        """
        pulse, range_ = signal.axes
        image = azimuth_transform(signal.data, self.window, self.oversampling)
        padded = Axis(pulse.name, image.shape[-2], pulse.start, pulse.step, pulse.unit)
        return Signal(image, self.radar.image_axes((padded, range_)))
