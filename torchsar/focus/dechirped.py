"""From the dechirped pulses of a turning target to range-compressed ones, and from these to an
image.

What a pulse of an echo holds after dechirping, with the delay dtau against the reference and t'
from the middle of the pulse, is exp(-2j pi (f0 dtau + gamma t' dtau - gamma dtau^2 / 2)). Turntable
transforms over pulses use exp(+j): +x lies at + on the axis.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, centred_ifft, fft_lines, real_dtype, unit_phasor
from torchsar.radar import InverseRadar

WINDOWS = ("none", "hann")


def compress_dechirped(
    raw: Tensor, radar: InverseRadar, velocity_m_s: Tensor | float | None = None, residual_video: bool = True
) -> Tensor:
    """Range compression of dechirped pulses: (..., pulse, fast_time) -> (..., pulse, range), a unit
    echo to a unit peak.

    Fast time i lies at (i - n // 2) * pulse_s / n from the middle of the pulse; range i at (i - n
    // 2) * range_step_m from the reference. velocity_m_s (...,): range rate dR/dt within pulses,
    receding positive. Its phase 2 pi (2 v / c) (f0 t' + gamma t'^2) is taken out first: the shift v
    f0 / gamma, also where it wrapped round, and the blur of the walk. residual_video: whether pi
    gamma (2 r / c)^2 is taken out at each range r. Differentiable in samples and velocity.
    """
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
    """Image from phase-corrected pulses, (..., pulse, range) -> (..., oversampling * pulse, range):
    centred transform with exp(+j) over pulses.

    Line q holds sum_k w_k s[k] exp(2j pi (q - n // 2) (k - pulse // 2) / n) / sqrt(n), n =
    oversampling * pulse: the energy of the pulses is kept. window: "none" or "hann", of unit mean
    square, so that noise keeps its level. Rounds alike for any number of trials; differentiable.
    """
    k = pulses.shape[-2]
    n = oversampling * k
    if window == "hann":
        pulses = pulses * _hann(k, pulses)[:, None]
    before = n // 2 - k // 2
    padded = torch.nn.functional.pad(pulses, (0, 0, before, n - k - before)) if n > k else pulses
    return torch.fft.fftshift(fft_lines(torch.fft.ifftshift(padded, dim=-2), inverse=True), dim=-2) * math.sqrt(n)


def _hann(n: int, like: Tensor) -> Tensor:
    w = torch.sin(math.pi * (torch.arange(n, dtype=torch.float64, device=like.device) + 0.5) / n).square()
    return (w / w.square().mean().sqrt()).to(real_dtype(like.dtype))


def _pulse_s(radar: InverseRadar) -> float:
    if radar.pulse_s is None:
        raise ValueError("radar.pulse_s is not set; a dechirped pulse needs its length")
    return radar.pulse_s


class CompressDechirped(Stage):
    """Dechirped pulses (pulse, fast_time) to range-compressed ones (pulse, range).

    velocity_m_s (...,): range rate within pulses, see `compress_dechirped`; a connected value goes
    before that of the constructor. At pulses of 100 us and 150 GHz the velocity must be known to 5
    m/s (quadratic phase of pi / 4): `focus.inverse_requirements`.
    """

    works_on = ("pulse", "fast_time")

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
        pulse, fast = signal.axes
        self._refuse_other_sampling(fast)
        lines = compress_dechirped(
            signal.data, self.radar, self.velocity_m_s if velocity_m_s is None else velocity_m_s, self.residual_video
        )
        return Signal(lines, (pulse, self.radar.raw_axes(pulse.n, fast.n)[1]))

    def _refuse_other_sampling(self, fast: Axis) -> None:
        step = _pulse_s(self.radar) / fast.n
        if abs(fast.step - step) > 1e-9 * step or abs(fast.start + (fast.n // 2) * step) > 1e-6 * step:
            raise ValueError(
                f"{fast.n} fast-time samples from {fast.start:.6g} s by {fast.step:.6g} s do not fill "
                f"the pulse of {_pulse_s(self.radar):g} s about its middle; set radar.pulse_s"
            )


class AzimuthTransform(Stage):
    """Range-compressed pulses of a turning target to an image in cross range, or in Doppler where
    the radar's rotation rate is not known.

    window: "none" or "hann"; oversampling: lines per cross-range cell, by zero padding. See
    `azimuth_transform`.
    """

    def __init__(self, radar: InverseRadar, window: str = "none", oversampling: int = 1) -> None:
        super().__init__()
        if window not in WINDOWS:
            raise ValueError(f"azimuth window {window!r} is unknown; choose one of {WINDOWS}")
        if oversampling < 1 or oversampling != int(oversampling):
            raise ValueError(f"oversampling must be a whole number of 1 or more, got {oversampling}")
        self.radar, self.window, self.oversampling = radar, window, int(oversampling)

    def forward(self, signal: Signal) -> Signal:
        pulse, range_ = signal.axes
        image = azimuth_transform(signal.data, self.window, self.oversampling)
        padded = Axis(pulse.name, image.shape[-2], pulse.start, pulse.step, pulse.unit)
        return Signal(image, self.radar.image_axes((padded, range_)))
