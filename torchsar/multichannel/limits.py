"""Limits of reconstruction, velocity estimation and imaging with a multichannel receiver.

They are predicted from the radar, the reconstruction and bounds of the motion, before any data are
processed. Other checks are made elsewhere: `BistaticRadar` rejects empty lists of channels and
values that are not positive, every stage rejects samples that are not finite, and estimators mark
an estimate at the end of its search interval.

Reference:
    Remote Sens. 2020, 12, 1703, sections 2 to 4.
"""

from __future__ import annotations

import math

import torch

from torchsar.focus.requirements import Limit
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import POOR, LeastSquares, condition_number, largest_condition
from torchsar.multichannel.requirements import MultichannelUse
from torchsar.radar import BistaticRadar


def multichannel_limits(radar: BistaticRadar, use: MultichannelUse) -> tuple[Limit, ...]:
    """Return the limits of reconstruction, estimation and imaging for a use of the radar.

    >>> from torchsar.multichannel import MultichannelUse, multichannel_limits
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> rows = multichannel_limits(radar, MultichannelUse(n_pulse=800, u_a_m_s=(0.0, 0.0)))
    >>> [row.name for row in rows if row.verdict == "refuse"]
    ['record']

    Args:
        radar: Radar parameters.
        use: Record, reconstruction and bounds of the motion.

    Returns:
        One row per limit. Rows that need an SNR, a pattern or an estimator that `use` does not have
        are absent. If the fastest target is as fast along track as the receiver, the row of this
        limit is returned alone.
    """
    slowest = radar.speed_m_s - use.u_a_m_s[1]
    moves = Limit(
        "speed past the fastest target",
        slowest,
        1e-6,
        "m/s",
        "refuse",
        "no aperture forms",
        "bound u_a below the speed of the receiver",
        at_least=True,
    )
    if not moves.ok:
        return (moves,)
    return (
        moves,
        *_record_limits(radar, use),
        *_band_limits(radar, use),
        *_channel_limits(radar, use),
        *_tone_limits(radar, use),
        *_estimator_limits(radar, use),
    )


def _record_limits(radar: BistaticRadar, use: MultichannelUse) -> list[Limit]:
    """Return the limits of the length of the record."""
    record, slowest = use.n_pulse / radar.prf_hz, radar.speed_m_s - use.u_a_m_s[1]
    pattern = Limit(
        "record with a pattern",
        record,
        4 * radar.prf_hz * radar.wavelength_m * radar.reference_range_m / slowest**2,
        "s",
        "warn",
        "false targets two PRFs away wrap around onto other positions",
        "record longer",
        at_least=True,
    )
    return [
        Limit(
            "record",
            record,
            use.integration_s,
            "s",
            "refuse",
            "it is shorter than the integration time",
            "record longer, or integrate less",
            at_least=True,
        ),
        Limit(
            "image time of the fastest target",
            use.fastest_m_s * radar.reference_range_m / slowest**2 + use.y0_m / slowest,
            record / 2,
            "s",
            "warn",
            "targets are displaced beyond the record and wrap around in azimuth",
            "record longer",
        ),
        *[pattern] * use.pattern,
    ]


def _band_limits(radar: BistaticRadar, use: MultichannelUse) -> list[Limit]:
    """Return the limits of the Doppler bandwidth."""
    rebuilt, more = use.rebuild.bands * radar.prf_hz, "rebuild more bands, or integrate less"
    channels = Limit(
        "channels",
        radar.channels,
        use.rebuild.bands,
        "",
        "refuse",
        "more bands than channels cannot be separated without a prior",
        "rebuild fewer bands, or use MinimumMeanSquare",
        at_least=True,
    )
    ratio = Limit(
        "Doppler band inside the intensity ratio",
        use.bandwidth_hz(radar),
        rebuilt,
        "Hz",
        "refuse",
        "the intensity ratio has no band outside the signal",
        more,
    )
    needed = Limit(
        "Doppler band of the integration time",
        use.bandwidth_hz(radar, use.fastest_m_s, use.u_a_m_s[0]),
        rebuilt,
        "Hz",
        "warn",
        "its ends alias in the rebuilt band",
        more,
    )
    return [*[channels] * isinstance(use.rebuild, LeastSquares), needed, *[ratio] * ("sir" in use.estimators)]


