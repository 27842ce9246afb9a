"""Range migration of moving points in channels that are aliased in azimuth: deramp, keystone,
reramp.

A keystone transform takes out the range walk of all targets at once, but it needs unaliased slow
time, and the channels are aliased. So the range history of a reference is first taken out of
carrier and envelope alike, times exp(+j 2 pi (fc + fr) / c (R_ref,m(t) - R_ref)), which leaves a
tone of every target; then slow time is rescaled, t -> t fc / (fc + fr); then the history goes back
into the carrier alone. Azimuth phases are what they were, and envelopes stand still. Source: brief
001, RCMC order; Remote Sens. 2020, 12, 1703, section 4.1 names the keystone transform without its
order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Signal, Stage, block_bytes_of, linear_phasor, per_trial, unit_phasor
from torchsar.focus import keystone
from torchsar.focus.nufft import nufft_type2
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.reconstruct import refuse_shifted
from torchsar.radar import BistaticRadar, receive_range

_EPS = {torch.complex64: 1e-5, torch.complex128: 1e-10}


@dataclass(frozen=True)
class Frame:
    """Where data (..., channel, pulse, range) were taken: radar, slow time (pulse,) in s, and
    closest ranges of the axis (range,) in m, both float64.
    """

    radar: BistaticRadar
    time_s: Tensor
    range_m: Tensor

    @staticmethod
    def of(radar: BistaticRadar, signal: Signal) -> Frame:
        device = signal.data.device
        return Frame(radar, signal.axis("pulse").values(device), signal.axis("range").values(device))

    def path_m(self, reference: PointMotion) -> Tensor:
        """R_ref,m(t) - R_ref of the reference, (..., channel, pulse)."""
        return self._history(reference, reference.range_m[..., None, None, None]).path_m[..., 0]

    def residual_m(self, reference: PointMotion, walks: float) -> Tensor:
        """How far envelopes at the closest ranges of the axis lie off when the history of the
        reference is taken out, (..., channel, pulse, range).

        e(t), the change of the history with range, less walks * t de/dt: a keystone (walks = 1)
        takes out what is linear in t and moves the rest by -t de/dt.
        """
        own, of_reference = (
            self._history(reference, self.range_m),
            self._history(reference, reference.range_m[..., None, None, None]),
        )
        e = own.path_m - of_reference.path_m
        return e if not walks else e - walks * self.time_s[:, None] * (own.rate_m_s - of_reference.rate_m_s)

    def _history(self, reference: PointMotion, range_m: Tensor) -> _History:
        u_r, u_a, y0 = (
            value[..., None, None, None] for value in (reference.u_r_m_s, reference.u_a_m_s, reference.y0_m)
        )
        return _History(
            self.time_s[:, None],
            u_r,
            u_a,
            y0,
            range_m,
            reference.speed_m_s,
            self.radar.channels_at(self.time_s.device)[:, None, None],
        )


@dataclass(frozen=True)
class _History:
    """Range of a point over time, all fields broadcast to (..., channel, pulse, range)."""

    time_s: Tensor
    u_r_m_s: Tensor
    u_a_m_s: Tensor
    y0_m: Tensor
    range_m: Tensor
    speed_m_s: float
    channel_m: Tensor

    @property
    def path_m(self) -> Tensor:
        return receive_range(
            self.time_s, self.u_r_m_s, self.u_a_m_s, self.y0_m, self.range_m, self.speed_m_s, self.channel_m
        )

    @property
    def rate_m_s(self) -> Tensor:
        """Derivative of the range over time."""
        v = self.speed_m_s - self.u_a_m_s
        across, along = self.range_m - self.u_r_m_s * self.time_s, v * self.time_s - self.y0_m - self.channel_m
        return (v * along - self.u_r_m_s * across) / torch.sqrt(across.square() + along.square())


class Migration(Protocol):
    """A way to make envelopes stand still.

    `apply` takes data (..., channel, pulse, range), their frame, the motion of the reference
    (...,), and the ambiguity number (...,). `neglected_m` says how far (m) it lets the envelope of
    a point with another motion move over an integration time about t = 0: below a quarter of a
    range cell, c / (4 B), nothing is lost.
    """

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor: ...

    def neglected_m(self, integration_s: float, motion: PointMotion, reference: PointMotion) -> Tensor: ...


@dataclass(frozen=True)
class NoMigration:
    """Envelopes stay where they are."""

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        return data

    def neglected_m(self, integration_s: float, motion: PointMotion, reference: PointMotion) -> Tensor:
        """All migration against t = 0, (...,)."""
        return _moved_m(integration_s, motion).abs().amax(0)


@dataclass(frozen=True)
class StaticBulk:
    """Every pulse shifted along range by the history of the reference: exact for a point that moves
    as the reference does, whatever its Doppler ambiguity.

    What others walk against it stays. whole_swath: shifts follow the closest range along the axis,
    else they are those of the reference.
    """

    whole_swath: bool = False

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        spectrum = torch.fft.fft(data) * _envelope_phasor(frame.path_m(reference), frame.radar, data)
        return _profiles(spectrum, frame, reference, 0.0) if self.whole_swath else torch.fft.ifft(spectrum)

    def neglected_m(self, integration_s: float, motion: PointMotion, reference: PointMotion) -> Tensor:
        """Walk and curvature that differ from those of the reference, (...,)."""
        return (
            (_moved_m(integration_s, motion) - _moved_m(integration_s, _followed(motion, reference, self.whole_swath)))
            .abs()
            .amax(0)
        )


@dataclass(frozen=True)
class Keystone:
    """Deramp, keystone, reramp: walks of all targets are taken out, whatever their velocities and
    places, if the ambiguity number is theirs.

    The tone of a target, (u_r + v y0 / R0) / lambda against the reference, must lie within half a
    pulse rate of the ambiguity number times the pulse rate. whole_swath: the curvature follows the
    closest range along the axis; else it is that of the reference, which serves 165 m to either
    side in the geometry of the paper, in a third of the time.
    """

    whole_swath: bool = True

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        path = frame.path_m(reference)
        deramp = unit_phasor(path / frame.radar.wavelength_m, data.dtype)[..., None]
        spectrum = torch.fft.fft(data * deramp) * _envelope_phasor(path, frame.radar, data)
        spectrum = _rescaled(spectrum, frame.radar, ambiguity) * deramp.conj()
        return _profiles(spectrum, frame, reference, 1.0) if self.whole_swath else torch.fft.ifft(spectrum)

    def neglected_m(self, integration_s: float, motion: PointMotion, reference: PointMotion) -> Tensor:
        """Curvature that differs from that of the reference, (...,): a keystone takes out what is
        linear.
        """
        e = _moved_m(integration_s, motion) - _moved_m(integration_s, _followed(motion, reference, self.whole_swath))
        return e.mean(0).abs()


def _moved_m(integration_s: float, motion: PointMotion) -> Tensor:
    """R(+-T/2) - R(0), (2, ...)."""

    def at(time_s: float) -> Tensor:
        time = torch.tensor(time_s, dtype=torch.float64, device=motion.range_m.device)
        return receive_range(time, motion.u_r_m_s, motion.u_a_m_s, motion.y0_m, motion.range_m, motion.speed_m_s, 0.0)

    return torch.stack([at(-integration_s / 2) - at(0.0), at(integration_s / 2) - at(0.0)])


def _followed(motion: PointMotion, reference: PointMotion, whole_swath: bool) -> PointMotion:
    """The motion whose history is taken out at the range of a point."""
    return replace(reference, range_m=motion.range_m) if whole_swath else reference


def ambiguity_number(radar: BistaticRadar, motion: PointMotion, reference: PointMotion) -> Tensor:
    """Whole pulse rates in the tone of a point after the deramp, round((du_r + v y0 / R0) / (lambda
    PRF)) against the reference, float64 (...,).
    """
    tone = [m.u_r_m_s + m.along_m_s * m.y0_m / m.range_m for m in (motion, reference)]
    return torch.round((tone[0] - tone[1]) / radar.ambiguous_velocity_m_s)


def _envelope_phasor(path_m: Tensor, radar: BistaticRadar, data: Tensor) -> Tensor:
    """exp(+j 2 pi fr / c path) over the range frequencies of an FFT, (..., range frequency)."""
    n = data.shape[-1]
    turns = path_m / (radar.range_step_m * n)
    return torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, data.dtype), dim=-1)


def _rescaled(spectrum: Tensor, radar: BistaticRadar, ambiguity: Tensor) -> Tensor:
    """Keystone of (..., channel, pulse, range frequency), with pulses of zeros around it: what is
    read from beyond the aperture is not its other end.
    """
    n, frequency = spectrum.shape[-2], radar.range_frequency_hz(spectrum.shape[-1], spectrum.device)
    margin = math.ceil(n * radar.sampling_hz / (4 * radar.carrier_hz - 2 * radar.sampling_hz)) + 1
    padded, ambiguity = pad(spectrum, (0, 0, margin, margin)), ambiguity[..., None]
    # a few columns at a time stay in the cache: four times as fast as all at once
    width = max(16, block_bytes_of(spectrum.device) // (n * spectrum.element_size()))
    parts = [
        keystone(x, f, radar.carrier_hz, ambiguity) for x, f in zip(padded.split(width, -1), frequency.split(width))
    ]
    return torch.cat(parts, -1)[..., margin : margin + n, :]


def _profiles(spectrum: Tensor, frame: Frame, reference: PointMotion, walks: float) -> Tensor:
    """Range profiles of spectra (..., channel, pulse, range frequency), each cell read where
    `Frame.residual_m` says that its envelope went.
    """
    n = spectrum.shape[-1]
    cells = (
        torch.arange(n, dtype=torch.float64, device=spectrum.device)
        + frame.residual_m(reference, walks) / frame.radar.range_step_m
    )
    return nufft_type2(torch.fft.fftshift(spectrum, dim=-1) / n, -cells / n, _EPS[spectrum.dtype])


def correct_migration(
    data: Tensor,
    frame: Frame,
    reference: PointMotion,
    migration: Migration | None = None,
    ambiguity: Tensor | float = 0,
) -> Tensor:
    """Data in which envelopes stand still, at their range at t = 0 less that of the reference plus
    R_ref; carrier phases are left as they are.

    data: (..., channel, pulse, range), range compressed, transmit range removed; reference: the
    motion (...,) whose history is taken out; migration: `Keystone()` by default. ambiguity: whole
    pulse rates (...,) in the tones left by the reference, see `ambiguity_number`. A point at y0
    comes to lie at sqrt(R0^2 + y0^2) with a reference at y0 = 0. Lines wrap around: leave as many
    cells free at both ends as envelopes move. Differentiable in the data and, without whole_swath
    also, in the reference.
    """
    if data.ndim < 3 or data.shape[-3:] != (frame.radar.channels, frame.time_s.shape[0], frame.range_m.shape[0]):
        expected = (frame.radar.channels, frame.time_s.shape[0], frame.range_m.shape[0])
        raise ValueError(
            f"correct_migration works on data (..., {', '.join(map(str, expected))}) as radar and "
            f"axes say, got shape {tuple(data.shape)}"
        )
    return (Keystone() if migration is None else migration).apply(data, frame, reference, per_trial(ambiguity, 0, data))


class CorrectMigration(Stage):
    """`correct_migration` of range-compressed channels.

    range_m: closest range of the reference, None for the radar's reference range.

    Velocities and place of the reference, and the ambiguity number, are values, per trial: all zero
    for a reference at rest that is abeam at t = 0.
    """

    works_on = ("channel", "pulse", "range")
    range_m: Tensor

    def __init__(self, radar: BistaticRadar, migration: Migration | None = None, range_m: Number | None = None) -> None:
        super().__init__()
        self.radar, self.migration = radar, migration or Keystone()
        self.hold("range_m", radar.reference_range_m if range_m is None else range_m)

    def forward(
        self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0, ambiguity: Number = 0
    ) -> Signal:
        refuse_shifted(self.radar, signal.axis("pulse"))
        reference = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        return signal.with_data(
            correct_migration(signal.data, Frame.of(self.radar, signal), reference, self.migration, ambiguity)
        )
