"""Planned use of a multichannel receiver, and the phase that each simplification neglects.

The phases are predicted from the radar, the reconstruction and bounds of the motion, before any
data are processed. `torchsar.multichannel.limits` predicts the limits of the methods.

Reference:
    Remote Sens. 2020, 12, 1703, sections 2 to 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from torchsar.core import cis
from torchsar.focus.requirements import Requirement, phase_error_db
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import LeastSquares, Rebuild, separates
from torchsar.multichannel.response import band_matrix
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range

# Phase in rad that can be neglected, by convention. It is well below the pi / 4 at which a
# quadratic phase broadens the impulse response.
FAINT_RAD = 0.3

Estimator = Literal["sir", "ati", "ml", "whitened"]


@dataclass(frozen=True)
class MultichannelUse:
    """Planned use of a radar: record, reconstruction, and bounds of the motion in the scene.

    >>> from torchsar.multichannel import MultichannelUse
    >>> MultichannelUse(n_pulse=3600, u_r_m_s=(-10.0, 5.0)).fastest_m_s
    10.0

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

    def bandwidth_hz(self, radar: BistaticRadar, u_r_m_s: float = 0.0, u_a_m_s: float = 0.0) -> float:
        """Return the processed Doppler bandwidth B_a = V^2 T / (lambda R0).

        V is the speed of the sensor relative to a target, and R0 the reference range.

        Args:
            radar: Radar parameters.
            u_r_m_s: Slant-range speed of the target in m/s.
            u_a_m_s: Along-track speed of the target in m/s, positive in the flight direction.

        Returns:
            Bandwidth in Hz.
        """
        speed2 = (radar.speed_m_s - u_a_m_s) ** 2 + u_r_m_s**2
        return speed2 * self.integration_s / (radar.wavelength_m * radar.reference_range_m)


