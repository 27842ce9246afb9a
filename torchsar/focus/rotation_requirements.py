"""Limits of estimating a non-uniform rotation, and the phase that simplified processing neglects.

Limits and phases are computed from the radar, the rotation and the scatterers of a target, without
a simulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchsar.focus.ladar_requirements import Limit, Verdict
from torchsar.focus.matched_fourier import MIN_PULSES
from torchsar.focus.requirements import Requirement, phase_error_db
from torchsar.radar import InverseRadar
from torchsar.radar.warp import least_rate, warp, warp_rate

# chosen limits of estimating the rotation rate: phase of the range term (rad), Cramer-Rao bound
# (%), and rms share of the ranges that no line through the centre explains
VISIBLE, RATE_BOUND_PERCENT, OFF_LINE = 1.0, 5.0, 0.05
# migration in range cells at which a peak loses 0.2 dB
WALK_CELLS = 0.2
# chosen: Doppler over half the pulse rate from which on a warning is given
DOPPLER = 0.95
# power of a focused scatterer over the noise of a line; noise alone exceeds it with the probability
# exp(-20), one in 5e8
_PEAK_SNR = 20.0
# chosen: samples over the aperture at which the warp is evaluated
_POINTS = 513
# chosen: frequencies over the band at which migration is evaluated
_BAND = 17
# orders of the warp that `rotation_requirements` lists
_ORDERS = 4


def rotation_limits(
    radar: InverseRadar,
    n_pulse: int,
    omega_rad_s: float,
    k: Sequence[float],
    cross_range_m: Tensor,
    lever_m: Tensor,
    amplitude: Tensor,
    noise_std: float = 0.0,
    rate_bound: float | None = None,
) -> tuple[Limit, ...]:
    """List the limits of estimating the rotation of a target and of forming its image.

    The rotation angle is omega_rad_s (t + k1 t^2 / 2! + k2 t^3 / 3! + ...), with the time t since
    the first pulse.

    Args:
        radar: Radar of the recording.
        n_pulse: Number of pulses.
        omega_rad_s: Rotation rate at the first pulse in rad/s.
        k: Coefficients k1, k2, ... of the rotation angle in 1/s, 1/s^2, ...
        cross_range_m: Cross range of the scatterers in metres, shape (target,).
        lever_m: Range of the scatterers from the rotation centre in metres, shape (target,).
        amplitude: Amplitudes of the scatterers in range-compressed samples, shape (target,).
        noise_std: Square root of the variance of the complex noise per range-compressed sample.
        rate_bound: Cramer-Rao bound (standard deviation) of omega_rad_s in rad/s, see
            `metrics.rotation_bounds`; None leaves out the limit of this bound.

    Returns:
        One row per limit.

    Raises:
        ValueError: If the shapes differ, the rate is not positive, or a number is not finite.
    """
    _check(omega_rad_s, k, cross_range_m, lever_m, amplitude)
    warp_k, duration = torch.tensor(list(k), dtype=torch.float64), n_pulse / radar.prf_hz
    fastest = float(_rates(warp_k, duration).max())
    doppler = 4 * omega_rad_s * fastest * float(cross_range_m.abs().max()) / (radar.wavelength_m * radar.prf_hz)
    rows = (
        Limit(
            "pulses",
            n_pulse,
            MIN_PULSES,
            "",
            "refuse",
            "fewer do not determine a rotation",
            "record more",
            at_least=True,
        ),
        Limit(
            "least rotation rate over the first",
            float(least_rate(warp_k, duration)),
            1e-6,
            "",
            "refuse",
            "two times have the same angle, and no image can be formed",
            "record fewer pulses",
            at_least=True,
        ),
        Limit(
            "Doppler over half the pulse rate",
            doppler,
            DOPPLER,
            "",
            _beyond(doppler),
            "the edges of the target alias",
            "raise the pulse rate, or take a narrower target",
        ),
    )
    return (
        *rows,
        *_scene_limits(
            radar, omega_rad_s * float(_whole(warp_k, duration)), cross_range_m, lever_m, amplitude, noise_std, n_pulse
        ),
        *_bound_limit(omega_rad_s, rate_bound),
    )


def _beyond(doppler: float) -> Verdict:
    """Verdict for a Doppler above its limit."""
    return "refuse" if doppler > 1 else "warn"


def _scene_limits(
    radar: InverseRadar, angle: float, x: Tensor, lever: Tensor, amplitude: Tensor, noise_std: float, n_pulse: int
) -> tuple[Limit, ...]:
    """Limits that the scatterers set."""
    power = amplitude.abs().square()
    cell = radar.wavelength_m / (2 * angle)
    visible = math.pi * radar.wavelength_m * float(_weighted_rms(lever, power)) / cell**2
    above = int((power * n_pulse > _PEAK_SNR * noise_std**2).sum()) if noise_std > 0 else int((power > 0).sum())
    no_rate = "the rate, and with it the scale in metres, cannot be estimated, while k1 and k2 can"
    coupled = "the phases of range term and k1 are nearly equal: the rate cannot be estimated"
    no_lever: Verdict = "refuse" if not bool((lever.abs() > 0).any()) else "warn"
    return (
        Limit(
            "scatterers above the noise",
            above,
            3,
            "",
            "refuse",
            "fewer do not determine a rotation",
            "raise the SNR or the number of pulses",
            at_least=True,
        ),
        Limit(
            "range term, pi lambda sigma_y / ra^2",
            visible,
            VISIBLE,
            "rad",
            no_lever,
            no_rate,
            "lengthen the aperture",
            at_least=True,
        ),
        Limit(
            "scatterers off a line through the centre",
            _off_line(x, lever, power),
            OFF_LINE,
            "",
            "warn",
            coupled,
            "scale the image by a rate from another source",
            at_least=True,
        ),
    )


def _bound_limit(omega: float, bound: float | None) -> tuple[Limit, ...]:
    """Limit of the Cramer-Rao bound of the rate, none where the bound is not given."""
    if bound is None:
        return ()
    consequence = "no estimator determines the scale of the image well, while k1 and k2 focus it"
    return (
        Limit(
            "Cramer-Rao bound of the rate",
            100 * bound / omega,
            RATE_BOUND_PERCENT,
            "%",
            "warn",
            consequence,
            "raise the SNR or lengthen the aperture",
        ),
    )


def _weighted_rms(x: Tensor, weight: Tensor) -> Tensor:
    """Weighted root mean square."""
    return ((x.square() * weight).sum() / weight.sum().clamp_min(torch.finfo(torch.float64).tiny)).sqrt()


def _off_line(x: Tensor, y: Tensor, weight: Tensor) -> float:
    """Rms share (0..1) of the ranges that no line y = s x through the centre explains; 0 for a
    single scatterer.
    """
    if int((weight > 0).sum()) < 2:
        return 0.0
    xx, yy, xy = ((a * b * weight).sum() for a, b in ((x, x), (y, y), (x, y)))
    if not float(yy) > 0:
        return 0.0
    return math.sqrt(max(0.0, 1 - (float(xy) ** 2 / (float(xx) * float(yy)) if float(xx) > 0 else 0.0)))


def rotation_requirements(
    radar: InverseRadar,
    n_pulse: int,
    omega_rad_s: float,
    k: Sequence[float],
    cross_range_m: float,
    lever_m: float,
    tolerance_rad: float = math.pi / 4,
) -> tuple[Requirement, ...]:
    """List the largest phase that each simplification neglects for a rotating target.

    The rotation angle is omega_rad_s phi(t), with the warp phi(t) = t + k1 t^2 / 2! + ... The
    simplifications are:

    - "warp of order" 1 to 4: the Legendre terms of the warp above this order in time are neglected;
    - "azimuth only": the phase due to the range y from the rotation centre is neglected,
      2 pi y (omega_rad_s phi)^2 / wavelength. Its part linear in phi only shifts the image and is
      not counted. The rest reaches pi/4 at y = 2 (cross-range resolution)^2 / wavelength;
    - "fixed envelopes": migration through range cells is neglected, given as its phase at the ends
      of the range band;
    - "small angles": sine and cosine are replaced by their first terms;
    - "range in float32": absolute ranges are rounded to float32.

    A warp of some order and fixed envelopes are permissible where the predicted error of the image
    of a point is at most -20 dB, the other simplifications up to the phase `tolerance_rad`.

    Args:
        radar: Radar of the recording.
        n_pulse: Number of pulses.
        omega_rad_s: Rotation rate at the first pulse in rad/s.
        k: Coefficients k1, k2, ... of the warp in 1/s, 1/s^2, ...
        cross_range_m: Largest cross range of the scatterers in metres.
        lever_m: Largest range of the scatterers from the rotation centre in metres.
        tolerance_rad: Tolerated phase in rad.

    Returns:
        One `Requirement` per simplification: what it neglects, the error and the remedy.
    """
    warp_k, duration = torch.tensor(list(k), dtype=torch.float64), n_pulse / radar.prf_hz
    c4 = 4 * math.pi / radar.wavelength_m
    angle = omega_rad_s * float(_whole(warp_k, duration))
    walk = cross_range_m * angle / radar.range_step_m
    small = c4 * (cross_range_m * angle**3 / 6 + lever_m * angle**4 / 24)
    single = c4 * (radar.reference_range_m + lever_m) * 2.0**-24
    across = c4 * cross_range_m * omega_rad_s
    orders = [
        Requirement(
            f"warp of order {order}",
            _ORDER_NEGLECTS[order],
            across * float(left.abs().max()),
            math.nan,
            tolerance_rad,
            f"use order {order + 1} or more",
            phase_error_db(across * left),
        )
        for order, left in enumerate(_legendre_left(warp_k, duration), start=1)
    ]
    turned = warp(torch.linspace(0, duration, _POINTS, dtype=torch.float64), warp_k) * omega_rad_s
    band = torch.linspace(-0.5, 0.5, _BAND, dtype=torch.float64)
    migration = 2 * math.pi * band * cross_range_m / radar.range_step_m * turned[:, None]
    return (
        *orders,
        Requirement(
            "azimuth only",
            "the range term, (c4/2) y omega^2 phi^2",
            c4 / 8 * lever_m * angle**2,
            math.nan,
            tolerance_rad,
            "remove the range term (range_phase)",
        ),
        Requirement(
            "fixed envelopes (phase_only)",
            "migration through range cells",
            math.pi * walk,
            walk,
            math.pi * WALK_CELLS,
            "use the fidelity dechirped",
            phase_error_db(migration),
        ),
        Requirement(
            "small angles",
            "sin theta - theta, cos theta - 1 + theta^2 / 2",
            small,
            math.nan,
            tolerance_rad,
            "use sine and cosine",
        ),
        Requirement(
            "range in float32",
            "rounding of absolute ranges",
            single,
            math.nan,
            tolerance_rad,
            "form phases in float64 turns (always done here)",
        ),
    )


def peak_loss_db(phase_rad: Tensor) -> float:
    """Compute the loss of the peak of a response by a phase error phi, -20 log10 |mean exp(j phi)|.

    Args:
        phase_rad: Phase error phi in rad over the aperture, any shape.

    Returns:
        Loss in dB, 0 or more; a quadratic phase that reaches pi / 4 at the ends gives 0.24 dB.
    """
    return -20 * math.log10(max(float(torch.polar(torch.ones_like(phase_rad), phase_rad).mean().abs()), 1e-15))


def range_term_loss_db(warp_s: Tensor, omega_rad_s: float, lever_m: float, wavelength_m: float) -> float:
    """Compute the loss of the peak of a scatterer by the phase of its range during rotation.

    The phase is 2 pi y (omega phi)^2 / wavelength, with the range y from the rotation centre and
    the rotation angle omega phi. Its part linear in phi only shifts the peak and is not counted.

    Args:
        warp_s: Warp phi at the pulses in seconds, the rotation angle over omega, shape (pulse,).
        omega_rad_s: Rotation rate omega at the first pulse in rad/s.
        lever_m: Range y of the scatterer from the rotation centre in metres.
        wavelength_m: Wavelength in metres.

    Returns:
        Loss in dB, 0 or more.
    """
    phase = 2 * math.pi / wavelength_m * abs(lever_m) * (omega_rad_s * warp_s).square()
    scaled = warp_s / warp_s.abs().max().clamp_min(torch.finfo(torch.float64).tiny)
    line = torch.stack([torch.ones_like(scaled), scaled], -1)
    return peak_loss_db(phase - line @ torch.linalg.lstsq(line, phase[:, None]).solution[:, 0])


def order_loss_db(
    k: Tensor, order: int, duration_s: float, omega_rad_s: float, cross_range_m: float, wavelength_m: float
) -> float:
    """Compute the loss of the peak of a scatterer by a rotation model of too low an order.

    The rotation angle is omega_rad_s (t + k1 t^2 / 2! + ...). The model keeps the Legendre terms of
    this angle up to `order`; the phase of the other terms defocuses the scatterer.

    Args:
        k: Coefficients k1, k2, ... in 1/s, 1/s^2, ..., shape (coefficient,).
        order: Highest order in time that the model keeps, 1 to 4.
        duration_s: Length of the record in seconds.
        omega_rad_s: Rotation rate at the first pulse in rad/s.
        cross_range_m: Cross range of the scatterer in metres.
        wavelength_m: Wavelength in metres.

    Returns:
        Loss in dB; 0 where the angle has no terms above `order`.
    """
    across = 4 * math.pi / wavelength_m * cross_range_m * omega_rad_s
    return peak_loss_db(across * _legendre_left(k, duration_s)[order - 1])


# terms of the angle that a warp of each order neglects
_ORDER_NEGLECTS = {
    1: "acceleration (range-Doppler)",
    2: "jerk and higher terms",
    3: "the fourth power of time and higher terms",
    4: "the fifth power of time and higher terms",
}


def least_order(rows: Sequence[Requirement]) -> int:
    """Return the least order in time of the rotation angle that focuses a target well enough.

    Args:
        rows: Simplifications and their errors, as returned by `rotation_requirements`.

    Returns:
        The least order whose row is permissible; one more than the highest listed order where none
        is.
    """
    orders = [row for row in rows if row.effect.startswith("warp of order")]
    return next((i for i, row in enumerate(orders, start=1) if row.ok), len(orders) + 1)


def _legendre_left(k: Tensor, duration_s: float) -> list[Tensor]:
    """Sum (s) over the aperture of the Legendre terms of the warp beyond orders 1, 2, 3 and 4."""
    s = np.linspace(-1, 1, _POINTS)
    values = warp(torch.from_numpy((s + 1) * duration_s / 2), k).numpy()
    degree = max(_ORDERS + 1, k.shape[-1] + 1)
    terms = np.polynomial.legendre.legfit(s, values, degree)
    left = []
    for order in range(1, _ORDERS + 1):
        beyond = np.where(np.arange(degree + 1) > max(order, 1), terms, 0)
        term = torch.from_numpy(np.polynomial.legendre.legval(s, beyond))
        left.append(torch.zeros_like(term) if float(term.abs().max()) < 1e-12 * duration_s else term)
    return left


def _rates(k: Tensor, duration_s: float) -> Tensor:
    """Rate of the warp over the aperture."""
    return warp_rate(torch.linspace(0, duration_s, _POINTS, dtype=torch.float64), k)


def _whole(k: Tensor, duration_s: float) -> Tensor:
    """phi(T) in seconds."""
    return warp(torch.tensor([duration_s], dtype=torch.float64), k)[0]


def _check(omega: float, k: Sequence[float], x: Tensor, lever: Tensor, amplitude: Tensor) -> None:
    """Raise ValueError for an invalid rotation or shapes that differ."""
    if not (math.isfinite(omega) and omega > 0) or not all(math.isfinite(one) for one in k):
        raise ValueError(
            f"omega_rad_s must be positive (rad/s) and every k finite, got omega_rad_s={omega} and k={list(k)}"
        )
    if not x.shape == lever.shape == amplitude.shape or x.ndim != 1 or not len(x):
        raise ValueError(
            "cross_range_m, lever_m and amplitude must have the same shape (target,), got the shapes "
            f"{tuple(x.shape)}, {tuple(lever.shape)} and {tuple(amplitude.shape)}"
        )
