"""Limits of velocity estimators and errors of simplified echo models for a triangular ladar.

`ladar_limits` lists where the estimators fail. `ladar_requirements` lists the phase that each
simplification of the model neglects. The two functions need the radar and bounds of the motion, but
no simulation.
"""

from __future__ import annotations

import math

from torchsar.focus.requirements import Limit, Requirement, refuse_numbers
from torchsar.radar import TriangularLadar


def ladar_limits(
    radar: TriangularLadar,
    n_period: int,
    ranges_m: tuple[float, float],
    speed_m_s: float = 0.0,
    acceleration_m_s2: float = 0.0,
    jerk_m_s3: float = 0.0,
    snr_db: float | None = None,
    azimuth_extent_m: float = 0.0,
    spacing_m: float | None = None,
    lit_share: float = 1.0,
) -> tuple[Limit, ...]:
    """List the limits of the velocity estimators of a triangular ladar for motion within bounds.

    >>> from torchsar import focus, radar
    >>> ladar = radar.TriangularLadar(carrier_hz=193.4e12, bandwidth_hz=5e9, period_s=16e-6,
    ...     sample_rate_hz=4e6, speed_m_s=60.0, reference_range_m=3000.0)
    >>> rows = focus.ladar_limits(ladar, 4096, ranges_m=(-0.1, 0.1), speed_m_s=1.0, snr_db=0.0)
    >>> [(row.name, row.verdict) for row in rows if not row.ok]
    [('speed of the mirror tone', 'refuse'), ('accumulated phase error', 'warn')]

    Limits that need `snr_db` or `spacing_m` are left out where these are None. The bias of each
    velocity estimate due to jerk, jerk x period^2 / 27, is compared with the standard deviation of
    the estimate due to noise, or with 1 mm/s where `snr_db` is None. With a period of 16 us, a
    vibration of 10 um at 5 kHz gives a bias of 2 mm/s rms.

    Args:
        radar: Radar of the recording.
        n_period: Number of recorded periods.
        ranges_m: Least and largest range of scatterers relative to the reference, in metres.
        speed_m_s: Largest absolute radial velocity in m/s.
        acceleration_m_s2: Largest absolute radial acceleration in m/s^2.
        jerk_m_s3: Largest absolute radial jerk in m/s^3.
        snr_db: Signal-to-noise ratio of a sample before compression in dB.
        azimuth_extent_m: Extent of the scatterers in azimuth, in metres.
        spacing_m: Least distance in range between scatterers of the same range gate, in metres.
        lit_share: Share of the periods, 0 to 1, in which a reference scatterer is illuminated.

    Returns:
        One row per limit.

    Raises:
        ValueError: If a number is not finite, a number other than a range is negative, or
            `ranges_m` are out of order.

    Reference:
        Remote Sens. 2024, 16, 793, for the estimators.
    """
    near, far = ranges_m
    refuse_numbers(-math.inf, **{"ranges_m[0]": near, "ranges_m[1]": far})
    refuse_numbers(
        0,
        n_period=n_period,
        speed_m_s=speed_m_s,
        acceleration_m_s2=acceleration_m_s2,
        jerk_m_s3=jerk_m_s3,
        azimuth_extent_m=azimuth_extent_m,
        lit_share=lit_share,
    )
    if near > far:
        raise ValueError(f"ranges_m must be (least, largest) relative range in metres, in this order, got {ranges_m}")
    half, per_hz, sweep = radar.sample_rate_hz / 2, radar.wavelength_m / 2, radar.sweep_s
    high = radar.beat_hz(max(abs(near), abs(far)))
    low = radar.beat_hz(min(abs(near), abs(far))) if near * far > 0 else 0.0
    std = None if snr_db is None else _segmented_std_m_s(radar, snr_db)
    rows = [
        Limit(
            "speed in the beat band",
            speed_m_s,
            per_hz * (half - high),
            "m/s",
            "refuse",
            "beats beyond half the sampling rate alias",
            "raise the sampling rate or bring the reference range nearer",
        ),
        Limit(
            "speed with real detection",
            speed_m_s,
            per_hz * low,
            "m/s",
            "refuse",
            "a beat folds at zero frequency and loses its sign",
            "move the reference away from the scene or detect both quadratures",
        ),
        Limit(
            "speed of the mirror tone",
            speed_m_s,
            per_hz * half / 2,
            "m/s",
            "refuse",
            "the tone 2 fd of the mirror product aliases",
            "demodulate by a coarse velocity first",
        ),
        Limit(
            "acceleration of the gradient",
            acceleration_m_s2,
            radar.wavelength_m / (4 * sweep * radar.pulse_step_s),
            "m/s^2",
            "warn",
            "the phase of half sweeps wraps from period to period",
            "determine the ambiguity integer of each period separately",
        ),
        Limit(
            "velocity bias by jerk",
            jerk_m_s3 * radar.period_s**2 / 27,
            1e-3 if std is None else std,
            "m/s",
            "warn",
            "vibration inside a period biases every velocity",
            "shorten the period: the bandwidth of the motion must stay well under its inverse",
        ),
        Limit(
            "acceleration within a sweep",
            acceleration_m_s2,
            radar.wavelength_m / (2 * sweep**2),
            "m/s^2",
            "warn",
            "the beat smears over a range cell",
            "add a quadratic term or shorten the sweep",
        ),
        Limit(
            "share of periods with a lit reference",
            lit_share,
            1.0,
            "",
            "warn",
            "velocity is undefined in the others",
            "mark those as not estimated",
            at_least=True,
        ),
    ]
    if radar.detection != "real":
        del rows[1]
    if radar.beam_rad is not None:
        row = Limit(
            "azimuth extent in a narrow beam",
            azimuth_extent_m,
            radar.wavelength_m / (2 * radar.beam_rad),
            "m",
            "warn",
            "the mean azimuth of the illuminated scatterers drifts as they enter and leave the beam, and is "
            "estimated as motion",
            "combine scatterers by phase gradients, or refine the phase (PhasePolish)",
        )
        rows.append(row)
    if spacing_m is not None:
        row = Limit(
            "spacing of scatterers",
            spacing_m,
            radar.wave_speed_m_s / radar.bandwidth_hz,
            "m",
            "refuse",
            "peaks of half sweeps merge: single-peak segmented interference fails",
            "use the mirror product, or sum over range bins",
            at_least=True,
        )
        rows.append(row)
    if snr_db is None or std is None:
        return tuple(rows)
    drift = 2 * math.pi / per_hz * std * radar.pulse_step_s * math.sqrt(n_period / 15)
    return (
        *rows,
        # measured: cycle slips in 1 of 1000 pulses at 13 dB, and none at 14 dB
        Limit(
            "SNR after compression",
            snr_db + 10 * math.log10(radar.sweep_samples),
            14.0,
            "dB",
            "refuse",
            "gradient integration suffers cycle slips",
            "determine the ambiguity integer of each period separately, or gate and average",
            at_least=True,
        ),
        Limit(
            "accumulated phase error",
            drift,
            0.5,
            "rad",
            "warn",
            "integrated velocity errors defocus the image",
            "refine the phase after compensation (PhasePolish)",
        ),
    )


