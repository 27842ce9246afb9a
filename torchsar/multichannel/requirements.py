"""What a receiver with channels along track allows and what its scene requires: limits, and the
phase that each simplification neglects.

Both are predicted from radar, reconstruction and bounds of the motion before anything runs. Brief
001, "Refuse or warn" and "Model only what a scene requires". Empty lists of channels, and rates,
ranges and speeds that are not positive, are refused by `BistaticRadar`; samples that are not finite
by every stage; estimates at the end of their search interval are marked by the estimators
themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import cis
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.response import (
    POOR,
    SINGULAR,
    SINGULAR_SINGLE,
    LeastSquares,
    MinimumMeanSquare,
    Rebuild,
    band_matrix,
    condition_number,
)
from torchsar.radar import BistaticRadar, receive_range

NEAR_AMBIGUOUS = 0.95
GATHERED_SNR_DB, SIR_SNR_DB, FAINT_RAD = 19.0, 7.0, 0.3
_POINTS = 65
_GEO_RANGE_M = 3.9e7
_ALIKE = 1e-6  # turns between channels that sample the same places

Estimator = Literal["sir", "ati", "ml", "whitened"]


@dataclass(frozen=True)
class MultichannelUse:
    """How a radar is used: record, reconstruction, and bounds of what moves.

    n_pulse: of the record; integration_s: time T that is focused; pattern: targets fade by the
    pattern of the elements, instead of at the ends of T. u_r_m_s, u_a_m_s: least and largest
    velocity searched; y0_m: largest |y0|; acceleration_m_s2: largest radial one; swath_m: range
    swath, to either side. snr_db: of a range-compressed sample of one channel, None where unknown.
    clutter: whether a stationary scene lies beside the targets. deramped: whether the keystone
    transform works on deramped data. u_r_error_m_s, u_a_error_m_s, channel_error_rad: errors
    expected in the reconstruction; replica_db: highest replica allowed.
    """

    n_pulse: int
    integration_s: float = 4.5
    rebuild: Rebuild = field(default_factory=LeastSquares)
    pattern: bool = False
    u_r_m_s: tuple[float, float] = (-20.0, 20.0)
    u_a_m_s: tuple[float, float] = (-20.0, 20.0)
    y0_m: float = 0.0
    acceleration_m_s2: float = 0.0
    swath_m: float = 0.0
    snr_db: float | None = None
    clutter: bool = False
    estimators: tuple[Estimator, ...] = ("ati",)
    deramped: bool = True
    dtype: torch.dtype = torch.complex64
    u_r_error_m_s: float = 0.1
    u_a_error_m_s: float = 0.1
    channel_error_rad: float = math.radians(0.1)
    replica_db: float = -50.0

    def __post_init__(self) -> None:
        for name in ("u_r_m_s", "u_a_m_s"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                raise ValueError(f"{name} is (least, largest) velocity, finite and in order, got {(low, high)}")
        if self.n_pulse < 1 or not self.integration_s > 0:
            raise ValueError(
                "a record needs n_pulse of 1 or more and a positive integration_s, got "
                f"{self.n_pulse} and {self.integration_s}"
            )
        least = {
            name: getattr(self, name)
            for name in ("y0_m", "acceleration_m_s2", "swath_m", "u_r_error_m_s", "u_a_error_m_s", "channel_error_rad")
        }
        wrong = {name: value for name, value in least.items() if not (math.isfinite(value) and value >= 0)}
        if wrong:
            raise ValueError(
                "these must be finite and not negative: "
                f"{', '.join(f'{name}={value}' for name, value in wrong.items())}"
            )

    @property
    def fastest_m_s(self) -> float:
        """Largest |u_r|."""
        return max(abs(u) for u in self.u_r_m_s)


def _bandwidth_hz(radar: BistaticRadar, use: MultichannelUse, u_r: float = 0.0, u_a: float = 0.0) -> float:
    """B_a = V^2 T / (lambda R0)."""
    return ((radar.speed_m_s - u_a) ** 2 + u_r**2) * use.integration_s / (radar.wavelength_m * radar.reference_range_m)


def multichannel_limits(radar: BistaticRadar, use: MultichannelUse) -> tuple[Limit, ...]:
    """Limits of reconstructing, estimating and imaging as `use` says; rows that need what is not
    there (snr_db, a pattern, an estimator) are absent.
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


