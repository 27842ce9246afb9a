"""Velocity estimators of a moving point as stages.

They work on signals (channel, pulse) or on the strongest range line of each trial of signals
(channel, pulse, range).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, take
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.reconstruct import refuse_shifted
from torchsar.multichannel.velocity.along_track import along_track_velocity, motion_from
from torchsar.multichannel.velocity.ambiguity import warned_of_ambiguity
from torchsar.multichannel.velocity.aperture import Aperture
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.gradient import gradient_likelihood
from torchsar.multichannel.velocity.interferometry import DETECTED_DB, interferometry
from torchsar.multichannel.velocity.likelihood import maximum_likelihood
from torchsar.multichannel.velocity.model import UNKNOWNS, estimate_of, refuse_unknowns
from torchsar.multichannel.velocity.recommended import moving_point_velocity
from torchsar.radar import BistaticRadar

_LEAST_PULSES = 4  # convention: three pulses define a tone and its curvature, a fourth shows noise


def strongest_line(data: Tensor) -> tuple[Tensor, Tensor]:
    """Select the range line of most energy of each trial.

    Args:
        data: Channels with corrected migration, shape (..., channel, pulse, range), complex.

    Returns:
        The line (..., channel, pulse) and its index (...,).
    """
    index = data.detach().abs().square().sum((-3, -2)).argmax(-1)
    return take(data.movedim(-1, -3), index, -3), index


class _Velocity(Stage):
    """Estimator on one range line, with radar, expected amplitude and closest range."""

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    provides = UNKNOWNS

    def __init__(self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None) -> None:
        super().__init__()
        self.radar, self.aperture, self.range_m = radar, aperture, range_m

    def line(self, signal: Signal) -> tuple[Tensor, Tensor | float | None]:
        """Return the data (..., channel, pulse) of the strongest line and their closest range.

        Raises:
            ValueError: If the channels are not those of the radar, slow time is not zero at pulse n
                // 2, or there are fewer than 4 pulses.
        """
        refuse_shifted(self.radar, signal.axis("pulse"))
        channels, pulses = signal.axes[0].n, signal.axes[1].n
        if channels != self.radar.channels or pulses < _LEAST_PULSES:
            raise ValueError(
                f"{type(self).__name__} expects {self.radar.channels} channels as in the radar's "
                f"channel_m and at least {_LEAST_PULSES} pulses, got {channels} and {pulses}; select "
                "the same channels in radar and data"
            )
        if "range" not in signal.names:
            return signal.data, self.range_m
        data, index = strongest_line(signal.data)
        near = signal.axis("range")
        return data, near.start + near.step * index.to(torch.float64) if self.range_m is None else self.range_m

    def begin(
        self, signal: Signal, u_r_m_s: Number, u_a_m_s: Number, y0_m: Number
    ) -> tuple[Tensor, BistaticRadar, PointMotion, Aperture]:
        """Return data, radar, starting motion and aperture for an estimator near a start."""
        data, range_m = self.line(signal)
        return data, self.radar, motion_from(self.radar, data, u_r_m_s, u_a_m_s, y0_m, range_m), self.aperture


class Interferometry(_Velocity):
    """Stage that estimates u_r by along-track interferometry for a given u_a; see `interferometry`.

    Args:
        radar: Instrument.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the line or the reference range.
        check_ambiguity: Whether to check for a velocity wrong by a multiple of lambda * PRF, in
            about 10 ms per trial. If one is found, a warning is given and `ok` is False.
    """

    def __init__(
        self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None, check_ambiguity: bool = True
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.check_ambiguity = check_ambiguity

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate u_r and y0 near a start.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Starting slant-range speed in m/s, shape (...,) or a number.
            u_a_m_s: Along-track speed in m/s, shape (...,) or a number.
            y0_m: Starting along-track position at t = 0 in metres, shape (...,) or a number.

        Raises:
            ValueError: As in `interferometry`, for other channels than the radar's, for slow time
                that is not zero at pulse n // 2, and for fewer than 4 pulses.
        """
        data, radar, start, aperture = self.begin(signal, u_r_m_s, u_a_m_s, y0_m)
        found = interferometry(data, radar, start, aperture)
        there = replace(start, u_r_m_s=found["u_r_m_s"], y0_m=found["y0_m"])
        return warned_of_ambiguity(found, data, radar, there, aperture) if self.check_ambiguity else found


