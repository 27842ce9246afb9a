"""Limits of a multichannel receiver, and the phase that each model simplification neglects.

Limits and phases are predicted from the radar, the reconstruction and bounds of the motion, before
any data are processed. Other checks are made elsewhere: `BistaticRadar` rejects empty lists of
channels and values that are not positive, every stage rejects samples that are not finite, and
estimators mark an estimate at the end of its search interval.

Reference:
    Remote Sens. 2020, 12, 1703, sections 2 to 4.
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
from torchsar.focus.requirements import Requirement, phase_error_db
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import (
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

# Threshold of interferometry and maximum likelihood over all channels and pulses, -15 dB per sample
# with three channels and 810 pulses, below which the strongest tone is often one of noise; and
# upper end of the threshold of the intensity ratio, which lies at 0 to +7 dB per sample.
GATHERED_SNR_DB, SIR_SNR_DB = 19.0, 7.0
# Convention: well below the pi / 4 at which a quadratic phase broadens the impulse response.
FAINT_RAD = 0.3
# Samples over the aperture, the Doppler band and half the search interval: maxima of smooth curves
# are found closely enough for a limit.
_POINTS = 65

Estimator = Literal["sir", "ati", "ml", "whitened"]


@dataclass(frozen=True)
class MultichannelUse:
    """Planned use of a radar: record, reconstruction, and bounds of the motion in the scene.

    Args:
        n_pulse: Number of pulses of the record.
        integration_s: Integration time T of an image in seconds.
        rebuild: Reconstruction method.
        pattern: True if targets fade by the element pattern, False if their echoes end at +-T / 2.
        u_r_m_s: Least and largest slant-range speed searched in m/s, closing positive.
        u_a_m_s: Least and largest along-track speed searched in m/s.
        y0_m: Largest magnitude of the along-track position y0 of a target at t = 0 in metres.
        acceleration_m_s2: Largest radial acceleration in m/s^2.
        swath_m: Range swath to either side of the reference range in metres.
        snr_db: SNR of a range-compressed sample of one channel in dB, None where unknown.
        clutter: Whether stationary clutter is present beside the targets.
        estimators: Velocity estimators in use.
        deramped: Whether the keystone transform works on deramped data.
        dtype: Dtype of the data.
        u_r_error_m_s: Expected error of the slant-range speed in the reconstruction in m/s.
        u_a_error_m_s: Expected error of the along-track speed in the reconstruction in m/s.
        channel_error_rad: Expected phase error of a channel in radians.
        replica_db: Highest accepted false target relative to the peak in dB.

    Raises:
        ValueError: If bounds are out of order or not finite, the record is empty, or a magnitude is
            negative.
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
                raise ValueError(f"{name} must be (least, largest) velocity, finite and in order, got {(low, high)}")
        if self.n_pulse < 1 or not self.integration_s > 0:
            raise ValueError(
                "a record needs n_pulse of 1 or more and a positive integration_s, got "
                f"n_pulse={self.n_pulse} and integration_s={self.integration_s}"
            )
        names = ("y0_m", "acceleration_m_s2", "swath_m", "u_r_error_m_s", "u_a_error_m_s", "channel_error_rad")
        wrong = {name: getattr(self, name) for name in names if not 0 <= getattr(self, name) < math.inf}
        if wrong:
            raise ValueError(
                f"{', '.join(wrong)} must be finite and not negative, got "
                f"{', '.join(f'{name}={value}' for name, value in wrong.items())}"
            )

    @property
    def fastest_m_s(self) -> float:
        """Largest magnitude of the slant-range speeds that are searched, in m/s."""
        return max(abs(u) for u in self.u_r_m_s)


def _bandwidth_hz(radar: BistaticRadar, use: MultichannelUse, u_r: float = 0.0, u_a: float = 0.0) -> float:
    """Return the processed Doppler bandwidth B_a = V^2 T / (lambda R0) in Hz."""
    return ((radar.speed_m_s - u_a) ** 2 + u_r**2) * use.integration_s / (radar.wavelength_m * radar.reference_range_m)


