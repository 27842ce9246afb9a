"""Phase that each simplification of inverse SAR processing neglects for a rotating target.

All values are computed from the radar and from bounds of the motion, without a simulation.

Reference:
    Ruan et al. 2013 (some of the effects).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchsar.focus.requirements import Requirement, refuse_numbers
from torchsar.radar import InverseRadar


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

    >>> from torchsar import focus, radar
    >>> ladar = radar.InverseRadar(193.4e12, bandwidth_hz=150e9, prf_hz=2e3, rotation_rad_s=0.005)
    >>> rows = focus.inverse_requirements(ladar, 256, 128, cross_range_extent_m=0.2,
    ...     range_extent_m=0.1, velocity_m_s=0.1)
    >>> [row.effect for row in rows if not row.ok]  # what may not be neglected
    ['envelopes not aligned']

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
    refuse_numbers(
        1e-12,
        n_pulse=n_pulse,
        n_range=n_range,
        cross_range_extent_m=cross_range_extent_m,
        range_extent_m=range_extent_m,
    )
    refuse_numbers(-math.inf, velocity_m_s=velocity_m_s, acceleration_m_s2=acceleration_m_s2, rotation_rad_s=omega)
    for amplitude, frequency in vibrations:
        refuse_numbers(-math.inf, **{"amplitude_m of a vibration": amplitude})
        refuse_numbers(0, **{"frequency_hz of a vibration": frequency})
    cross_m, range_m, cell_m = cross_range_extent_m / 2, range_extent_m / 2, radar.range_step_m
    speed, push, per_m = abs(velocity_m_s), abs(acceleration_m_s2), 4 * math.pi / radar.wavelength_m
    period_s = 1 / radar.prf_hz
    aperture_s = n_pulse * period_s

    def shift(effect: str, neglects: str, rms_cells: float, cells: float, remedy: str) -> Requirement:
        """Row of a range shift that changes from pulse to pulse, compared by its rms.

        A shift by a cell is a phase of pi at the ends of the band. On an aircraft scene, shifts of
        0.05 cell rms raise the entropy by 0.05 nat, those of 0.1 cell by 0.19 nat.
        """
        return Requirement(effect, neglects, math.pi * rms_cells, cells, math.pi * 0.05, remedy)

    # Effects over the aperture: range migration, and the nonlinear phase of rotation. The rms about
    # the mean of a value that grows linearly by x is x / sqrt(12). On the same scene, a migration
    # of 0.38 cell raises the entropy by 0.02 nat, one of 0.75 cell by 0.07 nat, and one of 1.5
    # cells by 0.2 nat.
    angle, linear = abs(omega) * aperture_s, 1 / math.sqrt(12)
    walk, travel = cross_m * angle / cell_m, speed * aperture_s * linear / cell_m
    versed = per_m * range_m * (angle / 2) ** 2 / 2
    resample = "resample slow time per range frequency (keystone)"
    where = "" if walk > 1 else "warning: the edges blur, up to 0.1 nat of entropy; "
    keystone = f"{where}{resample}{'' if walk > 1 else ' where that matters'}"
    smooth = "align envelopes pulse by pulse and smooth the shifts"
    # phase steps between neighbouring pulses and range frequencies, which alias beyond pi
    swing = sum(2 * abs(a) * math.sin(math.pi * min(f * period_s, 0.5)) for a, f in vibrations)
    turned, extent = per_m * cross_m * abs(omega) * period_s, 2 * range_m / cell_m
    aliased = "the edges of the target are aliased"
    rows = (
        Requirement(
            "rotation migration ignored",
            "range walk x omega T of the target's edges",
            math.pi * walk,
            walk,
            math.pi * 0.4,
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
        shift(
            "envelopes not aligned",
            "travel over the aperture (the cells: rms)",
            travel,
            travel,
            f"track the target, then {smooth}",
        ),
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
            turned,
            math.nan,
            math.pi,
            f"raise the pulse rate: {aliased}",
        ),
        Requirement(
            "range unambiguous",
            "extent over the window (the cells: extent)",
            math.pi * extent / n_range,
            extent,
            math.pi,
            f"take more range samples: {aliased}",
        ),
    )
    if radar.pulse_s is None:
        return rows
    # effects of motion within a dechirped pulse; a velocity moves a range by `coupling` cells per
    # m/s
    chirp, half2 = radar.chirp_rate_hz_s, radar.pulse_s**2 / 4
    coupling = radar.carrier_hz / chirp / cell_m
    drift = push * aperture_s * linear * coupling
    shaken = sum(abs(a) * 2 * math.pi * f for a, f in vibrations) * coupling
    inside = push + sum(abs(a) * (2 * math.pi * f) ** 2 for a, f in vibrations)
    # blur in rad for a velocity of 1 m/s
    blur = 2 * math.pi * chirp * 2 * half2 / radar.wave_speed_m_s
    video = math.pi * chirp * (2 * range_m / radar.wave_speed_m_s) ** 2
    return (
        *rows,
        shift(
            "range-Doppler coupling",
            "change of v f0 / gamma over the aperture (the cells: the constant part)",
            drift,
            speed * coupling,
            smooth,
        ),
        Requirement(
            "intra-pulse walk",
            "blur by motion in a pulse",
            blur * speed,
            4 * blur * speed / math.pi,
            tolerance_rad,
            f"compress with the velocity, known to {tolerance_rad / blur:.3g} m/s",
        ),
        Requirement(
            "intra-pulse acceleration",
            "quadratic phase in a pulse",
            2 * math.pi / radar.wavelength_m * inside * half2,
            math.nan,
            tolerance_rad,
            "shorten the pulse: a shift cannot correct it",
        ),
        shift(
            "vibration coupling",
            "oscillating shift A w f0 / gamma (the cells: peak)",
            shaken / math.sqrt(2),
            shaken,
            smooth,
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