class AlongTrackAutofocus(_Velocity):
    """Along-track velocity by the power of the deramped tone; see `along_track_velocity`.

    Args:
        radar: Instrument.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the line or the reference range.
        half_m_s: Half width of the search about u_a = 0 in m/s.
    """

    provides = ("u_a_m_s",)

    def __init__(
        self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None, half_m_s: float = 20.0
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.half_m_s = half_m_s

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate u_a with u_r and y0 as given.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Slant-range speed in m/s, shape (...,) or a number.
            y0_m: Along-track position at t = 0 in metres, shape (...,) or a number.

        Raises:
            ValueError: As in `along_track_velocity`, and as in `Interferometry.forward`.
        """
        return along_track_velocity(*self.begin(signal, u_r_m_s, 0.0, y0_m), self.half_m_s)


class LikelihoodVelocity(_Velocity):
    """Maximum likelihood near given values as a stage; see `maximum_likelihood`.

    Args:
        radar: Instrument.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the line or the reference range.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`.

    Raises:
        ValueError: If `unknowns` holds other names or a name twice.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Aperture,
        range_m: float | None = None,
        unknowns: tuple[str, ...] = UNKNOWNS,
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.unknowns = tuple(unknowns)
        refuse_unknowns(self.unknowns)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the unknowns near a start; `ok` is False below 19 dB over all samples.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Starting slant-range speed in m/s, shape (...,) or a number.
            u_a_m_s: Starting along-track speed in m/s, shape (...,) or a number.
            y0_m: Starting along-track position at t = 0 in metres, shape (...,) or a number.

        Raises:
            ValueError: As in `Interferometry.forward`.
        """
        found = maximum_likelihood(*self.begin(signal, u_r_m_s, u_a_m_s, y0_m), self.unknowns)
        return estimate_of(found, found.snr_db >= DETECTED_DB, ((found.snr_db - DETECTED_DB) / 3).sigmoid())


class GradientVelocity(_Velocity):
    """Maximum likelihood by autograd gradients as a stage; see `gradient_likelihood`.

    Args:
        radar: Instrument.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the line or the reference range.
        unknowns: Names of the parameters to estimate among `u_r_m_s`, `u_a_m_s`, `y0_m`.

    Raises:
        ValueError: If `unknowns` holds other names or a name twice.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Aperture,
        range_m: float | None = None,
        unknowns: tuple[str, ...] = UNKNOWNS,
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.unknowns = tuple(unknowns)
        refuse_unknowns(self.unknowns)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        """Estimate the unknowns near a start; arguments as in `LikelihoodVelocity.forward`."""
        return gradient_likelihood(*self.begin(signal, u_r_m_s, u_a_m_s, y0_m), self.unknowns)


class MovingPointVelocity(_Velocity):
    """Recommended velocity estimator, without prior knowledge; see `moving_point_velocity`.

    If the search covers less than one PRF of u_r, a warning is given where the velocity lies
    beyond.

    Args:
        radar: Instrument.
        aperture: Expected amplitude over slow time.
        range_m: Closest range in metres, None for that of the line or the reference range.
        search: Extent of the bank, by default three PRFs of u_r.
        u_a_m_s: Along-track speed in m/s where it is known a priori, None to estimate it.
    """

    def __init__(
        self,
        radar: BistaticRadar,
        aperture: Aperture,
        range_m: float | None = None,
        search: Search | None = None,
        u_a_m_s: float | None = None,
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.search, self.u_a_m_s = search, u_a_m_s

    def forward(self, signal: Signal) -> Estimate:
        """Estimate u_r, u_a and y0 from channels with the axes (channel, pulse[, range]).

        Raises:
            ValueError: As in `moving_point_velocity` and `Interferometry.forward`.
        """
        data, range_m = self.line(signal)
        found = moving_point_velocity(data, self.radar, self.aperture, self.search, self.u_a_m_s, range_m)
        if self.search is None or self.search.u_r_m_s >= self.radar.ambiguous_velocity_m_s:
            return found
        there = motion_from(self.radar, data, found["u_r_m_s"], found["u_a_m_s"], found["y0_m"], range_m)
        return warned_of_ambiguity(found, data, self.radar, there, self.aperture)
