"""Phase that each simplification of inverse SAR processing neglects for a rotating target.

All values are computed from the radar and from bounds of the motion, without a simulation.

Reference:
    Ruan et al. 2013 (some of the effects).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torchsar.focus.requirements import Requirement
from torchsar.radar import InverseRadar

# rms shift of envelopes in range cells; measured on an aircraft scene: 0.05 cell costs 0.05 nat of
# entropy, 0.1 cell 0.19 nat
SHIFT_RMS_CELLS = 0.05
# migration by rotation in range cells; measured on the same scene: 0.38 cell costs 0.02 nat, 0.75
# cell 0.07 nat, 1.5 cells 0.2 nat
MIGRATION_WARN_CELLS, MIGRATION_LIMIT_CELLS = 0.4, 1.0
# remedies and consequences that several rows share
_KEYSTONE = "resample slow time per range frequency (keystone)"
_SMOOTH = "align envelopes pulse by pulse and smooth the shifts"
_WRAP = "the edges of the target are aliased"


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
    """List the largest phase and range shift that each simplification neglects, with its tolerance.

    A range shift is also given as its phase at the ends of the range band, pi per range cell. The
    tolerances are:

    - 0.05 range cell rms for shifts that change over the aperture;
    - 0.4 range cell for the whole migration by rotation. A migration between 0.4 and 1 cell raises
      the entropy of the image by up to 0.1 nat;
    - pi for phase steps between neighbouring samples;
    - `tolerance_rad` for all other phases.

    Motion within a pulse is listed only where `radar.pulse_s` is set.

    Args:
        radar: Radar of the recording.
        n_pulse: Number of pulses.
        n_range: Number of range samples.
        cross_range_extent_m: Extent of the target in cross range, in metres.
        range_extent_m: Extent of the target in range, in metres.
        velocity_m_s: Radial velocity in m/s that remains after the range window has followed the
            target and range compression has corrected a known velocity. Where neither is done, give
            the full velocity.
        acceleration_m_s2: Radial acceleration in m/s^2 that remains after these corrections.
        vibrations: Amplitude in metres and frequency in Hz of each vibration; their effects add up.
        rotation_rad_s: Rotation rate in rad/s; None for that of the radar.
        tolerance_rad: Tolerated phase in rad.

    Returns:
        One `Requirement` per simplification: what it neglects, the error and the remedy.

    Raises:
        ValueError: If the rotation rate is not known, a number is not finite, an extent or a number
            of pulses or samples is not positive, or the frequency of a vibration is negative.

    Reference:
        Ruan et al. 2013 (some of the effects).
    """
    omega = radar.rotation_rad_s if rotation_rad_s is None else rotation_rad_s
    if omega is None:
        raise ValueError(
            "rotation_rad_s is not given and radar.rotation_rad_s is not set; give one of them, since "
            "the requirements of a rotating target depend on its rotation"
        )
    _check_finite(
        {
            "n_pulse": n_pulse,
            "n_range": n_range,
            "cross_range_extent_m": cross_range_extent_m,
            "range_extent_m": range_extent_m,
        },
        least=1e-12,
    )
    _check_finite({"velocity_m_s": velocity_m_s, "acceleration_m_s2": acceleration_m_s2, "rotation_rad_s": omega})
    for amplitude, frequency in vibrations:
        _check_finite({"amplitude_m of a vibration": amplitude})
        _check_finite({"frequency_hz of a vibration": frequency}, least=0)
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
    """Rotating target with the radial motion that compensation leaves; all values are 0 or more.

    Args:
        radar: Radar of the recording.
        aperture_s: Aperture time in seconds.
        cross_m: Half extent in cross range, in metres.
        range_m: Half extent in range, in metres.
        rate_rad_s: Rotation rate in rad/s.
        velocity_m_s: Remaining radial velocity in m/s.
        acceleration_m_s2: Remaining radial acceleration in m/s^2.
        vibrations: Amplitude in metres and frequency in Hz of each vibration.
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
        """List the errors over the aperture: range migration and the nonlinear phase of rotation.

        Args:
            tolerance_rad: Tolerated nonlinear phase in rad.

        Returns:
            One `Requirement` per simplification: what it neglects, the error and the remedy.
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
        """List the largest phase steps between neighbouring pulses and range frequencies.

        The steps are due to vibration, to the rotation of the outermost scatterers in cross range,
        and to the extent of the target in range. Steps beyond pi alias.

        Args:
            n_range: Number of range samples.

        Returns:
            One `Requirement` per simplification: what it neglects, the error and the remedy.
        """
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
                "phases alias: estimate each pulse separately, without unwrapping",
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
        """List the effects of motion within a dechirped pulse.

        Args:
            pulse_s: Pulse length in seconds.
            tolerance_rad: Tolerated phase in rad.

        Returns:
            One `Requirement` per simplification: what it neglects, the error and the remedy.
        """
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
                "shorten the pulse: a shift cannot correct it",
            ),
            _shift(
                "vibration coupling",
                "oscillating shift A w f0 / gamma (the cells: peak)",
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
                "remove it in compression (done by default)",
            ),
        )


def _shift(effect: str, neglects: str, rms_cells: float, cells: float, remedy: str) -> Requirement:
    """Row of a shift that changes from pulse to pulse, compared by its rms; a cell is a phase of pi
    at the ends of the band.
    """
    return Requirement(effect, neglects, math.pi * rms_cells, cells, math.pi * SHIFT_RMS_CELLS, remedy)


def _rms_of_line(whole: float) -> float:
    """Rms about the mean of a value that grows linearly by `whole`."""
    return whole / math.sqrt(12)


def _check_finite(numbers: dict[str, float], least: float = -math.inf) -> None:
    """Raise ValueError for numbers that are not finite or below `least`."""
    for name, value in numbers.items():
        if not (math.isfinite(value) and value >= least):
            raise ValueError(
                f"{name} must be a finite "
                f"{'' if least == -math.inf else 'positive ' if least > 0 else 'non-negative '}number, "
                f"got {value}"
            )
