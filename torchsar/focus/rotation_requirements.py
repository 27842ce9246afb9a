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

from torchsar.focus.matched_fourier import MIN_PULSES
from torchsar.focus.requirements import Limit, Requirement, phase_error_db
from torchsar.radar import InverseRadar
from torchsar.radar.warp import least_rate, warp, warp_rate

# number of samples over the aperture at which the warp is evaluated, and number of its orders that
# `rotation_requirements` lists, both by choice
_POINTS, _ORDERS = 513, 4


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
    x, lever = cross_range_m, lever_m
    if not (math.isfinite(omega_rad_s) and omega_rad_s > 0) or not all(math.isfinite(one) for one in k):
        raise ValueError(
            f"omega_rad_s must be positive (rad/s) and every k finite, got omega_rad_s={omega_rad_s} and k={list(k)}"
        )
    if not x.shape == lever.shape == amplitude.shape or x.ndim != 1 or not len(x):
        raise ValueError(
            "cross_range_m, lever_m and amplitude must have the same shape (target,), got the shapes "
            f"{tuple(x.shape)}, {tuple(lever.shape)} and {tuple(amplitude.shape)}"
        )
    warp_k, duration = torch.tensor(list(k), dtype=torch.float64), n_pulse / radar.prf_hz
    time = torch.linspace(0, duration, _POINTS, dtype=torch.float64)
    fastest = float(warp_rate(time, warp_k).max())
    doppler = 4 * omega_rad_s * fastest * float(x.abs().max()) / (radar.wavelength_m * radar.prf_hz)
    power = amplitude.abs().square()
    cell = radar.wavelength_m / (2 * omega_rad_s * float(warp(time[-1:], warp_k)))
    mean_square = (lever.square() * power).sum() / power.sum().clamp_min(torch.finfo(torch.float64).tiny)
    # noise alone exceeds 20 times its mean power with the probability exp(-20), one in 5e8
    above = power * n_pulse > 20 * noise_std**2 if noise_std > 0 else power > 0
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
            0.95,
            "",
            "refuse" if doppler > 1 else "warn",
            "the edges of the target alias",
            "raise the pulse rate, or take a narrower target",
        ),
        Limit(
            "scatterers above the noise",
            int(above.sum()),
            3,
            "",
            "refuse",
            "fewer do not determine a rotation",
            "raise the SNR or the number of pulses",
            at_least=True,
        ),
        Limit(
            "range term, pi lambda sigma_y / ra^2",
            math.pi * radar.wavelength_m * float(mean_square.sqrt()) / cell**2,
            1.0,
            "rad",
            "warn" if bool((lever != 0).any()) else "refuse",
            "the rate, and with it the scale in metres, cannot be estimated, while k1 and k2 can",
            "lengthen the aperture",
            at_least=True,
        ),
        Limit(
            "scatterers off a line through the centre",
            _off_line(x, lever, power),
            0.05,
            "",
            "warn",
            "the phases of range term and k1 are nearly equal: the rate cannot be estimated",
            "scale the image by a rate from another source",
            at_least=True,
        ),
    )
    if rate_bound is None:
        return rows
    bound = Limit(
        "Cramer-Rao bound of the rate",
        100 * rate_bound / omega_rad_s,
        5.0,
        "%",
        "warn",
        "no estimator determines the scale of the image well, while k1 and k2 focus it",
        "raise the SNR or lengthen the aperture",
    )
    return (*rows, bound)


def _off_line(x: Tensor, y: Tensor, weight: Tensor) -> float:
    """Rms share (0..1) of the ranges that no line y = s x through the centre explains. It is 0 for
    a single scatterer.
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
    time = torch.linspace(0, duration, _POINTS, dtype=torch.float64)
    turned = warp(time, warp_k) * omega_rad_s
    angle = float(turned[-1])
    walk = cross_range_m * angle / radar.range_step_m
    small = c4 * (cross_range_m * angle**3 / 6 + lever_m * angle**4 / 24)
    single = c4 * (radar.reference_range_m + lever_m) * 2.0**-24
    across = c4 * cross_range_m * omega_rad_s
    neglects = (
        "acceleration (range-Doppler)",
        "jerk and higher terms",
        "the fourth power of time and higher terms",
        "the fifth power of time and higher terms",
    )
    orders = [
        Requirement(
            f"warp of order {order}",
            neglects[order - 1],
            across * float(left.abs().max()),
            math.nan,
            tolerance_rad,
            f"use order {order + 1} or more",
            phase_error_db(across * left),
        )
        for order, left in enumerate(_legendre_left(warp_k, duration), start=1)
    ]
    band = torch.linspace(-0.5, 0.5, 17, dtype=torch.float64)
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
            math.pi * 0.2,  # phase of a migration that lowers a peak by 0.2 dB
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


def _legendre_left(k: Tensor, duration_s: float) -> list[Tensor]:
    """Sums over the aperture, in seconds, of the Legendre terms of the warp beyond the orders 1, 2,
    3 and 4.
    """
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
