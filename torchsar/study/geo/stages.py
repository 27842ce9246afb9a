"""Stages of `torchsar.multichannel` from plain keys."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from torchsar.core import Alternate, Estimate, Signal, Stage, Turn
from torchsar.multichannel.balance import EstimateBalance
from torchsar.multichannel.migration import CorrectMigration, Keystone, NoMigration, StaticBulk
from torchsar.multichannel.motion import Number
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.response import ElementPattern, FlatBand, LeastSquares, MinimumMeanSquare, Prior
from torchsar.multichannel.velocity.aperture import Aperture, Dwell, ElementBeam
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.sir import SignalIntensityRatio
from torchsar.multichannel.velocity.stages import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
    strongest_line,
)
from torchsar.multichannel.velocity.walk import WalkAmbiguity
from torchsar.radar import BistaticRadar

Unknown = Literal["u_r_m_s", "u_a_m_s", "y0_m"]


def _aperture(dwell_s: float | None) -> Aperture:
    return ElementBeam() if dwell_s is None else Dwell(dwell_s)


def _prior(band_hz: float | None) -> Prior:
    return ElementPattern() if band_hz is None else FlatBand(band_hz)


class MigrationOfLines(Stage):
    """Range migration taken out by deramp, keystone and reramp, by a shift of each pulse, or not at
    all; azimuth-only data, which have none, pass.
    """

    works_on = ("channel", "pulse", "range")
    also_on = (("channel", "pulse"),)

    def __init__(
        self,
        radar: BistaticRadar,
        kind: Literal["keystone", "static_bulk", "none"] = "keystone",
        whole_swath: bool = True,
        range_m: float | None = None,
    ) -> None:
        super().__init__()
        kinds = {"keystone": Keystone(whole_swath), "static_bulk": StaticBulk(whole_swath), "none": NoMigration()}
        self.correct = CorrectMigration(radar, kinds[kind], range_m)

    def forward(
        self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0, ambiguity: Number = 0
    ) -> Signal:
        return self.correct(signal, u_r_m_s, u_a_m_s, y0_m, ambiguity) if "range" in signal.names else signal


class Stilled(Stage):
    """An estimator of velocity for lines that still migrate: it takes out the migration of a point
    at rest and the walk of the strongest point for itself, and leaves the signal alone.

    one_line: give the estimator the strongest line only. The migration that the velocity found
    makes is for a later `migration_correct` to take out. Azimuth-only data do not migrate.
    """

    works_on = ("channel", "pulse", "range")
    also_on = (("channel", "pulse"),)

    def __init__(self, radar: BistaticRadar, estimator: Stage, one_line: bool = False) -> None:
        super().__init__()
        self.estimator, self.one_line = estimator, one_line
        self.walk, self.correct = WalkAmbiguity(radar), CorrectMigration(radar, Keystone(whole_swath=False))
        self.provides = estimator.provides

    def forward(self, signal: Signal) -> Estimate:
        if "range" not in signal.names:
            return self.estimator(signal)
        walk = self.walk(signal)
        still = self.correct(signal, ambiguity=walk["ambiguity"])
        if self.one_line:
            still = Signal(strongest_line(still.data)[0], still.axes[:2])
        found = self.estimator(still)
        return replace(
            found,
            ok=found.ok & walk.ok,
            quality=found.quality.minimum(walk.quality),
            info={**found.info, "ambiguity": walk["ambiguity"]},
        )


def rebuild_bands(
    radar: BistaticRadar,
    bands: int = 2,
    method: Literal["least_squares", "mmse"] = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    range_m: float | None = None,
) -> Reconstruct:
    """Channels to the full Doppler band of the velocities given; mmse expects power in a flat band
    of band_hz, or by the pattern of the elements (null).
    """
    rebuild = LeastSquares(bands) if method == "least_squares" else MinimumMeanSquare(bands, snr_db, _prior(band_hz))
    return Reconstruct(radar, rebuild, range_m)


def channel_balance(
    radar: BistaticRadar, band_hz: float | None = None, bands: int = 5, delays: bool = True
) -> EstimateBalance:
    """Phase, gain and delay of channels from clutter at rest in a flat band of band_hz, or seen
    through the pattern of the elements (null).
    """
    return EstimateBalance(radar, _prior(band_hz), bands, delays)


def interferometry(radar: BistaticRadar, dwell_s: float | None = None, range_m: float | None = None) -> Interferometry:
    """Along-track interferometry, u_a as given.

    dwell_s: how long targets are seen, null for the pattern of the elements.
    """
    return Interferometry(radar, _aperture(dwell_s), range_m)


def along_track_autofocus(
    radar: BistaticRadar, dwell_s: float | None = None, half_m_s: float = 20.0, range_m: float | None = None
) -> AlongTrackAutofocus:
    """u_a by the power of the deramped tone within +-half_m_s."""
    return AlongTrackAutofocus(radar, _aperture(dwell_s), range_m, half_m_s)


def likelihood_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
) -> LikelihoodVelocity:
    """Maximum likelihood of the unknowns near the values given, by Gauss-Newton steps."""
    return LikelihoodVelocity(radar, _aperture(dwell_s), range_m, unknowns)


def gradient_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
) -> GradientVelocity:
    """Maximum likelihood of the unknowns near the values given, by a descent on autograd's
    gradients.
    """
    return GradientVelocity(radar, _aperture(dwell_s), range_m, unknowns)


def moving_point_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    u_r_reach_m_s: float | None = None,
    u_a_reach_m_s: float = 20.0,
    y0_reach_m: float = 150.0,
    u_a_m_s: float | None = None,
    range_m: float | None = None,
) -> Stilled:
    """The recommended estimator of velocity and place, told nothing but how far to search (u_r
    null: three pulse rates wide). u_a_m_s: where it is known.
    """
    reach = 1.5 * radar.ambiguous_velocity_m_s if u_r_reach_m_s is None else u_r_reach_m_s
    return Stilled(
        radar,
        MovingPointVelocity(radar, _aperture(dwell_s), range_m, Search(reach, u_a_reach_m_s, y0_reach_m), u_a_m_s),
    )


def intensity_ratio(
    radar: BistaticRadar,
    bandwidth_hz: float,
    bands: int = 3,
    method: Literal["least_squares", "mmse"] = "least_squares",
    search_m_s: tuple[float, float] | None = None,
    step_m_s: float = 0.5,
    range_m: float | None = None,
) -> SignalIntensityRatio:
    """u_r by the signal intensity ratio of the paper.

    search_m_s: least and largest velocity, null for all that is unambiguous; mmse serves where an
    inverse is singular.
    """
    rebuild = LeastSquares(bands) if method == "least_squares" else MinimumMeanSquare(bands)
    return SignalIntensityRatio(radar, bandwidth_hz, rebuild, search_m_s, step_m_s, range_m)


def alternate_velocity(
    radar: BistaticRadar,
    bandwidth_hz: float,
    dwell_s: float | None = None,
    bands: int = 3,
    method: Literal["least_squares", "mmse"] = "least_squares",
    rounds: int = 2,
    step_m_s: float = 0.5,
    half_m_s: float = 20.0,
) -> Stilled:
    """u_r by the signal intensity ratio and u_a by autofocus in turn, as the paper does (Remote
    Sens. 2020, 12, 1703, section 4.3); mmse where an inverse may be singular.
    """
    ratio, autofocus = (
        intensity_ratio(radar, bandwidth_hz, bands, method, step_m_s=step_m_s),
        along_track_autofocus(radar, dwell_s, half_m_s),
    )
    made = Alternate(rounds, u_r=Turn(ratio), u_a=Turn(autofocus))
    made.works_on, made.also_on = autofocus.works_on, autofocus.also_on
    return Stilled(radar, made, one_line=True)
