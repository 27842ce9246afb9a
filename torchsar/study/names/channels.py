"""Stages of `torchsar.multichannel` from plain keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from torchsar.core import Alternate, Turn
from torchsar.multichannel.balance import EstimateBalance
from torchsar.multichannel.body import Extraction
from torchsar.multichannel.migration import CorrectMigration, Keystone, NoMigration, StaticBulk
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.response import ElementPattern, FlatBand, LeastSquares, MinimumMeanSquare, Prior, Rebuild
from torchsar.multichannel.scene_image import Detector, MoversImage, Removal
from torchsar.multichannel.stationary import StationaryImage
from torchsar.multichannel.velocity.aperture import Aperture, Dwell, ElementBeam
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.migrating import MigratingLines
from torchsar.multichannel.velocity.sir import SignalIntensityRatio
from torchsar.multichannel.velocity.stages import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
)
from torchsar.radar import BistaticRadar

Unknown = Literal["u_r_m_s", "u_a_m_s", "y0_m"]
Method = Literal["least_squares", "mmse"]


def _aperture(dwell_s: float | None) -> Aperture:
    return ElementBeam() if dwell_s is None else Dwell(dwell_s)


def _prior(band_hz: float | None) -> Prior:
    return ElementPattern() if band_hz is None else FlatBand(band_hz)


def _rebuild(bands: int, method: Method, band_hz: float | None = None, snr_db: float = 40.0) -> Rebuild:
    return LeastSquares(bands) if method == "least_squares" else MinimumMeanSquare(bands, snr_db, _prior(band_hz))


def migration_correct(
    radar: BistaticRadar,
    kind: Literal["keystone", "static_bulk", "none"] = "keystone",
    whole_swath: bool = True,
    range_m: float | None = None,
) -> CorrectMigration:
    """Range migration corrected by deramp, keystone and reramp, by a shift of each pulse, or not at
    all.

    Args:
        kind: "keystone", "static_bulk", or "none" for no correction.
        whole_swath: Whether the correction follows the range over the swath.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    kinds = {"keystone": Keystone(whole_swath), "static_bulk": StaticBulk(whole_swath), "none": NoMigration()}
    return CorrectMigration(radar, kinds[kind], range_m)


def rebuild_bands(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    range_m: float | None = None,
) -> Reconstruct:
    """Channels to the full Doppler band of the velocities given; mmse expects power in a flat band
    of band_hz, or by the pattern of the elements (null).

    Args:
        bands: Doppler bands of one PRF that are separated.
        method: "least_squares", or "mmse" where an inverse may be singular.
        band_hz: Doppler band in which mmse expects power; None for the pattern.
        snr_db: Signal-to-noise ratio that mmse expects, in dB.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    return Reconstruct(radar, _rebuild(bands, method, band_hz, snr_db), range_m)


def channel_balance(
    radar: BistaticRadar, band_hz: float | None = None, bands: int = 5, delays: bool = True
) -> EstimateBalance:
    """Phase, gain and delay of channels from clutter at rest in a flat band of band_hz, or seen
    through the pattern of the elements (null).

    Args:
        band_hz: Flat Doppler band of the clutter; None for the pattern of the elements.
        bands: Doppler bands of one PRF in the clutter.
        delays: Whether delays are estimated as well.
    """
    return EstimateBalance(radar, _prior(band_hz), bands, delays)


def interferometry(radar: BistaticRadar, dwell_s: float | None = None, range_m: float | None = None) -> Interferometry:
    """Along-track interferometry, u_a as given.

    dwell_s: how long targets are seen, null for the pattern of the elements.

    Args:
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    return Interferometry(radar, _aperture(dwell_s), range_m)


def along_track_autofocus(
    radar: BistaticRadar, dwell_s: float | None = None, half_m_s: float = 20.0, range_m: float | None = None
) -> AlongTrackAutofocus:
    """u_a by the power of the deramped tone within +-half_m_s.

    Args:
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        half_m_s: Half of the interval in which u_a is sought, in m/s.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    return AlongTrackAutofocus(radar, _aperture(dwell_s), range_m, half_m_s)


def likelihood_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
) -> LikelihoodVelocity:
    """Maximum likelihood of the unknowns near the values given, by Gauss-Newton steps.

    Args:
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        unknowns: What is estimated; the rest is held.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    return LikelihoodVelocity(radar, _aperture(dwell_s), range_m, unknowns)


