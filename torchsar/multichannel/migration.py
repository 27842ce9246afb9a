"""Range migration correction of moving points in channels that are aliased in azimuth.

A keystone transform removes the range walk of all targets at once, but it needs unaliased slow
time, and each channel is aliased. The range history of a reference point is therefore removed first
from carrier and envelope, which reduces each target to a tone. The factor is exp(+j 2 pi (fc + fr)
/ c (R_ref,m(t) - R_ref)), with the carrier frequency fc and the range frequency fr. R_ref,m(t) is
the range between the reference point and channel m, and R_ref is its closest range. Slow time is
then rescaled, t -> t fc / (fc + fr), and the history is restored in the carrier alone. Azimuth
phases are unchanged, and the envelope of each target is at the same range in all pulses.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.1, which names the keystone transform without the deramp
    that aliased data require.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Signal, Stage, block_bytes_of, checked_samples, linear_phasor, per_trial, unit_phasor
from torchsar.focus import keystone
from torchsar.focus.nufft import nufft_type2
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import refuse_shifted
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range

# Relative error of the non-uniform FFT. It is -100 dB, well below the -60 dB required of complex64
# images. In complex128, a smaller error would widen the kernel and take time.
_EPS = {torch.complex64: 1e-5, torch.complex128: 1e-10}


@dataclass(frozen=True)
class Frame:
    """Radar and axes of data (..., channel, pulse, range), from which range histories follow.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> frame = multichannel.Frame(receiver, torch.tensor([0.0, 1.0]), torch.tensor([5000.0]))
    >>> path_m = frame.path_m(multichannel.PointMotion.of(receiver, torch.zeros(())))
    >>> [round(x, 1) for x in path_m[1].tolist()]  # middle channel
    [0.0, 9.0]

    Args:
        radar: Radar parameters.
        time_s: Slow time in seconds, float64 (pulse,).
        range_m: Range axis in metres, float64 (range,). It holds the closest range of points.
    """

    radar: BistaticRadar
    time_s: Tensor
    range_m: Tensor

    @staticmethod
    def of(radar: BistaticRadar, signal: Signal) -> Frame:
        """Return the frame of a signal with the axes (channel, pulse, range)."""
        device = signal.data.device
        return Frame(radar, signal.axis("pulse").values(device), signal.axis("range").values(device))

    def path_m(self, reference: PointMotion) -> Tensor:
        """Return the range history of a reference point, seen from each channel.

        It is the range between the point and the channel at each pulse, minus the closest range of
        the motion, `reference.range_m`.

        Args:
            reference: Motion of the reference point, shape (...,).

        Returns:
            Change of range in metres, float64 (..., channel, pulse).
        """
        return self._moved_m(reference, reference.range_m[..., None, None, None], 0.0)[..., 0]

    def residual_m(self, reference: PointMotion, walks: float) -> Tensor:
        """Return the envelope displacement left after removal of the reference range history.

        It is computed in each range cell for a point that moves as the reference, but has the
        closest range of the cell. Without a keystone transform it is e(t), the range history of
        this point minus that of the reference point. A keystone transform removes the part that is
        linear in t and leaves e(t) - t de/dt.

        Args:
            reference: Motion of the reference point, shape (...,).
            walks: 1 after a keystone transform, 0 without.

        Returns:
            Displacement in metres, float64 (..., channel, pulse, range).
        """
        whole = self._moved_m(reference, self.range_m, walks)
        return whole - self._moved_m(reference, reference.range_m[..., None, None, None], walks)

    def _moved_m(self, reference: PointMotion, range_m: Tensor, walks: float) -> Tensor:
        """Return the range history R_m(t) - R0 of the reference motion at given closest ranges,
        (..., channel, pulse, range).

        Its derivative times slow time and `walks` is subtracted.
        """
        time_s, channel_m = self.time_s[:, None], self.radar.channels_at(self.time_s.device)[:, None, None]
        u_r, u_a, y0 = (x[..., None, None, None] for x in (reference.u_r_m_s, reference.u_a_m_s, reference.y0_m))
        path = receive_range(time_s, u_r, u_a, y0, range_m, reference.speed_m_s, channel_m)
        if not walks:
            return path
        v = reference.speed_m_s - u_a
        across, along = range_m - u_r * time_s, v * time_s - y0 - channel_m
        rate_m_s = (v * along - u_r * across) / torch.sqrt(across.square() + along.square())
        return path - walks * time_s * rate_m_s


@dataclass(frozen=True)
class NoMigration:
    """Method that leaves the range migration uncorrected.

    >>> import torch
    >>> from torchsar import Signal, multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> channels = Signal(torch.ones(3, 4, 8, dtype=torch.complex64), receiver.axes(4, 8))
    >>> same = multichannel.CorrectMigration(receiver, multichannel.NoMigration())(channels)
    >>> bool((same.data == channels.data).all())
    True
    """

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        """Return the data unchanged."""
        return data


@dataclass(frozen=True)
class StaticBulk:
    """Migration correction by a shift of every pulse along range by a reference range history.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([20], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 170, 64, Draws(seed=1))[0].signal
    >>> bulk = multichannel.CorrectMigration(receiver, multichannel.StaticBulk())
    >>> [len(bulk(channels, u).data[1].abs().argmax(-1).unique()) for u in (0.0, 20.0)]  # cells
    [5, 1]

    Exact for a point that moves as the reference does, whatever its Doppler ambiguity. The range
    walk of other points relative to the reference remains.

    Args:
        whole_swath: True to compute the shift for the closest range of every range cell, False to
            use the shift of the reference for all cells.
    """

    whole_swath: bool = False

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        """Shift pulses by the range history of the reference; arguments as in `Keystone.apply`."""
        spectrum = torch.fft.fft(data) * envelope_phasor(frame.path_m(reference), frame.radar, data)
        return _profiles(spectrum, frame, reference, 0.0) if self.whole_swath else torch.fft.ifft(spectrum)


@dataclass(frozen=True)
class Keystone:
    """Migration correction that removes the range walk of all targets by a keystone transform.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([20], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 170, 64, Draws(seed=1))[0].signal
    >>> still = multichannel.CorrectMigration(receiver, multichannel.Keystone())(channels)
    >>> len(still.data[1].abs().argmax(-1).unique())  # range cells of a point of unknown speed
    1

    The range history of the reference is removed before the transform (deramp) and restored in the
    carrier phase after it (reramp). The ambiguity number q must be that of the target: |F - F_ref -
    q PRF| must be at most PRF / 2, with F = (u_r + v y0 / R0) / lambda for the target and F_ref for
    the reference. Here u_r is the slant-range speed, v the along-track speed of the receiver
    relative to the point, y0 the along-track position and R0 the closest range.

    Args:
        whole_swath: True to correct the curvature for the closest range of every range cell. False
            uses the curvature of the reference for all cells, which takes a third of the time and
            suffices within 165 m of the reference range in the geometry of Remote Sens. 2020, 12,
            1703.
    """

    whole_swath: bool = True

    def apply(self, data: Tensor, frame: Frame, reference: PointMotion, ambiguity: Tensor) -> Tensor:
        """Correct range migration by deramp, keystone transform and reramp.

        Args:
            data: Range-compressed channels, shape (..., channel, pulse, range), complex.
            frame: Radar, slow time and ranges of the data.
            reference: Motion of the reference point, whose range history is removed, shape (...,).
            ambiguity: PRF ambiguity number of the targets relative to the reference, shape (...,),
                the nearest whole number to (F - F_ref) / PRF, see `Keystone`.

        Returns:
            Corrected data, same shape.
        """
        path = frame.path_m(reference)
        deramp = unit_phasor(path / frame.radar.wavelength_m, data.dtype)[..., None]
        spectrum = torch.fft.fft(data * deramp) * envelope_phasor(path, frame.radar, data)
        spectrum = _rescaled(spectrum, frame.radar, ambiguity) * deramp.conj()
        return _profiles(spectrum, frame, reference, 1.0) if self.whole_swath else torch.fft.ifft(spectrum)


Migration = NoMigration | StaticBulk | Keystone


def envelope_phasor(path_m: Tensor, radar: BistaticRadar, data: Tensor) -> Tensor:
    """Return exp(+j 2 pi fr / c path), which moves envelopes nearer by a path.

    Args:
        path_m: Path in metres, float64 (...,).
        radar: Radar parameters.
        data: Samples whose number of ranges and dtype are used.

    Returns:
        Phasor over range frequency in FFT order, (..., range frequency).
    """
    n = data.shape[-1]
    turns = path_m / (radar.range_step_m * n)
    return torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, data.dtype), dim=-1)


def _rescaled(spectrum: Tensor, radar: BistaticRadar, ambiguity: Tensor) -> Tensor:
    """Apply the keystone transform to (..., channel, pulse, range frequency).

    The pulses are zero-padded, so that reads beyond one end of the aperture do not wrap to the
    other.
    """
    n, frequency = spectrum.shape[-2], radar.range_frequency_hz(spectrum.shape[-1], spectrum.device)
    margin = math.ceil(n * radar.sampling_hz / (4 * radar.carrier_hz - 2 * radar.sampling_hz)) + 1
    padded, ambiguity = pad(spectrum, (0, 0, margin, margin)), ambiguity[..., None]
    # blocks of a few columns fit into the cache, which is four times as fast as all columns at once
    width = max(16, block_bytes_of(spectrum.device) // (n * spectrum.element_size()))
    parts = [
        keystone(x, f, radar.carrier_hz, ambiguity) for x, f in zip(padded.split(width, -1), frequency.split(width))
    ]
    return torch.cat(parts, -1)[..., margin : margin + n, :]


def _profiles(spectrum: Tensor, frame: Frame, reference: PointMotion, walks: float) -> Tensor:
    """Return range profiles; each cell is interpolated at the range where `Frame.residual_m`
    predicts its envelope.
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
    """Correct the range migration so that each envelope stays at one range.

    The corrected envelope lies at the range of the point at t = 0, minus that of the reference at t
    = 0, plus the closest range of the reference. With a reference at the along-track position 0, a
    point at the along-track position y0 and the closest range R0 thus lies at sqrt(R0^2 + y0^2).
    Carrier phases are unchanged. Shifts wrap around at the ends of the range line: leave as many
    free range cells at both ends as the envelopes move. Differentiable in the data and, with
    `whole_swath` False, in the reference.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape (...,
            channel, pulse, range), complex.
        frame: Radar, slow time and ranges of the data.
        reference: Motion of the reference point, whose range history is removed, shape (...,).
        migration: Method, `Keystone()` by default.
        ambiguity: PRF ambiguity number of the targets relative to the reference, shape (...,) or a
            number, the nearest whole number to (F - F_ref) / PRF, see `Keystone`.

    Returns:
        Corrected data, same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the shape of the data does not match the frame.
    """
    data = checked_samples(data, "correct_migration", "channel, pulse, range", finite=False)
    if data.ndim < 3 or data.shape[-3:] != (frame.radar.channels, frame.time_s.shape[0], frame.range_m.shape[0]):
        expected = (frame.radar.channels, frame.time_s.shape[0], frame.range_m.shape[0])
        raise ValueError(
            f"correct_migration works on data (..., {', '.join(map(str, expected))}), the numbers of channels, pulses "
            f"and range cells of `frame`, got shape {tuple(data.shape)}; build the frame from these data"
        )
    return (Keystone() if migration is None else migration).apply(data, frame, reference, per_trial(ambiguity, 0, data))