def multichannel_limits(radar: BistaticRadar, use: MultichannelUse) -> tuple[Limit, ...]:
    """Return the limits of reconstruction, estimation and imaging for a use of the radar.

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


def _record_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Yield the limits of the length of the record."""
    record, slowest = use.n_pulse / radar.prf_hz, radar.speed_m_s - use.u_a_m_s[1]
    yield Limit(
        "record",
        record,
        use.integration_s,
        "s",
        "refuse",
        "it is shorter than the integration time",
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
        "targets are displaced beyond the record and wrap around in azimuth",
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
            "false targets two PRFs away wrap around onto other positions",
            "record longer",
            at_least=True,
        )


def _band_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Yield the limits of the Doppler bandwidth."""
    bands, rebuilt = use.rebuild.bands, use.rebuild.bands * radar.prf_hz
    needed = _bandwidth_hz(radar, use, use.fastest_m_s, use.u_a_m_s[0])
    if use.rebuild.refusal(radar.channels) is not None or isinstance(use.rebuild, LeastSquares):
        yield Limit(
            "channels",
            radar.channels,
            bands,
            "",
            "refuse",
            "more bands than channels cannot be separated without a prior",
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
        yield Limit(
            "Doppler band inside the intensity ratio",
            _bandwidth_hz(radar, use),
            rebuilt,
            "Hz",
            "refuse",
            "the intensity ratio has no band outside the signal",
            "rebuild more bands, or integrate less",
        )


def _channel_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Yield the limits of the condition number; only a least-squares inverse has them."""
    bands = use.rebuild.bands
    if isinstance(use.rebuild, MinimumMeanSquare) or bands > radar.channels or bands == 1:
        return
    rest = float(condition_number(radar, PointMotion.of(radar, torch.zeros(())), bands))
    least = SINGULAR if use.dtype == torch.complex128 else SINGULAR_SINGLE
    same = (
        f"at a pulse rate of {radar.prf_hz:g} Hz and {radar.speed_m_s:g} m/s channels sample "
        f"the same positions, and {bands} bands cannot be separated"
    )
    other = "rebuild fewer bands, use MinimumMeanSquare, or change the pulse rate"
    yield Limit("condition number at rest", rest, least, "", "refuse", same, other)
    u_a = torch.linspace(*use.u_a_m_s, 2 * _POINTS - 1, dtype=torch.float64)
    u_r = torch.tensor([*use.u_r_m_s], dtype=torch.float64)[:, None]
    within = condition_number(radar, PointMotion.of(radar, u_a, u_r, u_a), bands).amax(0)
    speed = float(u_a[int(within.argmax())])
    yield Limit(
        "condition number within the velocities",
        float(within.max()),
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
    turns_per_s = {round(abs(a - b), 9) * prf for i, a in enumerate(positions) for b in positions[:i]}
    least, most = (1 / (radar.speed_m_s - u_a) for u_a in u_a_m_s)
    speeds = {
        rate / q
        for rate in turns_per_s
        for q in range(max(1, math.ceil(rate * least - 1e-9)), math.floor(rate * most + 1e-9) + 1)
    }
    return sorted(radar.speed_m_s - v for v in speeds if _count_different(positions, prf / v) < bands)


def _count_different(positions: tuple[float, ...], turns_per_m: float) -> int:
    """Return the number of channel positions whose phases differ by other than whole cycles."""
    turns = [position * turns_per_m for position in positions]
    off = [[abs((x - before + 0.5) % 1 - 0.5) for before in turns[:i]] for i, x in enumerate(turns)]
    return sum(all(cycles > 1e-6 for cycles in row) for row in off)  # more than rounding


def _tone_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Yield the limits of the Doppler ambiguity."""
    half, centre = radar.ambiguous_velocity_m_s / 2, use.fastest_m_s
    yield Limit(
        "slant-range speed",
        centre,
        0.95 * half,  # convention
        "m/s",
        "warn",
        "velocities are measured modulo lambda PRF, and appear at the other end of the interval",
        "resolve the ambiguity by range walk, or raise the pulse rate",
    )
    tone = centre + (radar.speed_m_s - use.u_a_m_s[0]) * use.y0_m / radar.reference_range_m
    yield Limit(
        "tone left for the keystone transform",
        tone,
        half,
        "m/s",
        "warn",
        "the keystone transform assumes a wrong multiple of the pulse rate",
        "give the ambiguity number",
    )
    if not use.deramped:
        yield Limit(
            "Doppler band for the keystone transform",
            _bandwidth_hz(radar, use),
            radar.prf_hz,
            "Hz",
            "warn",
            "the keystone transform defocuses data that are aliased in slow time",
            "deramp before it",
        )


def _estimator_limits(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Limit]:
    """Yield the limits of the velocity estimators."""
    if use.clutter and "sir" in use.estimators:
        yield Limit(
            "stationary clutter beside the intensity ratio",
            1,
            1,
            "",
            "warn",
            "the ratio has its maximum at u_r = 0 for any motion of the target",
            "whiten, or suppress the clutter first",
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
            "estimates below the threshold have gross errors",
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
    """Return the largest phase that each simplification neglects, with its tolerance.

    For a truncated transmit range, a parabolic receive range and range migration, the relative
    error of the response of a point is predicted too; it decides whether the simplification is
    permissible. For all other simplifications the phase decides.

    Range migration is stated as the phase at the ends of the range band: a shift by a quarter of a
    resolution cell c / B is pi / 4 there. Quadratic phases are stated at the ends of the aperture.
    A term "absorbed by u_a" is focused by another value of the along-track speed u_a.

    The tolerance is 0.3 rad for the transmit range and for an along-track position y0 that is left
    out of the azimuth filter, and pi / 4 for range migration. For errors of the reconstruction it
    is the phase that causes a false target at the level `use.replica_db`. For the others it is
    `tolerance_rad`.

    Args:
        radar: Radar parameters.
        use: Record, reconstruction and bounds of the motion.
        tolerance_rad: Tolerance in radians of the other simplifications.

    Returns:
        One `Requirement` per simplification: what it neglects, the error and the remedy.
    """
    return (
        *_transmit_rows(radar, use),
        *_path_rows(radar, use, tolerance_rad),
        *_migration_rows(radar, use),
        *_rebuild_rows(radar, use),
        *_precision_rows(radar, tolerance_rad),
    )


def _transmit_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    """Yield the rows of the transmit range."""
    k, half, wave = [*radar.transmit_range, 0.0, 0.0, 0.0, 0.0], use.integration_s / 2, 2 * math.pi / radar.wavelength_m
    second, beyond = wave * abs(k[1]) * half**2, wave * sum(abs(x) * half**i for i, x in enumerate(k[2:], start=3))
    time = _aperture_times(use)
    terms = [wave * x * time**i for i, x in enumerate(k, start=1)]
    error_db = [phase_error_db(sum(terms[order:], torch.zeros_like(time))) for order in (1, 2)]
    yield Requirement(
        "transmit range of order 1", "its acceleration", second, math.nan, FAINT_RAD, "keep k2", error_db[0]
    )
    yield Requirement(
        "transmit range of order 2",
        "third and higher orders",
        beyond,
        math.nan,
        FAINT_RAD,
        "keep more orders",
        error_db[1],
    )
    spread = max(abs(x) for x in radar.channel_m) / (radar.speed_m_s - use.u_a_m_s[1])
    yield Requirement(
        "transmit range alike in all channels",
        "2 k2 dt_m t, where k1 remains in the channel response",
        wave * 2 * abs(k[1]) * spread * half,
        math.nan,
        FAINT_RAD,
        "remove the transmit range first",
    )


def _path_rows(radar: BistaticRadar, use: MultichannelUse, tolerance_rad: float) -> Iterable[Requirement]:
    """Yield the rows of the receive range."""
    wave, half, r0, u_r = (
        2 * math.pi / radar.wavelength_m,
        use.integration_s / 2,
        radar.reference_range_m,
        use.fastest_m_s,
    )
    v, time = radar.speed_m_s - use.u_a_m_s[0], _aperture_times(use)
    # a broadside point at the corners of the velocities searched, including u_r = 0: (corner, time)
    speeds = [torch.tensor(u, dtype=torch.float64) for u in ((*use.u_r_m_s, 0.0), use.u_a_m_s)]
    across, along = (u.reshape(-1, 1) for u in torch.meshgrid(*speeds, indexing="ij"))
    exact = receive_range(time, across, along, 0.0, r0, radar.speed_m_s, 0.0)
    parabola = exact + across * time - (radar.speed_m_s - along).square() * time.square() / (2 * r0)
    # Eqs. (6), (7), (corner, channel, time)
    across, along, dx = across[:, None], along[:, None], radar.channels_at()[:, None]
    past = radar.speed_m_s - along
    delayed = time - dx * past / (past.square() + across.square())
    left_m = receive_range(time, across, along, 0.0, r0, radar.speed_m_s, dx)
    left_m = left_m - receive_range(delayed, across, along, 0.0, r0, radar.speed_m_s, 0.0)
    yield Requirement(
        "parabolic receive range",
        "third and higher orders of the hyperbola",
        wave * float(parabola.abs().max()),
        math.nan,
        tolerance_rad,
        "focus with the hyperbola",
        max(phase_error_db(wave * left) for left in parabola),
    )
    yield Requirement(
        "channels as delays of one another",
        "second and higher orders of the path between channels",
        wave * float((left_m - left_m.mean(-1, keepdim=True)).abs().max()),
        math.nan,
        tolerance_rad,
        "shorten the row of channels",
    )
    yield Requirement(
        "y0 left out of the azimuth filter",
        "change of the closest range, u_r y0 / v",
        wave * u_r * use.y0_m * v * half**2 / (2 * r0**2),
        math.nan,
        FAINT_RAD,
        "give y0 to the filter",
    )
    ground = u_r * r0 / math.sqrt(r0**2 - radar.height_m**2)
    yield Requirement(
        "motion in the slant plane",
        "curvature of motion on the ground, absorbed by u_a",
        wave * (ground * radar.height_m * half) ** 2 / (2 * r0**3),
        math.nan,
        tolerance_rad,
        "refit u_a per target, and do not interpret it as a speed",
    )
    yield Requirement(
        "no radial acceleration",
        "its quadratic phase, absorbed by u_a",
        wave * use.acceleration_m_s2 * half**2 / 2,
        math.nan,
        tolerance_rad,
        "refit u_a per target, and do not interpret it as a speed",
    )


def _aperture_times(use: MultichannelUse) -> Tensor:
    """Return slow times over the integration time in seconds."""
    return use.integration_s * torch.linspace(-0.5, 0.5, _POINTS, dtype=torch.float64)


def _migration_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    """Yield the rows of the range migration."""
    cell, u_r = radar.wave_speed_m_s / radar.pulse.bandwidth_hz, use.fastest_m_s
    v, r0 = radar.speed_m_s - use.u_a_m_s[0], radar.reference_range_m
    curve = (v * use.integration_s) ** 2 / (8 * r0)
    walk = (u_r + v * use.y0_m / r0) * use.integration_s
    part = torch.linspace(-1, 1, _POINTS, dtype=torch.float64)[:, None]

    def row(effect: str, neglects: str, curve_m: float, walk_m: float, remedy: str) -> Requirement:
        cells = (curve_m + walk_m) / cell
        path = curve_m * part.square() + walk_m / 2 * part
        error_db = phase_error_db(math.pi * path / cell * part.mT)
        return Requirement(effect, neglects, math.pi * cells, cells, math.pi / 4, remedy, error_db)

    yield row(
        "no range migration correction",
        "curvature and walk",
        curve,
        walk,
        "correct migration (static bulk, or deramp and keystone)",
    )
    yield row(
        "static bulk correction, velocity unknown",
        "walk of targets that move or lie off y0 = 0",
        0.0,
        walk,
        "use deramp and keystone",
    )
    yield row(
        "one reference range",
        "change of curvature over the swath",
        curve * use.swath_m / r0,
        0.0,
        "work in range blocks",
    )
    left = (0.0, 0.0) if use.deramped else (curve, walk)
    yield row("azimuth only", "migration that remains after deramp and keystone", *left, "work in two dimensions")


def _rebuild_rows(radar: BistaticRadar, use: MultichannelUse) -> Iterable[Requirement]:
    """Yield the rows of errors in the reconstruction, as phases between channels."""
    if use.rebuild.refusal(radar.channels) is not None or use.rebuild.bands == 1:
        return
    v, reach = radar.speed_m_s, max(abs(x) for x in radar.channel_m)
    slant = 2 * math.pi * use.u_r_error_m_s * reach / (radar.wavelength_m * v)
    along = math.pi * _bandwidth_hz(radar, use) * use.u_a_error_m_s * reach / v**2
    flat = torch.ones(_POINTS, 1, dtype=torch.float64)
    linear = flat * radar.channels_at() / max(reach, 1e-12)
    sweep = torch.linspace(-1, 1, _POINTS, dtype=torch.float64)[:, None]
    remedy = f"reduce it for false targets below {use.replica_db:g} dB"

    def row(effect: str, phase: float, shapes: list[Tensor]) -> Requirement:
        level = max((_replica_share(radar, use, phase * shape) for shape in shapes), default=0.0)
        tolerance = phase * 10 ** (use.replica_db / 20) / level if level > 0 else math.inf
        return Requirement(
            effect,
            f"phase between channels, false target at {20 * math.log10(max(level, 1e-15)):.1f} dB",
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
    """Return the amplitude of the largest false target for phase errors (Doppler, channel).

    The largest and least u_a searched and u_a = 0 are considered.
    """
    shares = [0.0]
    bands, prf = use.rebuild.bands, radar.prf_hz
    for u_a in (0.0, *use.u_a_m_s):
        motion = PointMotion.of(radar, torch.zeros(()), 0.0, u_a)
        half_hz = min(_bandwidth_hz(radar, use, 0.0, u_a), bands * prf) / 2
        doppler = half_hz * torch.linspace(-1, 1, phase_rad.shape[0], dtype=torch.float64) * (1 - 1e-9)
        band_position = (doppler + bands * prf / 2) / prf
        band = band_position.floor().long()
        weights = use.rebuild.weights(radar, motion, _POINTS)
        weights = (
            weights[((band_position - band) * _POINTS).long().clamp_max(_POINTS - 1)] if weights.ndim == 3 else weights
        )
        seen = band_matrix(radar, motion, bands).mT[band]
        leaked = (weights @ ((cis(phase_rad) - 1) * seen)[..., None])[..., 0]
        for order in range(-bands + 1, bands):
            inside = (doppler + order * prf).abs() <= half_hz
            if order and bool(inside.any()):
                shares.append(
                    float((leaked.gather(-1, (band + order).clamp(0, bands - 1)[:, None])[:, 0] * inside).abs().mean())
                )
    return max(shares)


def _precision_rows(radar: BistaticRadar, tolerance_rad: float) -> Iterable[Requirement]:
    """Yield the rows of ranges in single precision."""
    wave = 2 * math.pi / radar.wavelength_m
    # the slant range of a geosynchronous transmitter, and that of the receiver
    for name, range_m in (("transmit", 3.9e7), ("receive", radar.reference_range_m)):
        single = wave * range_m * 2.0**-24
        yield Requirement(
            f"{name} range in float32",
            "rounding of absolute ranges",
            single,
            math.nan,
            tolerance_rad,
            "form phases in float64 from range differences (always done here)",
        )