def _channel_limits(radar: BistaticRadar, use: MultichannelUse) -> list[Limit]:
    """Return the limits of the condition number; only a least-squares inverse has them."""
    bands = use.rebuild.bands
    if not isinstance(use.rebuild, LeastSquares) or not 1 < bands <= radar.channels:
        return []
    u_a = torch.linspace(*use.u_a_m_s, 129, dtype=torch.float64)
    u_r = torch.tensor([*use.u_r_m_s], dtype=torch.float64)[:, None]
    within = condition_number(radar, PointMotion.of(radar, u_a, u_r, u_a), bands).amax(0)
    singular = singular_speeds_m_s(radar, bands, use.u_a_m_s)
    other = "rebuild fewer bands, use MinimumMeanSquare, or change the pulse rate"
    return [
        Limit(
            "condition number at rest",
            float(condition_number(radar, PointMotion.of(radar, torch.zeros(())), bands)),
            largest_condition(use.dtype),
            "",
            "refuse",
            f"at a pulse rate of {radar.prf_hz:g} Hz and {radar.speed_m_s:g} m/s channels sample "
            f"the same positions, and {bands} bands cannot be separated",
            other,
        ),
        Limit(
            "condition number within the velocities",
            float(within.max()),
            POOR,
            "",
            "warn",
            f"noise and errors of the velocity grow, most at u_a = {float(u_a[int(within.argmax())]):.3g} m/s",
            other,
        ),
        Limit(
            "singular speeds along track within the search",
            len(singular),
            1,
            "",
            "warn",
            f"the search crosses a singular reconstruction at u_a = {', '.join(f'{u:.3g}' for u in singular[:3])} m/s",
            other,
        ),
    ]


def singular_speeds_m_s(radar: BistaticRadar, bands: int, u_a_m_s: tuple[float, float]) -> list[float]:
    """Return along-track speeds at which the reconstruction is singular.

    At these speeds fewer than `bands` channels sample different positions. Two channels at a
    distance D along track sample the same positions if the receiver passes the target at the speed
    v = D PRF / q with a positive whole number q; targets without slant-range speed are assumed.

    Args:
        radar: Radar parameters.
        bands: Number of Doppler bands.
        u_a_m_s: Bounds of the along-track speed in m/s.

    Returns:
        Along-track speeds of the target within the bounds in m/s, rising.
    """
    positions, prf = radar.channel_m, radar.prf_hz
    rates = {round(abs(a - b), 9) * prf for i, a in enumerate(positions) for b in positions[:i]}
    least, most = (1 / (radar.speed_m_s - u_a) for u_a in u_a_m_s)
    speeds = {
        rate / q
        for rate in rates
        for q in range(max(1, math.ceil(rate * least - 1e-9)), math.floor(rate * most + 1e-9) + 1)
    }

    def different(turns: list[float]) -> int:
        """Count the phases of channels, in cycles, that differ by other than whole cycles."""
        off = [[abs((x - before + 0.5) % 1 - 0.5) for before in turns[:i]] for i, x in enumerate(turns)]
        # differences of less than 1e-6 are rounding
        return sum(all(cycles > 1e-6 for cycles in row) for row in off)

    return sorted(radar.speed_m_s - v for v in speeds if different([x * prf / v for x in positions]) < bands)


def _tone_limits(radar: BistaticRadar, use: MultichannelUse) -> list[Limit]:
    """Return the limits of the Doppler ambiguity."""
    half, centre = radar.ambiguous_velocity_m_s / 2, use.fastest_m_s
    aliased = Limit(
        "Doppler band for the keystone transform",
        use.bandwidth_hz(radar),
        radar.prf_hz,
        "Hz",
        "warn",
        "the keystone transform defocuses data that are aliased in slow time",
        "deramp before it",
    )
    return [
        Limit(
            "slant-range speed",
            centre,
            0.95 * half,  # factor by convention
            "m/s",
            "warn",
            "velocities are measured modulo lambda PRF, and appear at the other end of the interval",
            "resolve the ambiguity by range walk, or raise the pulse rate",
        ),
        Limit(
            "tone left for the keystone transform",
            centre + (radar.speed_m_s - use.u_a_m_s[0]) * use.y0_m / radar.reference_range_m,
            half,
            "m/s",
            "warn",
            "the keystone transform assumes a wrong multiple of the pulse rate",
            "give the ambiguity number",
        ),
        *[aliased] * (not use.deramped),
    ]


def _estimator_limits(radar: BistaticRadar, use: MultichannelUse) -> list[Limit]:
    """Return the limits of the velocity estimators."""
    ratio, snr_db = "sir" in use.estimators, -math.inf if use.snr_db is None else use.snr_db
    clutter = Limit(
        "stationary clutter beside the intensity ratio",
        1,
        1,
        "",
        "warn",
        "the ratio has its maximum at u_r = 0 for any motion of the target",
        "whiten, or suppress the clutter first",
    )
    gathered = Limit(
        "SNR gathered over channels and pulses",
        snr_db + 10 * math.log10(radar.channels * use.integration_s * radar.prf_hz),
        # 19 dB is -15 dB per sample with three channels and 810 pulses; below it, the strongest
        # tone is often one of noise
        19.0,
        "dB",
        "warn",
        "estimates below the threshold have gross errors",
        "integrate longer",
        at_least=True,
    )
    of_sample = Limit(
        "SNR of a sample for the intensity ratio",
        snr_db,
        7.0,  # upper end of the range 0 to 7 dB in which the threshold is
        "dB",
        "warn",
        "the ratio is below its threshold",
        "use interferometry between the channels",
        at_least=True,
    )
    known = use.snr_db is not None
    return [
        *[clutter] * (use.clutter and ratio),
        *[gathered] * (known and bool({"ati", "ml"} & set(use.estimators))),
        *[of_sample] * (known and ratio),
    ]