def _record_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    record, slowest = use.n_pulse / radar.prf_hz, radar.speed_m_s - use.u_a_m_s[1]
    yield Limit(
        "record",
        record,
        use.integration_s,
        "s",
        "refuse",
        "it is shorter than the time to be integrated",
        "record longer, or integrate less",
        at_least=True,
    )
    image = use.fastest_m_s * radar.reference_range_m / slowest**2 + use.y0_m / slowest
    yield Limit(
        "image time of the fastest target",
        image,
        record / 2,
        "s",
        "warn",
        "targets are displaced beyond the record and wrap in azimuth",
        "record longer",
    )
    if use.pattern:
        wrap = 4 * radar.prf_hz * radar.wavelength_m * radar.reference_range_m / slowest**2
        yield Limit(
            "record with a pattern",
            record,
            wrap,
            "s",
            "warn",
            "replicas two pulse rates off wrap onto other places",
            "record longer",
            at_least=True,
        )


def _band_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    bands, rebuilt = use.rebuild.bands, use.rebuild.bands * radar.prf_hz
    needed = _bandwidth_hz(radar, use, use.fastest_m_s, use.u_a_m_s[0])
    if use.rebuild.refusal(radar.channels) is not None or isinstance(use.rebuild, LeastSquares):
        yield Limit(
            "channels",
            radar.channels,
            bands,
            "",
            "refuse",
            "more bands cannot be told apart without a prior",
            "rebuild fewer bands, or use MinimumMeanSquare",
            at_least=True,
        )
    yield Limit(
        "Doppler band of the integration time",
        needed,
        rebuilt,
        "Hz",
        "warn",
        "its ends alias in the rebuilt band",
        "rebuild more bands, or integrate less",
    )
    if "sir" in use.estimators:
        nothing = "the intensity ratio has no band left outside the signal"
        yield Limit(
            "Doppler band inside the intensity ratio",
            _bandwidth_hz(radar, use),
            rebuilt,
            "Hz",
            "refuse",
            nothing,
            "rebuild more bands, or integrate less",
        )