def gradient_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
) -> GradientVelocity:
    """Maximum likelihood of the unknowns near the values given, by a descent on autograd's
    gradients.

    Args:
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        unknowns: What is estimated; the rest is held.
        range_m: Closest range of data without a range axis; None for the radar's.
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
) -> MigratingLines:
    """The recommended estimator of velocity and position; only how far to search is known.

    Args:
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        u_r_reach_m_s: How far u_r is sought in m/s; None for three pulse rates.
        u_a_reach_m_s: How far u_a is sought in m/s.
        y0_reach_m: How far the position is sought in metres.
        u_a_m_s: u_a in m/s where it is known.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    reach = 1.5 * radar.ambiguous_velocity_m_s if u_r_reach_m_s is None else u_r_reach_m_s
    return MigratingLines(
        radar,
        MovingPointVelocity(radar, _aperture(dwell_s), range_m, Search(reach, u_a_reach_m_s, y0_reach_m), u_a_m_s),
    )


def intensity_ratio(
    radar: BistaticRadar,
    bandwidth_hz: float,
    bands: int = 3,
    method: Method = "least_squares",
    search_m_s: tuple[float, float] | None = None,
    step_m_s: float = 0.5,
    range_m: float | None = None,
) -> SignalIntensityRatio:
    """u_r by the signal intensity ratio of the paper.

    search_m_s: least and largest velocity, null for all that is unambiguous; mmse serves where an
    inverse is singular.

    Args:
        bandwidth_hz: Doppler bandwidth of the target in Hz.
        bands: Doppler bands of one PRF that are separated.
        method: "least_squares", or "mmse" where an inverse may be singular.
        search_m_s: Least and largest velocity; None for all that is unambiguous.
        step_m_s: Step of the search in m/s.
        range_m: Closest range of data without a range axis; None for the radar's.
    """
    rebuild = _rebuild(bands, method)
    return SignalIntensityRatio(radar, bandwidth_hz, rebuild, search_m_s, step_m_s, range_m)


def alternate_velocity(
    radar: BistaticRadar,
    bandwidth_hz: float,
    dwell_s: float | None = None,
    bands: int = 3,
    method: Method = "least_squares",
    rounds: int = 2,
    step_m_s: float = 0.5,
    half_m_s: float = 20.0,
) -> MigratingLines:
    """u_r by the signal intensity ratio and u_a by autofocus in turn, as the paper does (Remote
    Sens. 2020, 12, 1703, section 4.3); mmse where an inverse may be singular.

    Args:
        bandwidth_hz: Doppler bandwidth of the target in Hz.
        dwell_s: How long targets are seen, in s; None for the pattern of the elements.
        bands: Doppler bands of one PRF that are separated.
        method: "least_squares", or "mmse" where an inverse may be singular.
        rounds: How often both are estimated.
        step_m_s: Step of the search for u_r in m/s.
        half_m_s: Half of the interval in which u_a is sought, in m/s.
    """
    ratio, autofocus = (
        intensity_ratio(radar, bandwidth_hz, bands, method, step_m_s=step_m_s),
        along_track_autofocus(radar, dwell_s, half_m_s),
    )
    made = Alternate(rounds, u_r=Turn(ratio), u_a=Turn(autofocus))
    made.works_on, made.also_on = autofocus.works_on, autofocus.also_on
    return MigratingLines(radar, made, one_line=True)


def stationary_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    form: Literal["stolt", "bulk"] = "stolt",
) -> StationaryImage:
    """The image of everything as if at rest; mmse expects power in a flat band of band_hz, or by
    the pattern of the elements (null).
    """
    return StationaryImage(radar, _rebuild(bands, method, band_hz, snr_db), form)


def movers_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    removal: Removal = "subtract",
    integration_s: float = 4.5,
    segment_s: float = 0.6,
    half_along_m: float = 120.0,
    half_range_m: float = 60.0,
    threshold_db: float = 10.0,
    most: int = 8,
    u_a_reach_m_s: float = 20.0,
    suppressed_m_s: Sequence[float] = Detector().suppressed_m_s,
) -> MoversImage:
    """The flow of Remote Sens. 2020, 12, 1703, Fig. 13: the image of every frame with moving
    targets at their positions, and what they are.
    """
    extraction = Extraction(half_along_m, half_range_m, integration_s, segment_s)
    detector = Detector(threshold_db, most=most, suppressed_m_s=suppressed_m_s)
    rebuild = _rebuild(bands, method, band_hz, snr_db)
    return MoversImage(radar, rebuild, removal, extraction, detector, u_a_reach_m_s)
