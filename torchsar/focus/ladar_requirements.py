"""Limits of velocity estimators and errors of simplified echo models for a triangular ladar.

`ladar_limits` lists where the estimators fail. `ladar_requirements` lists the phase that each
simplification of the model neglects. The two functions need the radar and bounds of the motion, but
no simulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from torchsar.focus.requirements import Requirement
from torchsar.radar import TriangularLadar

# SNR after compression for gradient integration; measured: cycle slips in 1 of 1000 pulses at 13
# dB, none at 14 dB
GRADIENT_SNR_DB = 14.0
# chosen limits: accumulated phase of integrated velocities, phase neglected by a simplification of
# the echo (rad), and envelope motion neglected in compensation (range cells)
DRIFT_RAD, PHASE_RAD, CARRIER_CELLS = 0.5, 0.1, 0.1
# result of a limit: met, or exceeded with a warning, or exceeded so far that the method fails
Verdict = Literal["ok", "warn", "refuse"]


@dataclass(frozen=True)
class Limit:
    """One limit of a method, with the value of the limited quantity in a given scene.

    Args:
        name: Name of the quantity.
        value: Value of the quantity in the scene, in `unit`.
        limit: Limit of the method, in `unit`.
        unit: Unit of `value` and `limit`, empty for pure numbers.
        beyond: Verdict where the limit is not met: "warn", or "refuse" if the method then fails.
        consequence: Consequence where the limit is not met.
        remedy: Remedy where the limit is not met.
        at_least: True if the value must be at least the limit, False if it must be below.
    """

    name: str
    value: float
    limit: float
    unit: str
    beyond: Verdict
    consequence: str
    remedy: str
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """True where the limit is met."""
        return self.value >= self.limit if self.at_least else self.value < self.limit

    @property
    def verdict(self) -> Verdict:
        """ "ok" where the limit is met, otherwise `beyond`."""
        return "ok" if self.ok else self.beyond

    @property
    def sentence(self) -> str:
        """One sentence with value and limit, and if it is not met, consequence and remedy."""
        relation = "at least" if self.at_least else "below"
        figures = (
            f"{self.name} is {f'{self.value:.4g} {self.unit}'.strip()}, and must be {relation} "
            f"{f'{self.limit:.4g} {self.unit}'.strip()}"
        )
        return figures if self.ok else f"{figures}: {self.consequence}; {self.remedy}"


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
    _check_finite({"ranges_m[0]": near, "ranges_m[1]": far}, least=-math.inf)
    _check_finite(
        {
            "n_period": n_period,
            "speed_m_s": speed_m_s,
            "acceleration_m_s2": acceleration_m_s2,
            "jerk_m_s3": jerk_m_s3,
            "azimuth_extent_m": azimuth_extent_m,
            "lit_share": lit_share,
        }
    )
    if near > far:
        raise ValueError(f"ranges_m must be (least, largest) relative range in metres, in this order, got {ranges_m}")
    rows = (
        *_band_limits(radar, near, far, speed_m_s),
        *_motion_limits(radar, acceleration_m_s2, jerk_m_s3, snr_db),
        *_scene_limits(radar, azimuth_extent_m, spacing_m, lit_share),
    )
    return rows if snr_db is None else rows + _noise_limits(radar, n_period, snr_db)


def _band_limits(radar: TriangularLadar, near: float, far: float, speed: float) -> tuple[Limit, ...]:
    """Speeds beyond which a beat leaves the sampled band, or the tone of the mirror product
    does.
    """
    half, per_hz = radar.sample_rate_hz / 2, radar.wavelength_m / 2
    high = radar.beat_hz(max(abs(near), abs(far)))
    rows = [
        Limit(
            "speed in the beat band",
            speed,
            per_hz * (half - high),
            "m/s",
            "refuse",
            "beats beyond half the sampling rate alias",
            "raise the sampling rate or bring the reference range nearer",
        ),
        Limit(
            "speed of the mirror tone",
            speed,
            per_hz * half / 2,
            "m/s",
            "refuse",
            "the tone 2 fd of the mirror product aliases",
            "demodulate by a coarse velocity first",
        ),
    ]
    if radar.detection == "real":
        low = radar.beat_hz(min(abs(near), abs(far))) if near * far > 0 else 0.0
        rows.insert(
            1,
            Limit(
                "speed with real detection",
                speed,
                per_hz * low,
                "m/s",
                "refuse",
                "a beat folds at zero frequency and loses its sign",
                "move the reference away from the scene or detect both quadratures",
            ),
        )
    return tuple(rows)


def _motion_limits(radar: TriangularLadar, acceleration: float, jerk: float, snr_db: float | None) -> tuple[Limit, ...]:
    """Limits of acceleration and jerk."""
    wavelength, sweep = radar.wavelength_m, radar.sweep_s
    bias, allowed = jerk * radar.period_s**2 / 27, 1e-3 if snr_db is None else _segmented_std_m_s(radar, snr_db)
    return (
        Limit(
            "acceleration of the gradient",
            acceleration,
            wavelength / (4 * sweep * radar.pulse_step_s),
            "m/s^2",
            "warn",
            "the phase of half sweeps wraps from period to period",
            "determine the ambiguity integer of each period separately",
        ),
        Limit(
            "velocity bias by jerk",
            bias,
            allowed,
            "m/s",
            "warn",
            "vibration inside a period biases every velocity",
            "shorten the period: the bandwidth of the motion must stay well under its inverse",
        ),
        Limit(
            "acceleration within a sweep",
            acceleration,
            wavelength / (2 * sweep**2),
            "m/s^2",
            "warn",
            "the beat smears over a range cell",
            "add a quadratic term or shorten the sweep",
        ),
    )


def _scene_limits(radar: TriangularLadar, extent: float, spacing: float | None, lit_share: float) -> tuple[Limit, ...]:
    """Limits that the positions of the scatterers set."""
    rows = [
        Limit(
            "share of periods with a lit reference",
            lit_share,
            1.0,
            "",
            "warn",
            "velocity is undefined in the others",
            "mark those as not estimated",
            at_least=True,
        )
    ]
    if radar.beam_rad is not None:
        cell = radar.wavelength_m / (2 * radar.beam_rad)
        drift = (
            "the mean azimuth of the illuminated scatterers drifts as they enter and leave the beam, and is "
            "estimated as motion"
        )
        rows.append(
            Limit(
                "azimuth extent in a narrow beam",
                extent,
                cell,
                "m",
                "warn",
                drift,
                "combine scatterers by phase gradients, or refine the phase (PhasePolish)",
            )
        )
    if spacing is not None:
        cell = radar.wave_speed_m_s / radar.bandwidth_hz
        rows.append(
            Limit(
                "spacing of scatterers",
                spacing,
                cell,
                "m",
                "refuse",
                "peaks of half sweeps merge: single-peak segmented interference fails",
                "use the mirror product, or sum over range bins",
                at_least=True,
            )
        )
    return tuple(rows)


def _noise_limits(radar: TriangularLadar, n_period: int, snr_db: float) -> tuple[Limit, ...]:
    """Limits that the noise sets."""
    compressed = snr_db + 10 * math.log10(radar.sweep_samples)
    drift = (
        4
        * math.pi
        / radar.wavelength_m
        * _segmented_std_m_s(radar, snr_db)
        * radar.pulse_step_s
        * math.sqrt(n_period / 15)
    )
    return (
        Limit(
            "SNR after compression",
            compressed,
            GRADIENT_SNR_DB,
            "dB",
            "refuse",
            "gradient integration suffers cycle slips",
            "determine the ambiguity integer of each period separately, or gate and average",
            at_least=True,
        ),
        Limit(
            "accumulated phase error",
            drift,
            DRIFT_RAD,
            "rad",
            "warn",
            "integrated velocity errors defocus the image",
            "refine the phase after compensation (PhasePolish)",
        ),
    )


def _segmented_std_m_s(radar: TriangularLadar, snr_db: float) -> float:
    """Standard deviation of one segmented velocity (metrics.velocity_segmented_bound_m_s)."""
    energy = radar.sweep_samples * 10 ** (snr_db / 10)
    return radar.wavelength_m / 2 * math.sqrt(4 / energy) / (2 * math.pi * radar.sweep_s)


def ladar_requirements(
    radar: TriangularLadar,
    n_period: int,
    ranges_m: tuple[float, float],
    speed_m_s: float = 0.0,
    acceleration_m_s2: float = 0.0,
    displacement_m: float | None = None,
    tolerance_rad: float = PHASE_RAD,
) -> tuple[Requirement, ...]:
    """List the largest phase that each simplification neglects for a triangular ladar.

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
    _check_finite(
        {
            "n_period": n_period,
            "speed_m_s": speed_m_s,
            "acceleration_m_s2": acceleration_m_s2,
            "tolerance_rad": tolerance_rad,
        }
    )
    record_s = n_period * radar.pulse_step_s
    travel = speed_m_s * record_s if displacement_m is None else displacement_m
    per_m, c, sweep, cell = 4 * math.pi / radar.wavelength_m, radar.wave_speed_m_s, radar.sweep_s, radar.range_step_m
    bend = per_m * acceleration_m_s2 * sweep**2 / 8 + math.pi * radar.chirp_rate_hz_s * speed_m_s * sweep**2 / c
    closest, farthest = 0.0 if near * far < 0 else min(abs(near), abs(far)), max(abs(near), abs(far))
    video = 2 * math.pi * radar.chirp_rate_hz_s * ((2 * farthest / c) ** 2 - (2 * closest / c) ** 2)
    late = acceleration_m_s2 * radar.reference_range_m / c
    band = 2 * math.pi * radar.bandwidth_hz * travel / c
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
            _hyperbola_rad(radar, record_s),
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
            math.pi * CARRIER_CELLS,
        ),
    )


def _hyperbola_rad(radar: TriangularLadar, record_s: float) -> float:
    """Phase pi X^4 / (2 lambda R^3) at the azimuth X of the ends of the aperture in the beam, or of
    the record where that is shorter.
    """
    reach = radar.speed_m_s * record_s / 2
    if radar.beam_rad is not None:
        reach = min(reach, radar.reference_range_m * radar.beam_rad / 2)
    return math.pi * reach**4 / (2 * radar.wavelength_m * radar.reference_range_m**3)


def _check_finite(numbers: dict[str, float], least: float = 0.0) -> None:
    """Raise ValueError for numbers that are not finite or below `least`."""
    for name, value in numbers.items():
        if not (math.isfinite(value) and value >= least):
            raise ValueError(
                f"{name} must be a finite number{'' if least == -math.inf else ' of 0 or more'}, got {value}"
            )