class CorrectMigration(Stage):
    """Stage that corrects the range migration of range-compressed channels (channel, pulse, range).

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([20], [0], [0], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 170, 64, Draws(seed=1))[0].signal
    >>> corrected = multichannel.CorrectMigration(receiver)(channels, u_r_m_s=20.0)
    >>> [len(x.data[1].abs().argmax(-1).unique()) for x in (channels, corrected)]  # range cells
    [4, 1]

    Azimuth-only data (channel, pulse), which do not migrate, pass unchanged.

    Args:
        radar: Radar parameters.
        migration: Method, `Keystone()` by default.
        range_m: Closest range of the reference point in metres, None for the reference range of the
            radar.
    """

    works_on = ("channel", "pulse", "range")
    also_on = (("channel", "pulse"),)
    range_m: Tensor

    def __init__(self, radar: BistaticRadar, migration: Migration | None = None, range_m: Number | None = None) -> None:
        super().__init__()
        self.radar, self.migration = radar, migration or Keystone()
        self.hold("range_m", radar.reference_range_m if range_m is None else range_m)

    def forward(
        self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0, ambiguity: Number = 0
    ) -> Signal:
        """Correct the range migration with one reference point per trial.

        By default the reference is at rest and broadside at t = 0.

        Args:
            signal: Channels with the axes (channel, pulse, range) or (channel, pulse).
            u_r_m_s: Slant-range speed of the reference in m/s, closing positive, shape (...,) or a
                number.
            u_a_m_s: Along-track speed of the reference in m/s, same shape.
            y0_m: Along-track position of the reference at t = 0 in metres, same shape.
            ambiguity: PRF ambiguity number of the targets relative to the reference, same shape,
                the nearest whole number to (F - F_ref) / PRF, see `Keystone`.

        Returns:
            Corrected channels on the same axes; azimuth-only data are returned unchanged.

        Raises:
            ValueError: If slow time is not zero at pulse n // 2.
        """
        if "range" not in signal.names:
            return signal
        refuse_shifted(self.radar, signal.axis("pulse"))
        reference = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        return signal.with_data(
            correct_migration(signal.data, Frame.of(self.radar, signal), reference, self.migration, ambiguity)
        )
