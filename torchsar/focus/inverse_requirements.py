"""What a turning target requires of its processor: the phase that each simplification would
neglect, predicted before anything runs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchsar.focus.requirements import Requirement
from torchsar.radar import InverseRadar

SHIFT_RMS_CELLS = 0.05
MIGRATION_WARN_CELLS, MIGRATION_LIMIT_CELLS = 0.4, 1.0
_KEYSTONE = "resample slow time per range frequency (keystone)"
_SMOOTH = "align envelopes pulse by pulse and smooth the shifts"
_WRAP = "the edges of the target wrap round"


def inverse_requirements(
    radar: InverseRadar,
    n_pulse: int,
    n_range: int,
    cross_range_extent_m: float,
    range_extent_m: float,
    velocity_m_s: float = 0.0,
    acceleration_m_s2: float = 0.0,
    vibrations: Sequence[tuple[float, float]] = (),
    rotation_rad_s: float | None = None,
    tolerance_rad: float = math.pi / 4,
) -> tuple[Requirement, ...]:
    """Table of simplifications with the phase [rad] and the range cells that each neglects at
    worst, for a target of the given extents.

    velocity_m_s, acceleration_m_s2: radial motion that neither the tracking window nor the
    compression takes out (whole motion: what it would cost to do neither). vibrations:
    (amplitude_m, frequency_hz) of each, taken to add up. rotation_rad_s: by default the radar's.
    The phase of a shift is that at the ends of the band, pi a cell; shifts that change over the
    aperture may have 0.05 cell rms, migration 0.4 cell in all (to 1 cell it costs up to 0.1 nat of
    entropy), phases between pulses pi, all else tolerance_rad. Rows about the inside of a pulse
    need radar.pulse_s and are absent without it. Source: Ruan et al. 2013 for the effects it names,
    brief 002 section 8 for the rules. Raises ValueError for an unknown rotation, and for extents or
    motions that are no finite numbers.
    """
    omega = radar.rotation_rad_s if rotation_rad_s is None else rotation_rad_s
    if omega is None:
        raise ValueError(
            "neither radar.rotation_rad_s nor rotation_rad_s is set; what a turning target "
            "requires depends on its rotation"
        )
    _refuse_odd(
        {
            "n_pulse": n_pulse,
            "n_range": n_range,
            "cross_range_extent_m": cross_range_extent_m,
            "range_extent_m": range_extent_m,
        },
        least=1e-12,
    )
    _refuse_odd({"velocity_m_s": velocity_m_s, "acceleration_m_s2": acceleration_m_s2, "rotation_rad_s": omega})
    for amplitude, frequency in vibrations:
        _refuse_odd({"amplitude_m of a vibration": amplitude})
        _refuse_odd({"frequency_hz of a vibration": frequency}, least=0)
    target = TurningTarget(
        radar,
        n_pulse / radar.prf_hz,
        cross_range_extent_m / 2,
        range_extent_m / 2,
        abs(omega),
        abs(velocity_m_s),
        abs(acceleration_m_s2),
        tuple(vibrations),
    )
    rows = target.over_aperture(tolerance_rad) + target.between_samples(n_range)
    return rows if radar.pulse_s is None else rows + target.inside_pulses(radar.pulse_s, tolerance_rad)


@dataclass(frozen=True)
class TurningTarget:
    """A target of half extents cross_m and range_m, turning at rate_rad_s for aperture_s, with the
    radial motion that is left; all 0 or more.
    """

    radar: InverseRadar
    aperture_s: float
    cross_m: float
    range_m: float
    rate_rad_s: float
    velocity_m_s: float
    acceleration_m_s2: float
    vibrations: tuple[tuple[float, float], ...]

    def over_aperture(self, tolerance_rad: float) -> tuple[Requirement, ...]:
        """Migration of the envelopes by rotation and by motion, and the phase of rotation that is
        not linear in time.
        """
        angle, cell = self.rate_rad_s * self.aperture_s, self.radar.range_step_m
        cells = self.cross_m * angle / cell
        travel = _rms_of_line(self.velocity_m_s * self.aperture_s) / cell
        versed = 4 * math.pi / self.radar.wavelength_m * self.range_m * (angle / 2) ** 2 / 2
        keystone = (
            _KEYSTONE
            if cells > MIGRATION_LIMIT_CELLS
            else f"warning: the edges blur, up to 0.1 nat of entropy; {_KEYSTONE} where that matters"
        )
        return (
            Requirement(
                "rotation migration ignored",
                "range walk x omega T of the target's edges",
                math.pi * cells,
                cells,
                math.pi * MIGRATION_WARN_CELLS,
                keystone,
            ),
            Requirement(
                "phase linear in rotation",
                "y (cos theta - 1) of near and far parts",
                versed,
                math.nan,
                tolerance_rad,
                "focus by polar format or backprojection",
            ),
            _shift(
                "envelopes not aligned",
                "travel over the aperture (the cells: rms)",
                travel,
                travel,
                f"track the target, then {_SMOOTH}",
            ),
        )

    def between_samples(self, n_range: int) -> tuple[Requirement, ...]:
        """Phases between neighbouring pulses or range frequencies: beyond pi they alias."""
        per_m, period_s = 4 * math.pi / self.radar.wavelength_m, 1 / self.radar.prf_hz
        swing = sum(2 * abs(a) * math.sin(math.pi * min(f * period_s, 0.5)) for a, f in self.vibrations)
        cells = 2 * self.range_m / self.radar.range_step_m
        return (
            Requirement(
                "vibration followed by pulses",
                "phase between pulses",
                per_m * swing,
                math.nan,
                math.pi,
                "phases alias: estimate each pulse by itself, unwrap nothing",
            ),
            Requirement(
                "cross range unambiguous",
                "phase between pulses of the edges",
                per_m * self.cross_m * self.rate_rad_s * period_s,
                math.nan,
                math.pi,
                f"raise the pulse rate: {_WRAP}",
            ),
            Requirement(
                "range unambiguous",
                "extent over the window (the cells: extent)",
                math.pi * cells / n_range,
                cells,
                math.pi,
                f"take more range samples: {_WRAP}",
            ),
        )

    def inside_pulses(self, pulse_s: float, tolerance_rad: float) -> tuple[Requirement, ...]:
        """Motion inside a dechirped pulse."""
        chirp, half2 = self.radar.chirp_rate_hz_s, pulse_s**2 / 4
        coupling = self.radar.carrier_hz / chirp / self.radar.range_step_m  # cells per m/s
        drift = _rms_of_line(self.acceleration_m_s2 * self.aperture_s) * coupling
        shaken = sum(abs(a) * 2 * math.pi * f for a, f in self.vibrations) * coupling
        inside = self.acceleration_m_s2 + sum(abs(a) * (2 * math.pi * f) ** 2 for a, f in self.vibrations)
        walk = 2 * math.pi * chirp * 2 * half2 / self.radar.wave_speed_m_s  # rad per m/s
        known = f"compress with the velocity, known to {tolerance_rad / walk:.3g} m/s"
        bend = 2 * math.pi / self.radar.wavelength_m * inside * half2
        video = math.pi * chirp * (2 * self.range_m / self.radar.wave_speed_m_s) ** 2
        return (
            _shift(
                "range-Doppler coupling",
                "change of v f0 / gamma over the aperture (the cells: the constant part)",
                drift,
                self.velocity_m_s * coupling,
                _SMOOTH,
            ),
            Requirement(
                "intra-pulse walk",
                "blur by motion in a pulse",
                walk * self.velocity_m_s,
                4 * walk * self.velocity_m_s / math.pi,
                tolerance_rad,
                known,
            ),
            Requirement(
                "intra-pulse acceleration",
                "quadratic phase in a pulse",
                bend,
                math.nan,
                tolerance_rad,
                "shorten the pulse: no shift undoes it",
            ),
            _shift(
                "vibration coupling",
                "shift A w f0 / gamma to and fro (the cells: peak)",
                shaken / math.sqrt(2),
                shaken,
                _SMOOTH,
            ),
            Requirement(
                "residual video phase",
                "pi gamma dtau^2 at the edges",
                video,
                math.nan,
                tolerance_rad,
                "take it out in compression (done by default)",
            ),
        )


def _shift(effect: str, neglects: str, rms_cells: float, cells: float, remedy: str) -> Requirement:
    """A shift that changes from pulse to pulse, judged by its rms; a cell is pi at the ends of the
    band.
    """
    return Requirement(effect, neglects, math.pi * rms_cells, cells, math.pi * SHIFT_RMS_CELLS, remedy)


def _rms_of_line(whole: float) -> float:
    """Rms about its mean of a value that grows evenly by `whole`."""
    return whole / math.sqrt(12)


def _refuse_odd(numbers: dict[str, float], least: float = -math.inf) -> None:
    for name, value in numbers.items():
        if not (math.isfinite(value) and value >= least):
            raise ValueError(
                f"{name} must be a finite "
                f"{'' if least == -math.inf else 'positive ' if least > 0 else 'non-negative '}number, "
                f"got {value}"
            )