def _channel_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Where channels sample the same places: only an inverse minds."""
    bands = use.rebuild.bands
    if isinstance(use.rebuild, MinimumMeanSquare) or bands > radar.channels or bands == 1:
        return
    rest = float(condition_number(radar, PointMotion.of(radar, torch.zeros(())), bands))
    least = SINGULAR if use.dtype == torch.complex128 else SINGULAR_SINGLE
    same = (
        f"at a pulse rate of {radar.prf_hz:g} Hz and {radar.speed_m_s:g} m/s channels sample "
        f"the same places, and {bands} bands cannot be told apart"
    )
    other = "rebuild fewer bands, use MinimumMeanSquare, or change the pulse rate"
    yield Limit("condition number at rest", rest, least, "", "refuse", same, other)
    worst, speed = _worst_condition(radar, use)
    yield Limit(
        "condition number within the velocities",
        worst,
        POOR,
        "",
        "warn",
        f"noise and errors of the velocity grow, most at u_a = {speed:.3g} m/s",
        other,
    )
    singular = singular_speeds_m_s(radar, bands, use.u_a_m_s)
    named = ", ".join(f"{u:.3g}" for u in singular[:3])
    yield Limit(
        "singular speeds along track within the search",
        len(singular),
        1,
        "",
        "warn",
        f"the search crosses a singular reconstruction at u_a = {named} m/s",
        other,
    )


def _worst_condition(radar: BistaticRadar, use: MultichannelUse) -> tuple[float, float]:
    """Largest condition number within the velocities, and the u_a where it is."""
    u_a = torch.linspace(*use.u_a_m_s, 2 * _POINTS - 1, dtype=torch.float64)
    u_r = torch.tensor([*use.u_r_m_s], dtype=torch.float64)[:, None]
    found = condition_number(radar, PointMotion.of(radar, u_a, u_r, u_a), use.rebuild.bands)
    return float(found.max()), float(u_a[int(found.amax(0).argmax())])


def singular_speeds_m_s(radar: BistaticRadar, bands: int, u_a_m_s: tuple[float, float]) -> list[float]:
    """Speeds u_a within the bounds at which fewer than `bands` channels sample different places: v
    = (m - m') d PRF / q for a pair of them, q a whole number (u_r = 0).
    """
    places = radar.channel_m
    pairs = {round(abs(a - b), 9) for i, a in enumerate(places) for b in places[:i]}
    fastest, slowest = radar.speed_m_s - u_a_m_s[0], radar.speed_m_s - u_a_m_s[1]
    speeds = {
        spacing * radar.prf_hz / q
        for spacing in pairs
        for q in _whole_between(spacing * radar.prf_hz / fastest, spacing * radar.prf_hz / slowest)
    }
    return sorted(radar.speed_m_s - v for v in speeds if _different(places, radar.prf_hz / v) < bands)


def _whole_between(low: float, high: float) -> range:
    return range(max(1, math.ceil(low - 1e-9)), math.floor(high + 1e-9) + 1)


def _different(places: tuple[float, ...], turns_per_m: float) -> int:
    """Number of different phases, whole turns dropped."""
    seen: list[float] = []
    for place in places:
        turns = place * turns_per_m
        if all(abs((turns - other + 0.5) % 1 - 0.5) > _ALIKE for other in seen):
            seen.append(turns)
    return len(seen)


def _tone_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    half, centre = radar.ambiguous_velocity_m_s / 2, use.fastest_m_s
    unknown = "velocities are known modulo lambda PRF, and come out on the other side"
    yield Limit(
        "slant-range speed",
        centre,
        NEAR_AMBIGUOUS * half,
        "m/s",
        "warn",
        unknown,
        "resolve the ambiguity by range walk, or raise the pulse rate",
    )
    tone = centre + (radar.speed_m_s - use.u_a_m_s[0]) * use.y0_m / radar.reference_range_m
    yield Limit(
        "tone left for the keystone transform",
        tone,
        half,
        "m/s",
        "warn",
        "the keystone transform shifts by a wrong multiple of the pulse rate",
        "give it the ambiguity number",
    )
    if not use.deramped:
        smeared = "the keystone transform smears slow time that is aliased"
        yield Limit(
            "Doppler band for the keystone transform",
            _bandwidth_hz(radar, use),
            radar.prf_hz,
            "Hz",
            "warn",
            smeared,
            "deramp before it",
        )


def _estimator_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    if use.clutter and "sir" in use.estimators:
        yield Limit(
            "stationary clutter beside the intensity ratio",
            1,
            1,
            "",
            "warn",
            "the ratio locks on u_r = 0 and reports that nothing moves",
            "whiten, or take the clutter out first",
        )
    if use.snr_db is None:
        return
    if {"ati", "ml"} & set(use.estimators):
        gathered = use.snr_db + 10 * math.log10(radar.channels * use.integration_s * radar.prf_hz)
        yield Limit(
            "SNR gathered over channels and pulses",
            gathered,
            GATHERED_SNR_DB,
            "dB",
            "warn",
            "estimates are wild below their threshold",
            "integrate longer",
            at_least=True,
        )
    if "sir" in use.estimators:
        yield Limit(
            "SNR of a sample for the intensity ratio",
            use.snr_db,
            SIR_SNR_DB,
            "dB",
            "warn",
            "the ratio is below its threshold",
            "use interferometry between the channels",
            at_least=True,
        )


def multichannel_requirements(
    radar: BistaticRadar, use: MultichannelUse, tolerance_rad: float = math.pi / 4
) -> tuple[Requirement, ...]:
    """Phase (rad) that each simplification neglects at worst within `use`, against what may be
    neglected.

    Transmit range and y0 against 0.3 rad; range migration at the ends of the band, where a quarter
    of a resolution cell c / B is pi/4; errors of the reconstruction against the phase that makes a
    replica of use.replica_db. Quadratic phases count at the ends of the aperture. "Absorbed" terms
    focus with another u_a.
    """
    return (
        *_transmit_rows(radar, use),
        *_path_rows(radar, use, tolerance_rad),
        *_migration_rows(radar, use),
        *_rebuild_rows(radar, use),
        *_precision_rows(radar, tolerance_rad),
    )


def _transmit_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    k, half, wave = [*radar.transmit_range, 0.0, 0.0, 0.0, 0.0], use.integration_s / 2, 2 * math.pi / radar.wavelength_m
    second, beyond = wave * abs(k[1]) * half**2, wave * sum(abs(x) * half**i for i, x in enumerate(k[2:], start=3))
    yield Requirement("transmit range of order 1", "its acceleration", second, math.nan, FAINT_RAD, "keep k2")
    yield Requirement(
        "transmit range of order 2", "third and higher orders", beyond, math.nan, FAINT_RAD, "keep more orders"
    )
    spread = max(abs(x) for x in radar.channel_m) / (radar.speed_m_s - use.u_a_m_s[1])
    yield Requirement(
        "transmit range alike in all channels",
        "2 k2 dt_m t, where k1 stays in the channel response",
        wave * 2 * abs(k[1]) * spread * half,
        math.nan,
        FAINT_RAD,
        "remove the transmit range first",
    )


def _path_rows(radar: BistaticRadar, use: MultichannelUse, tolerance_rad: float) -> Iterable[Requirement]:
    wave, half, r0, u_r = (
        2 * math.pi / radar.wavelength_m,
        use.integration_s / 2,
        radar.reference_range_m,
        use.fastest_m_s,
    )
    v = radar.speed_m_s - use.u_a_m_s[0]
    yield Requirement(
        "parabolic receive range",
        "third and higher orders of the hyperbola",
        wave * _parabola_left_m(radar, use),
        math.nan,
        tolerance_rad,
        "focus with the hyperbola",
    )
    yield Requirement(
        "channels as delays of one another",
        "second and higher orders of the path between channels",
        wave * _delay_left_m(radar, use),
        math.nan,
        tolerance_rad,
        "shorten the row of channels",
    )
    shift = wave * u_r * use.y0_m * v * half**2 / (2 * r0**2)
    yield Requirement(
        "y0 left out of the azimuth filter",
        "change of the closest range, u_r y0 / v",
        shift,
        math.nan,
        FAINT_RAD,
        "give y0 to the filter",
    )
    ground = u_r * r0 / math.sqrt(r0**2 - radar.height_m**2)
    rise = wave * (ground * radar.height_m * half) ** 2 / (2 * r0**3)
    yield Requirement(
        "motion in the slant plane",
        "curvature of motion on the ground, absorbed by u_a",
        rise,
        math.nan,
        tolerance_rad,
        "refit u_a per target, and do not call it speed",
    )
    bent = wave * use.acceleration_m_s2 * half**2 / 2
    yield Requirement(
        "no radial acceleration",
        "its quadratic phase, absorbed by u_a",
        bent,
        math.nan,
        tolerance_rad,
        "refit u_a per target, and do not call it speed",
    )


def _seen_times(use: MultichannelUse) -> Tensor:
    return use.integration_s * torch.linspace(-0.5, 0.5, _POINTS, dtype=torch.float64)


def _corner_speeds(use: MultichannelUse) -> tuple[Tensor, Tensor]:
    """(corner, 1) of the velocities searched, u_r = 0 with them."""
    u_r, u_a = torch.meshgrid(
        torch.tensor([*use.u_r_m_s, 0.0], dtype=torch.float64),
        torch.tensor([*use.u_a_m_s], dtype=torch.float64),
        indexing="ij",
    )
    return u_r.reshape(-1, 1), u_a.reshape(-1, 1)


def _parabola_left_m(radar: BistaticRadar, use: MultichannelUse) -> float:
    """Largest third and higher orders in time of the receive range of a point abeam."""
    time, (u_r, u_a) = _seen_times(use), _corner_speeds(use)
    exact = receive_range(time, u_r, u_a, 0.0, radar.reference_range_m, radar.speed_m_s, 0.0)
    parabola = -u_r * time + (radar.speed_m_s - u_a).square() * time.square() / (2 * radar.reference_range_m)
    return float((exact - parabola).abs().max())


def _delay_left_m(radar: BistaticRadar, use: MultichannelUse) -> float:
    """Largest part, varying over time, of the path of a channel against the delayed path of the
    reference, Eqs. (6), (7).
    """
    time, r0 = _seen_times(use), radar.reference_range_m
    u_r, u_a = (u[:, None] for u in _corner_speeds(use))
    dx, v = radar.channels_at()[:, None], radar.speed_m_s - u_a
    delayed = receive_range(time - dx * v / (v.square() + u_r.square()), u_r, u_a, 0.0, r0, radar.speed_m_s, 0.0)
    left = receive_range(time, u_r, u_a, 0.0, r0, radar.speed_m_s, dx) - delayed
    return float((left - left.mean(-1, keepdim=True)).abs().max())


def _migration_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    cell, u_r = radar.wave_speed_m_s / radar.pulse.bandwidth_hz, use.fastest_m_s
    v, r0 = radar.speed_m_s - use.u_a_m_s[0], radar.reference_range_m
    curve = (v * use.integration_s) ** 2 / (8 * r0)
    walk = (u_r + v * use.y0_m / r0) * use.integration_s

    def row(effect: str, neglects: str, path_m: float, remedy: str) -> Requirement:
        return Requirement(effect, neglects, math.pi * path_m / cell, path_m / cell, math.pi / 4, remedy)

    yield row(
        "no range migration correction",
        "curvature and walk",
        curve + walk,
        "correct migration (static bulk, or deramp and keystone)",
    )
    yield row("static bulk correction", "walk of what moves or lies off y0 = 0", walk, "use deramp and keystone")
    yield row(
        "one reference range", "change of curvature over the swath", curve * use.swath_m / r0, "work in range blocks"
    )
    yield row(
        "azimuth only",
        "migration left by deramp and keystone",
        0.0 if use.deramped else walk + curve,
        "work in two dimensions",
    )


def _rebuild_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    """Errors of what the reconstruction assumes, as phase between the outermost channels' reference
    and each channel.
    """
    if use.rebuild.refusal(radar.channels) is not None or use.rebuild.bands == 1:
        return
    v, reach = radar.speed_m_s, max(abs(x) for x in radar.channel_m)
    slant = 2 * math.pi * use.u_r_error_m_s * reach / (radar.wavelength_m * v)
    along = math.pi * _bandwidth_hz(radar, use) * use.u_a_error_m_s * reach / v**2
    flat = torch.ones(_POINTS, 1, dtype=torch.float64)
    linear = flat * radar.channels_at() / max(reach, 1e-12)
    sweep = torch.linspace(-1, 1, _POINTS, dtype=torch.float64)[:, None]
    remedy = f"bring it down for replicas below {use.replica_db:g} dB"

    def row(effect: str, phase: float, shapes: list[Tensor]) -> Requirement:
        level = max((_replica_share(radar, use, phase * shape) for shape in shapes), default=0.0)
        tolerance = phase * 10 ** (use.replica_db / 20) / level if level > 0 else math.inf
        return Requirement(
            effect,
            f"phase between channels, replica at {20 * math.log10(max(level, 1e-15)):.1f} dB",
            phase,
            math.nan,
            tolerance,
            remedy,
        )

    yield row(f"u_r wrong by {use.u_r_error_m_s:g} m/s in the reconstruction", slant, [linear])
    yield row(f"u_a wrong by {use.u_a_error_m_s:g} m/s in the reconstruction", along, [sweep * linear])
    shapes = [*(flat * one for one in torch.eye(radar.channels, dtype=torch.float64)), linear]
    yield row(
        f"a channel's phase wrong by {math.degrees(use.channel_error_rad):g} degrees", use.channel_error_rad, shapes
    )


def _replica_share(radar: BistaticRadar, use: MultichannelUse, phase_rad: Tensor) -> float:
    """Amplitude of the largest replica against the peak that phases (Doppler, channel) over the
    processed band make; the largest u_a searched, where it is worse.
    """
    shares = []
    for u_a in (0.0, *use.u_a_m_s):
        motion = PointMotion.of(radar, torch.zeros(()), 0.0, u_a)
        half = min(_bandwidth_hz(radar, use, 0.0, u_a), use.rebuild.bands * radar.prf_hz) / 2
        shares.append(_leak(radar, use.rebuild, motion, half, phase_rad))
    return max(shares)


def _leak(radar: BistaticRadar, rebuild: Rebuild, motion: PointMotion, half_hz: float, phase_rad: Tensor) -> float:
    bands, prf = rebuild.bands, radar.prf_hz
    doppler = half_hz * torch.linspace(-1, 1, phase_rad.shape[0], dtype=torch.float64) * (1 - 1e-9)
    place = (doppler + bands * prf / 2) / prf
    band = place.floor().long()
    weights = rebuild.weights(radar, motion, _POINTS)
    weights = weights[((place - band) * _POINTS).long().clamp_max(_POINTS - 1)] if weights.ndim == 3 else weights
    seen = band_matrix(radar, motion, bands).mT[band]
    leaked = (weights @ ((cis(phase_rad) - 1) * seen)[..., None])[..., 0]
    shares = [0.0]
    for order in range(-bands + 1, bands):
        inside = (doppler + order * prf).abs() <= half_hz
        if order and bool(inside.any()):
            shares.append(
                float((leaked.gather(-1, (band + order).clamp(0, bands - 1)[:, None])[:, 0] * inside).abs().mean())
            )
    return max(shares)


def _precision_rows(radar: BistaticRadar, tolerance_rad: float) -> Iterable[Requirement]:
    wave = 2 * math.pi / radar.wavelength_m
    for name, range_m in (("transmit", _GEO_RANGE_M), ("receive", radar.reference_range_m)):
        single = wave * range_m * 2.0**-24
        yield Requirement(
            f"{name} range in float32",
            "rounding of absolute ranges",
            single,
            math.nan,
            tolerance_rad,
            "form phases in float64 from differences (always done here)",
        )