def multichannel_requirements(
    radar: BistaticRadar, use: MultichannelUse, tolerance_rad: float = math.pi / 4
) -> tuple[Requirement, ...]:
    """Return the largest phase that each simplification neglects, with its tolerance.

    >>> from torchsar.multichannel import MultichannelUse, multichannel_requirements
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> rows = multichannel_requirements(radar, MultichannelUse(n_pulse=3600))
    >>> next(row.verdict for row in rows if row.effect == "parabolic receive range")
    'focus with the hyperbola'

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
        # rows for the slant ranges of a geosynchronous transmitter and of the receiver
        *(
            _row(
                f"{name} range in float32",
                "rounding of absolute ranges",
                2 * math.pi / radar.wavelength_m * range_m * 2.0**-24,
                tolerance_rad,
                "form phases in float64 from range differences (always done here)",
            )
            for name, range_m in (("transmit", 3.9e7), ("receive", radar.reference_range_m))
        ),
    )


def _row(
    effect: str, neglects: str, phase_rad: float, tolerance_rad: float, remedy: str, error_db: float = math.nan
) -> Requirement:
    """Return the row of a simplification that displaces no envelope."""
    return Requirement(effect, neglects, phase_rad, math.nan, tolerance_rad, remedy, error_db)


def _times(use: MultichannelUse) -> Tensor:
    """Return 65 slow times over the integration time in seconds, enough for smooth phases."""
    return use.integration_s * torch.linspace(-0.5, 0.5, 65, dtype=torch.float64)


def _transmit_rows(radar: BistaticRadar, use: MultichannelUse) -> tuple[Requirement, ...]:
    """Return the rows of simplifications of the transmit range."""
    k, half, wave = [*radar.transmit_range, 0.0, 0.0, 0.0, 0.0], use.integration_s / 2, 2 * math.pi / radar.wavelength_m
    second, beyond = wave * abs(k[1]) * half**2, wave * sum(abs(x) * half**i for i, x in enumerate(k[2:], start=3))
    time = _times(use)
    terms = [wave * x * time**i for i, x in enumerate(k, start=1)]
    first_db, second_db = (phase_error_db(sum(terms[order:], torch.zeros_like(time))) for order in (1, 2))
    spread = max(abs(x) for x in radar.channel_m) / (radar.speed_m_s - use.u_a_m_s[1])
    return (
        _row("transmit range of order 1", "its acceleration", second, FAINT_RAD, "keep k2", first_db),
        _row("transmit range of order 2", "third and higher orders", beyond, FAINT_RAD, "keep more orders", second_db),
        _row(
            "transmit range alike in all channels",
            "2 k2 dt_m t, where k1 remains in the channel response",
            wave * 2 * abs(k[1]) * spread * half,
            FAINT_RAD,
            "remove the transmit range first",
        ),
    )


def _path_rows(radar: BistaticRadar, use: MultichannelUse, tolerance_rad: float) -> tuple[Requirement, ...]:
    """Return the rows of simplifications of the receive range."""
    wave, half, r0 = 2 * math.pi / radar.wavelength_m, use.integration_s / 2, radar.reference_range_m
    time, u_r, v = _times(use), use.fastest_m_s, radar.speed_m_s - use.u_a_m_s[0]
    # a broadside point at the extreme velocities of the search and at u_r = 0, (corner, time)
    speeds = [torch.tensor(u, dtype=torch.float64) for u in ((*use.u_r_m_s, 0.0), use.u_a_m_s)]
    across, along = (u.reshape(-1, 1) for u in torch.meshgrid(*speeds, indexing="ij"))
    exact = receive_range(time, across, along, 0.0, r0, radar.speed_m_s, 0.0)
    parabola = exact + across * time - (radar.speed_m_s - along).square() * time.square() / (2 * r0)
    # range of each channel by Eqs. (6) and (7), (corner, channel, time)
    across, along, dx = across[:, None], along[:, None], radar.channels_at()[:, None]
    past = radar.speed_m_s - along
    delayed = time - dx * past / (past.square() + across.square())
    left_m = receive_range(time, across, along, 0.0, r0, radar.speed_m_s, dx)
    left_m = left_m - receive_range(delayed, across, along, 0.0, r0, radar.speed_m_s, 0.0)
    ground = u_r * r0 / math.sqrt(r0**2 - radar.height_m**2)
    refit = "refit u_a per target, and do not interpret it as a speed"
    return (
        _row(
            "parabolic receive range",
            "third and higher orders of the hyperbola",
            wave * float(parabola.abs().max()),
            tolerance_rad,
            "focus with the hyperbola",
            max(phase_error_db(wave * left) for left in parabola),
        ),
        _row(
            "channels as delays of one another",
            "second and higher orders of the path between channels",
            wave * float((left_m - left_m.mean(-1, keepdim=True)).abs().max()),
            tolerance_rad,
            "shorten the row of channels",
        ),
        _row(
            "y0 left out of the azimuth filter",
            "change of the closest range, u_r y0 / v",
            wave * u_r * use.y0_m * v * half**2 / (2 * r0**2),
            FAINT_RAD,
            "give y0 to the filter",
        ),
        _row(
            "motion in the slant plane",
            "curvature of motion on the ground, absorbed by u_a",
            wave * (ground * radar.height_m * half) ** 2 / (2 * r0**3),
            tolerance_rad,
            refit,
        ),
        _row(
            "no radial acceleration",
            "its quadratic phase, absorbed by u_a",
            wave * use.acceleration_m_s2 * half**2 / 2,
            tolerance_rad,
            refit,
        ),
    )


def _migration_rows(radar: BistaticRadar, use: MultichannelUse) -> tuple[Requirement, ...]:
    """Return the rows of simplifications of the range migration."""
    cell, v, r0 = (
        radar.wave_speed_m_s / radar.pulse.bandwidth_hz,
        radar.speed_m_s - use.u_a_m_s[0],
        radar.reference_range_m,
    )
    curve = (v * use.integration_s) ** 2 / (8 * r0)
    walk = (use.fastest_m_s + v * use.y0_m / r0) * use.integration_s
    part = torch.linspace(-1, 1, 65, dtype=torch.float64)[:, None]

    def row(effect: str, neglects: str, curve_m: float, walk_m: float, remedy: str) -> Requirement:
        cells = (curve_m + walk_m) / cell
        path = curve_m * part.square() + walk_m / 2 * part
        error_db = phase_error_db(math.pi * path / cell * part.mT)
        return Requirement(effect, neglects, math.pi * cells, cells, math.pi / 4, remedy, error_db)

    left = (0.0, 0.0) if use.deramped else (curve, walk)
    correct, swath = "correct migration (static bulk, or deramp and keystone)", curve * use.swath_m / r0
    unknown = "walk of targets that move or lie off y0 = 0"
    return (
        row("no range migration correction", "curvature and walk", curve, walk, correct),
        row("static bulk correction, velocity unknown", unknown, 0.0, walk, "use deramp and keystone"),
        row("one reference range", "change of curvature over the swath", swath, 0.0, "work in range blocks"),
        row("azimuth only", "migration that remains after deramp and keystone", *left, "work in two dimensions"),
    )


def _rebuild_rows(radar: BistaticRadar, use: MultichannelUse) -> list[Requirement]:
    """Return the rows of errors in the reconstruction, as phases between channels."""
    if not separates(use.rebuild, radar.channels) or use.rebuild.bands == 1:
        return []
    v, reach = radar.speed_m_s, max(abs(x) for x in radar.channel_m)
    sweep = torch.linspace(-1, 1, 65, dtype=torch.float64)[:, None]
    linear = torch.ones_like(sweep) * radar.channels_at() / max(reach, 1e-12)
    one_channel = [torch.ones_like(sweep) * one for one in torch.eye(radar.channels, dtype=torch.float64)]
    errors = (
        (
            f"u_r wrong by {use.u_r_error_m_s:g} m/s in the reconstruction",
            2 * math.pi * use.u_r_error_m_s * reach / (radar.wavelength_m * v),
            [linear],
        ),
        (
            f"u_a wrong by {use.u_a_error_m_s:g} m/s in the reconstruction",
            math.pi * use.bandwidth_hz(radar) * use.u_a_error_m_s * reach / v**2,
            [sweep * linear],
        ),
        (
            f"a channel's phase wrong by {math.degrees(use.channel_error_rad):g} degrees",
            use.channel_error_rad,
            [*one_channel, linear],
        ),
    )
    rows = []
    for effect, phase, shapes in errors:
        level = max(_replica_share(radar, use, phase * shape) for shape in shapes)
        tolerance = phase * 10 ** (use.replica_db / 20) / level if level > 0 else math.inf
        seen = f"phase between channels, false target at {20 * math.log10(max(level, 1e-15)):.1f} dB"
        rows.append(_row(effect, seen, phase, tolerance, f"reduce it for false targets below {use.replica_db:g} dB"))
    return rows


def _replica_share(radar: BistaticRadar, use: MultichannelUse, phase_rad: Tensor) -> float:
    """Return the amplitude of the largest false target for phase errors (Doppler, channel).

    The largest and least u_a searched and u_a = 0 are considered.
    """
    share, bands, prf, n = 0.0, use.rebuild.bands, radar.prf_hz, len(phase_rad)
    for u_a in (0.0, *use.u_a_m_s):
        motion = PointMotion.of(radar, torch.zeros(()), 0.0, u_a)
        half_hz = min(use.bandwidth_hz(radar, 0.0, u_a), bands * prf) / 2
        doppler = half_hz * torch.linspace(-1, 1, n, dtype=torch.float64) * (1 - 1e-9)
        band_position = (doppler + bands * prf / 2) / prf
        band = band_position.floor().long()
        weights = use.rebuild.weights(radar, motion, n)
        if weights.ndim == 3:
            weights = weights[((band_position - band) * n).long().clamp_max(n - 1)]
        seen = band_matrix(radar, motion, bands).mT[band]
        leaked = (weights @ ((cis(phase_rad) - 1) * seen)[..., None])[..., 0]
        for order in filter(None, range(-bands + 1, bands)):
            inside = (doppler + order * prf).abs() <= half_hz
            if bool(inside.any()):
                false = leaked.gather(-1, (band + order).clamp(0, bands - 1)[:, None])[:, 0] * inside
                share = max(share, float(false.abs().mean()))
    return share