def _segmented_std_m_s(radar: TriangularLadar, snr_db: float) -> float:
    """Standard deviation in m/s of one segmented velocity
    (metrics.velocity_segmented_bound_m_s).
    """
    energy = radar.sweep_samples * 10 ** (snr_db / 10)
    return radar.wavelength_m / 2 * math.sqrt(4 / energy) / (2 * math.pi * radar.sweep_s)


def ladar_requirements(
    radar: TriangularLadar,
    n_period: int,
    ranges_m: tuple[float, float],
    speed_m_s: float = 0.0,
    acceleration_m_s2: float = 0.0,
    displacement_m: float | None = None,
    tolerance_rad: float = 0.1,
) -> tuple[Requirement, ...]:
    """List the largest phase that each simplification neglects for a triangular ladar.

    >>> from torchsar import focus, radar
    >>> ladar = radar.TriangularLadar(carrier_hz=193.4e12, bandwidth_hz=5e9, period_s=16e-6,
    ...     sample_rate_hz=4e6, speed_m_s=60.0, reference_range_m=3000.0)
    >>> rows = focus.ladar_requirements(ladar, 4096, ranges_m=(-0.1, 0.1), speed_m_s=0.1)
    >>> [row.effect for row in rows if not row.ok]  # what may not be neglected
    ['one range per sweep', 'one range per period', 'carrier for f(u) in compensation']

    The simplifications are those of the echo model, such as one range per sweep, and those of the
    motion compensation. Two errors are given for the whole record: that of ignoring the flight
    time, and that of compensating the whole band with the phase of the carrier.

    Args:
        radar: Radar of the recording.
        n_period: Number of recorded periods.
        ranges_m: Least and largest range of scatterers relative to the reference, in metres.
        speed_m_s: Largest absolute radial velocity in m/s.
        acceleration_m_s2: Largest absolute radial acceleration in m/s^2.
        displacement_m: Change of range over the record in metres; None for speed times duration of
            the record.
        tolerance_rad: Tolerated phase in rad.

    Returns:
        One `Requirement` per simplification: what it neglects, the error and the remedy.

    Raises:
        ValueError: If `n_period`, the speed, the acceleration or the tolerance is negative or not
            finite.
    """
    near, far = ranges_m
    refuse_numbers(
        0,
        n_period=n_period,
        speed_m_s=speed_m_s,
        acceleration_m_s2=acceleration_m_s2,
        tolerance_rad=tolerance_rad,
    )
    record_s = n_period * radar.pulse_step_s
    travel = speed_m_s * record_s if displacement_m is None else displacement_m
    per_m, c, sweep, cell = 4 * math.pi / radar.wavelength_m, radar.wave_speed_m_s, radar.sweep_s, radar.range_step_m
    bend = per_m * acceleration_m_s2 * sweep**2 / 8 + math.pi * radar.chirp_rate_hz_s * speed_m_s * sweep**2 / c
    closest, farthest = 0.0 if near * far < 0 else min(abs(near), abs(far)), max(abs(near), abs(far))
    video = 2 * math.pi * radar.chirp_rate_hz_s * ((2 * farthest / c) ** 2 - (2 * closest / c) ** 2)
    late = acceleration_m_s2 * radar.reference_range_m / c
    band = 2 * math.pi * radar.bandwidth_hz * travel / c
    # Fourth-order term of the range history, pi X^4 / (2 lambda R^3), at the end X of the aperture
    # in the beam, or of the record if that is shorter.
    reach = radar.speed_m_s * record_s / 2
    if radar.beam_rad is not None:
        reach = min(reach, radar.reference_range_m * radar.beam_rad / 2)
    hyperbola = math.pi * reach**4 / (2 * radar.wavelength_m * radar.reference_range_m**3)
    within_sweep = "form the range at every sample, or with a Doppler linear in the sweep"

    def row(
        effect: str, neglects: str, phase_rad: float, range_cells: float, remedy: str, tolerance: float = tolerance_rad
    ) -> Requirement:
        return Requirement(effect, neglects, phase_rad, range_cells, tolerance, remedy)

    return (
        row(
            "Doppler linear in the sweep",
            "acceleration and envelope motion inside a sweep",
            bend,
            math.nan,
            "form the range at every sample",
        ),
        row(
            "one range per sweep",
            "Doppler inside a sweep, which shows the velocity",
            per_m * speed_m_s * sweep / 2,
            speed_m_s / radar.wavelength_m * 2 * sweep,
            within_sweep,
        ),
        row(
            "one range per period",
            "Doppler inside a period, phase between up and down",
            per_m * speed_m_s * sweep,
            speed_m_s / radar.wavelength_m * 2 * sweep,
            within_sweep,
        ),
        row(
            "no residual video phase",
            "2 pi K (dtau1^2 - dtau2^2) between up and down over the gate",
            video,
            math.nan,
            "keep it in the echo and filter it out",
        ),
        row(
            "parabola for hyperbola",
            "fourth order of the range history",
            hyperbola,
            math.nan,
            "keep the hyperbola",
        ),
        row(
            "flight time ignored",
            "reflection at t - tau / 2 over the record (a constant acceleration)",
            per_m * late * record_s / 2,
            math.nan,
            "shift the time axis of the motion by tau / 2",
        ),
        row(
            "carrier for f(u) in compensation",
            "envelope motion over the record",
            band,
            travel / cell,
            "compensate every sample with f(u)",
            math.pi * 0.1,
        ),
    )
