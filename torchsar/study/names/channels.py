"""Factories that build the stages of `torchsar.multichannel` from plain keys of a config."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from torchsar.core import Alternate, Turn
from torchsar.multichannel import (
    AlongTrackAutofocus,
    CorrectMigration,
    Detector,
    Dwell,
    ElementBeam,
    ElementPattern,
    EstimateBalance,
    Extraction,
    FlatBand,
    GradientVelocity,
    Interferometry,
    Keystone,
    LeastSquares,
    LikelihoodVelocity,
    MigratingLines,
    MinimumMeanSquare,
    MovingPointVelocity,
    NoMigration,
    Reconstruct,
    Search,
    SignalIntensityRatio,
    StaticBulk,
    StationaryImage,
)
from torchsar.multichannel.scene_image import MoversImage
from torchsar.radar import BistaticRadar

Unknown = Literal["u_r_m_s", "u_a_m_s", "y0_m"]
Method = Literal["least_squares", "mmse"]


def _aperture(dwell_s: float | None) -> Dwell | ElementBeam:
    return ElementBeam() if dwell_s is None else Dwell(dwell_s)


def _prior(band_hz: float | None) -> FlatBand | ElementPattern:
    return ElementPattern() if band_hz is None else FlatBand(band_hz)


def _rebuild(
    bands: int, method: Method, band_hz: float | None = None, snr_db: float = 40.0
) -> LeastSquares | MinimumMeanSquare:
    return LeastSquares(bands) if method == "least_squares" else MinimumMeanSquare(bands, snr_db, _prior(band_hz))


def migration_correct(
    radar: BistaticRadar,
    kind: Literal["keystone", "static_bulk", "none"] = "keystone",
    whole_swath: bool = True,
    range_m: float | None = None,
) -> CorrectMigration:
    """Correction of range migration in the data of several channels.

    Args:
        kind: "keystone" for deramp, keystone transform and reramp; "static_bulk" for a shift of
            each pulse along range; "none" for no correction.
        whole_swath: Whether the correction varies with the range over the swath.
        range_m: Closest range of the reference point in m; None for the reference range of the
            radar.
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
    """Reconstruction of the full Doppler band from the channels, for a target of given velocities.

    Args:
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        band_hz: Width in Hz of the flat Doppler spectrum that "mmse" assumes; None for the spectrum
            that the antenna pattern of the channels gives.
        snr_db: Signal-to-noise ratio that "mmse" assumes, in dB.
        range_m: Closest range of the targets in m; None for the reference range of the radar.
    """
    return Reconstruct(radar, _rebuild(bands, method, band_hz, snr_db), range_m)


def channel_balance(
    radar: BistaticRadar,
    band_hz: float | None = None,
    bands: int | None = None,
    delays: bool = True,
    assess: bool = True,
) -> EstimateBalance:
    """Estimator of phase, gain and delay errors of the channels from stationary clutter.

    Args:
        band_hz: Width in Hz of the flat Doppler spectrum of the clutter; None for the spectrum that
            the antenna pattern of the channels gives.
        bands: Number of Doppler bands of the clutter, each as wide as the PRF; None for all in
            which a stationary scene has echoes.
        delays: Whether delays are estimated as well.
        assess: Whether the outcome is assessed.
    """
    return EstimateBalance(radar, _prior(band_hz), bands, delays, assess=assess)


def interferometry(
    radar: BistaticRadar, dwell_s: float | None = None, range_m: float | None = None, assess: bool = True
) -> Interferometry:
    """Estimator of the slant-range speed u_r of a target by along-track interferometry, for a given
    along-track speed u_a.

    Args:
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    return Interferometry(radar, _aperture(dwell_s), range_m, assess=assess)


def along_track_autofocus(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    half_m_s: float = 20.0,
    range_m: float | None = None,
    assess: bool = True,
) -> AlongTrackAutofocus:
    """Estimator of the along-track speed u_a of a target. Deramping for the true speed turns the
    echo into a tone; the estimate is the speed that gives the strongest tone.

    Args:
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        half_m_s: Half width of the search interval of u_a about 0, in m/s.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    return AlongTrackAutofocus(radar, _aperture(dwell_s), range_m, half_m_s, assess=assess)


