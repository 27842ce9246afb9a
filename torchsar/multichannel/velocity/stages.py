"""Estimators of a moving point's velocity as stages on (channel, pulse) or, on the strongest line
of each trial, (channel, pulse, range) signals.
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

_LEAST_PULSES = 4


def strongest_line(data: Tensor) -> tuple[Tensor, Tensor]:
    """The range line of most energy of each trial, (..., channel, pulse), and its index (...,).

    data: (..., channel, pulse, range), migration corrected.
    """
    index = data.detach().abs().square().sum((-3, -2)).argmax(-1)
    return take(data.movedim(-1, -3), index, -3), index


class _Velocity(Stage):
    """An estimator on one line.

    radar, aperture (expected amplitude over slow time), range_m: closest range of the points, None
    for the line's own, else the reference range.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    provides = UNKNOWNS

    def __init__(self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None) -> None:
        super().__init__()
        self.radar, self.aperture, self.range_m = radar, aperture, range_m

    def line(self, signal: Signal) -> tuple[Tensor, Tensor | float | None]:
        """The data (..., channel, pulse) to work on, and the closest range of their points.

        Raises ValueError for other channels than the radar's, shifted slow time and too few pulses.
        """
        refuse_shifted(self.radar, signal.axis("pulse"))
        channels, pulses = signal.axes[0].n, signal.axes[1].n
        if channels != self.radar.channels or pulses < _LEAST_PULSES:
            raise ValueError(
                f"{type(self).__name__} expects {self.radar.channels} channels by the radar's "
                f"channel_m and at least {_LEAST_PULSES} pulses, got {channels} and {pulses}; select "
                "the channels of both"
            )
        if "range" not in signal.names:
            return signal.data, self.range_m
        data, index = strongest_line(signal.data)
        near = signal.axis("range")
        return data, near.start + near.step * index.to(torch.float64) if self.range_m is None else self.range_m

    def begin(
        self, signal: Signal, u_r_m_s: Number, u_a_m_s: Number, y0_m: Number
    ) -> tuple[Tensor, BistaticRadar, PointMotion, Aperture]:
        """What estimators near a start take first: data, radar, start, aperture."""
        data, range_m = self.line(signal)
        return data, self.radar, motion_from(self.radar, data, u_r_m_s, u_a_m_s, y0_m, range_m), self.aperture


class Interferometry(_Velocity):
    """Along-track interferometry (see `interferometry`), u_a as given.

    mind_ambiguity: warn, and say not ok, where the velocity lies whole pulse rates off (some 10 ms
    a trial).
    """

    def __init__(
        self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None, mind_ambiguity: bool = True
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.mind_ambiguity = mind_ambiguity

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        data, radar, start, aperture = self.begin(signal, u_r_m_s, u_a_m_s, y0_m)
        found = interferometry(data, radar, start, aperture)
        there = replace(start, u_r_m_s=found["u_r_m_s"], y0_m=found["y0_m"])
        return warned_of_ambiguity(found, data, radar, there, aperture) if self.mind_ambiguity else found


class AlongTrackAutofocus(_Velocity):
    """Along-track velocity by the power of the deramped tone (see `along_track_velocity`); u_r and
    y0 as given. half_m_s: half width of the search about u_a = 0.
    """

    provides = ("u_a_m_s",)

    def __init__(
        self, radar: BistaticRadar, aperture: Aperture, range_m: float | None = None, half_m_s: float = 20.0
    ) -> None:
        super().__init__(radar, aperture, range_m)
        self.half_m_s = half_m_s

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        return along_track_velocity(*self.begin(signal, u_r_m_s, 0.0, y0_m), self.half_m_s)


class LikelihoodVelocity(_Velocity):
    """Maximum likelihood near the values given (see `maximum_likelihood`).

    unknowns: what is estimated of u_r_m_s, u_a_m_s, y0_m.
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
        found = maximum_likelihood(*self.begin(signal, u_r_m_s, u_a_m_s, y0_m), self.unknowns)
        return estimate_of(found, found.snr_db >= DETECTED_DB, ((found.snr_db - DETECTED_DB) / 3).sigmoid())


class GradientVelocity(_Velocity):
    """The same by a descent on autograd's gradients (see `gradient_likelihood`)."""

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
        return gradient_likelihood(*self.begin(signal, u_r_m_s, u_a_m_s, y0_m), self.unknowns)


class MovingPointVelocity(_Velocity):
    """The recommended estimator (see `moving_point_velocity`).

    search: what its bank covers (where that is less than one pulse rate of u_r, velocities that lie
    beyond are warned of); u_a_m_s: the along-track velocity where it is known, None to estimate it.
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
        data, range_m = self.line(signal)
        found = moving_point_velocity(data, self.radar, self.aperture, self.search, self.u_a_m_s, range_m)
        if self.search is None or self.search.u_r_m_s >= self.radar.ambiguous_velocity_m_s:
            return found
        there = motion_from(self.radar, data, found["u_r_m_s"], found["u_a_m_s"], found["y0_m"], range_m)
        return warned_of_ambiguity(found, data, self.radar, there, self.aperture)