def likelihood_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
    assess: bool = True,
) -> LikelihoodVelocity:
    """Maximum-likelihood estimator of the motion of a target by Gauss-Newton steps from given
    initial values.

    Args:
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        unknowns: Quantities to estimate, any of u_r_m_s (slant-range speed), u_a_m_s (along-track
            speed) and y0_m (along-track position). Quantities that are not listed keep their given
            values.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    return LikelihoodVelocity(radar, _aperture(dwell_s), range_m, unknowns, assess=assess)


def gradient_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    unknowns: tuple[Unknown, ...] = ("u_r_m_s", "u_a_m_s", "y0_m"),
    range_m: float | None = None,
    assess: bool = True,
) -> GradientVelocity:
    """Maximum-likelihood estimator of the motion of a target by gradient descent from given initial
    values.

    Args:
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        unknowns: Quantities to estimate, any of u_r_m_s (slant-range speed), u_a_m_s (along-track
            speed) and y0_m (along-track position). Quantities that are not listed keep their given
            values.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    return GradientVelocity(radar, _aperture(dwell_s), range_m, unknowns, assess=assess)


def moving_point_velocity(
    radar: BistaticRadar,
    dwell_s: float | None = None,
    u_r_reach_m_s: float | None = None,
    u_a_reach_m_s: float = 20.0,
    y0_reach_m: float = 150.0,
    u_a_m_s: float | None = None,
    range_m: float | None = None,
    assess: bool = True,
) -> MigratingLines:
    """Recommended estimator of velocity and position of a moving target. It needs no initial
    values, only the limits of the search.

    Args:
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        u_r_reach_m_s: Half width of the search in the slant-range speed in m/s; None for 1.5 times
            the ambiguous velocity of the radar.
        u_a_reach_m_s: Half width of the search in the along-track speed in m/s.
        y0_reach_m: Half width of the search in the along-track position in m.
        u_a_m_s: Along-track speed in m/s if it is known a priori; None to estimate it.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    reach = 1.5 * radar.ambiguous_velocity_m_s if u_r_reach_m_s is None else u_r_reach_m_s
    search = Search(reach, u_a_reach_m_s, y0_reach_m)
    estimator = MovingPointVelocity(radar, _aperture(dwell_s), range_m, search, u_a_m_s, assess=assess)
    return MigratingLines(radar, estimator, assess=assess)


def intensity_ratio(
    radar: BistaticRadar,
    bandwidth_hz: float,
    bands: int = 3,
    method: Method = "least_squares",
    search_m_s: tuple[float, float] | None = None,
    step_m_s: float = 0.5,
    range_m: float | None = None,
    assess: bool = True,
) -> SignalIntensityRatio:
    """Estimator of the slant-range speed u_r of a target by the signal intensity ratio. This is the
    intensity of the rebuilt spectrum inside the processed Doppler band over that outside; it is
    largest if the spectrum is rebuilt for the true speed.

    Args:
        bandwidth_hz: Width of the processed Doppler band in Hz.
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        search_m_s: Least and largest speed of the search in m/s; None for all unambiguous speeds.
        step_m_s: Step of the search in m/s.
        range_m: Closest range of the targets in m; None for the reference range of the radar.
        assess: Whether the outcome is assessed.
    """
    rebuild = _rebuild(bands, method)
    return SignalIntensityRatio(radar, bandwidth_hz, rebuild, search_m_s, step_m_s, range_m, assess=assess)


def alternate_velocity(
    radar: BistaticRadar,
    bandwidth_hz: float,
    dwell_s: float | None = None,
    bands: int = 3,
    method: Method = "least_squares",
    rounds: int = 2,
    step_m_s: float = 0.5,
    half_m_s: float = 20.0,
    assess: bool = True,
) -> MigratingLines:
    """Alternate estimation of the slant-range speed u_r of a target by the signal intensity ratio,
    and of its along-track speed u_a by autofocus.

    Args:
        bandwidth_hz: Width of the processed Doppler band in Hz.
        dwell_s: Time in s for which a target is illuminated; None for illumination by the antenna
            pattern of the channels.
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        rounds: Number of rounds; each round estimates u_r and then u_a.
        step_m_s: Step of the search for u_r in m/s.
        half_m_s: Half width of the search interval of u_a about 0, in m/s.
        assess: Whether the outcome is assessed.

    Reference:
        Remote Sens. 2020, 12, 1703, section 4.3.
    """
    ratio = intensity_ratio(radar, bandwidth_hz, bands, method, step_m_s=step_m_s, assess=assess)
    autofocus = along_track_autofocus(radar, dwell_s, half_m_s, assess=assess)
    made = Alternate(rounds, u_r=Turn(ratio), u_a=Turn(autofocus))
    made.works_on, made.also_on = autofocus.works_on, autofocus.also_on
    return MigratingLines(radar, made, one_line=True, assess=assess)


def stationary_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    form: Literal["stolt", "bulk"] = "stolt",
) -> StationaryImage:
    """Image focused for a stationary scene; moving targets are defocused and displaced in it.

    Args:
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        band_hz: Width in Hz of the flat Doppler spectrum that "mmse" assumes; None for the spectrum
            that the antenna pattern of the channels gives.
        snr_db: Signal-to-noise ratio that "mmse" assumes, in dB.
        form: "stolt", exact at every range, or "bulk", which corrects all ranges for the range
            migration of the middle of the swath.
    """
    return StationaryImage(radar, _rebuild(bands, method, band_hz, snr_db), form)


def movers_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Method = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    removal: Literal["subtract", "zero"] = "subtract",
    integration_s: float = 4.5,
    segment_s: float = 0.6,
    half_along_m: float = 120.0,
    half_range_m: float = 60.0,
    threshold_db: float = 10.0,
    most: int = 8,
    u_a_reach_m_s: float = 20.0,
    suppressed_m_s: Sequence[float] = Detector().suppressed_m_s,
    assess: bool = True,
) -> MoversImage:
    """Image of a scene with its moving targets focused at their true positions, and estimates of
    their motion.

    Args:
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        band_hz: Width in Hz of the flat Doppler spectrum that "mmse" assumes; None for the spectrum
            that the antenna pattern of the channels gives.
        snr_db: Signal-to-noise ratio that "mmse" assumes, in dB.
        removal: "subtract" removes the echo fitted to a target; "zero" removes all data in the area
            of the target, including the sea.
        integration_s: Time in s for which a scatterer is illuminated.
        segment_s: Length in s of the segments of slow time in which the sea about a target is
            suppressed.
        half_along_m: Half width of a target along track in m.
        half_range_m: Half width of a target in range in m.
        threshold_db: Least contrast of a target in dB: the mean intensity of a small rectangle of
            pixels over the median of all such means.
        most: Largest number of targets.
        u_a_reach_m_s: Half width of the search in the along-track speed in m/s.
        suppressed_m_s: Slant-range speeds in m/s for a further image in which the sea is
            suppressed, so that weaker targets are detected; empty to omit this image.
        assess: Whether the outcome is assessed.

    Reference:
        Remote Sens. 2020, 12, 1703, Fig. 13.
    """
    extraction = Extraction(half_along_m, half_range_m, integration_s, segment_s)
    detector = Detector(threshold_db, most=most, suppressed_m_s=suppressed_m_s)
    rebuild = _rebuild(bands, method, band_hz, snr_db)
    return MoversImage(radar, rebuild, removal, extraction, detector, u_a_reach_m_s, assess=assess)
