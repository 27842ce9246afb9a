"""Cramer-Rao bounds of the parameters of the non-uniform rotation of a rigid target."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import per_trial, refuse_non_finite
from torchsar.radar.warp import warp

# eigenvalues of a correlation matrix below this are float64 rounding errors and count as zero
_SINGULAR = 1e-13
# If the square of an unknown's component in an unobservable direction exceeds this limit of float64
# rounding, its bound is infinite.
_INVOLVED = 1e-12


def rotation_bounds(
    cross_range_m: Tensor,
    range_m: Tensor,
    amplitude: Tensor,
    noise_std: Tensor | float,
    omega_rad_s: Tensor | float,
    warp_k: Tensor,
    yc_m: Tensor | float = 0.0,
    *,
    wavelength_m: float,
    prf_hz: float,
    n_pulse: int,
    free_centre: bool = True,
) -> dict[str, Tensor]:
    """Compute the least standard deviations of the rotation parameters of a target.

    >>> import torch
    >>> from torchsar import metrics
    >>> x, y = torch.tensor([-10.0, 0.0, 10.0]), torch.tensor([5.0, -5.0, 0.0])  # three scatterers
    >>> turntable = {"wavelength_m": 0.03, "prf_hz": 100.0, "n_pulse": 256}
    >>> rate = 0.02, torch.tensor([0.1])  # rad/s, and its relative change per second
    >>> bounds = metrics.rotation_bounds(x, y, torch.ones(3), 0.1, *rate, **turntable)
    >>> {name: float(f"{float(std):.2g}") for name, std in bounds.items()}
    {'omega_rad_s': 0.00014, 'k1_per_s': 0.0002, 'yc_m': 0.049}

    The rotation angle is Om phi(t), with the rate Om at the first pulse and the warped time phi(t)
    = t + k1 t^2 / 2! + k2 t^3 / 3! + ... The range centre deviation yc is the distance by which the
    rotation centre differs from the assumed one. Noise and ranges are known; the complex amplitude
    and the cross range of every scatterer are unknown. The bounds are those of the Fisher
    information

        J_ij = (2 / noise_std^2) sum_p |s_p|^2 <P d_i, P d_j>,    c4 = 4 pi / wavelength,
        d_Om = c4 y Om phi^2,    d_yc = (c4 / 2) Om^2 phi^2,
        d_ki = c4 (-x Om + y Om^2 phi) t^(i+1) / (i+1)!

    where scatterer p has the amplitude s_p, the cross range x and the distance y in range from the
    rotation centre, d_i is the derivative of its phase with respect to unknown i, <,> sums over the
    pulses, and P removes a constant and a multiple of phi, which the unknown amplitude and cross
    range absorb.

    Overlapping scatterers raise the true bound above this one. If all scatterers have the same
    range, the bounds of Om and yc are infinite and those of k1, k2, ... finite. The bounds are
    proportional to 10^(-SNR / 20) with the SNR in dB. Differentiable.

    Args:
        cross_range_m: Cross range of the resolved scatterers in metres, shape (..., target).
        range_m: Range of the scatterers in metres from the centre that the processor assumes, shape
            (..., target); range_m + yc_m is the distance from the rotation centre.
        amplitude: Amplitude of a range-compressed sample at the peak of the range response, shape
            (..., target).
        noise_std: Square root of the variance of the complex noise per sample, shape (...,).
        omega_rad_s: Rotation rate at the first pulse in rad/s, shape (...,).
        warp_k: Derivatives k1, k2, ... of the rotation rate divided by the rate, in 1/s, 1/s^2,
            ..., shape (..., order - 1), of any order; see `radar.warp`.
        yc_m: Range centre deviation in metres, shape (...,).
        wavelength_m: Carrier wavelength in metres.
        prf_hz: Pulse rate in Hz.
        n_pulse: Number of pulses.
        free_centre: Whether yc_m is an unknown.

    Returns:
        Bounds of `omega_rad_s`, `k1_per_s`, `k2_per_s2`, ... and, with `free_centre`, `yc_m`, shape
        (...,) each, float64; infinite where the data do not determine the unknown.

    Raises:
        ValueError: If shapes do not fit, wavelength or pulse rate are not positive, or the Fisher
            information is not finite.
    """
    _check(cross_range_m, range_m, amplitude, warp_k)
    if not (wavelength_m > 0 and prf_hz > 0):
        raise ValueError(f"rotation_bounds: wavelength_m and prf_hz must be positive, got {wavelength_m} and {prf_hz}")
    x, k = cross_range_m.to(torch.float64), warp_k.to(torch.float64)
    lever = range_m.to(torch.float64) + per_trial(yc_m, 1, x)
    slopes = _slopes(x, lever, per_trial(omega_rad_s, 1, x), k.shape[-1], free_centre) * (4 * math.pi / wavelength_m)
    weighted = slopes * amplitude.abs().to(torch.float64)[..., None, None, :]
    products = _products(k, n_pulse, prf_hz)[..., None, :, :] @ weighted
    information = weighted.flatten(-2) @ products.flatten(-2).mT
    unit = _standard_deviations(information)
    noise = per_trial(noise_std, 1, x) / math.sqrt(2)
    bounds = torch.where(torch.isinf(unit), unit, unit * noise)
    names = [
        "omega_rad_s",
        *(f"k{i}_per_s{i if i > 1 else ''}" for i in range(1, k.shape[-1] + 1)),
        *(["yc_m"] if free_centre else []),
    ]
    return dict(zip(names, bounds.unbind(-1), strict=True))


def _check(cross_range_m: Tensor, range_m: Tensor, amplitude: Tensor, warp_k: Tensor) -> None:
    """Raise ValueError for shapes that do not fit."""
    counts = [x.shape[-1] if x.ndim else None for x in (cross_range_m, range_m, amplitude)]
    if None in counts or len(set(counts)) > 1:
        shapes = ", ".join(str(tuple(x.shape)) for x in (cross_range_m, range_m, amplitude))
        raise ValueError(
            "rotation_bounds: cross_range_m, range_m and amplitude must have the shape (..., target) with "
            f"equally many targets, got the shapes {shapes}"
        )
    if not warp_k.ndim:
        raise ValueError(
            "rotation_bounds: warp_k must have the shape (..., order - 1), got a tensor without dimensions; "
            "write torch.zeros(0) for uniform rotation"
        )


def _slopes(x: Tensor, lever: Tensor, omega: Tensor, terms: int, free_centre: bool) -> Tensor:
    """Coefficients of the curves of `_products` in the phase derivatives, (..., unknown, curve,
    target).

    A derivative is that of the phase of a scatterer with respect to one unknown, without the factor
    c4.
    """
    zero = torch.zeros_like(x * lever * omega)
    turned, bent, square = zero - x * omega, lever * omega.square() + zero, 2 * terms
    rows = [{square: lever * omega + zero}]
    rows += [{i: turned, terms + i: bent} for i in range(terms)]
    rows += [{square: omega.square() / 2 + zero}] if free_centre else []
    return torch.stack([torch.stack([row.get(curve, zero) for curve in range(square + 1)], -2) for row in rows], -3)


def _products(k: Tensor, n_pulse: int, prf_hz: float) -> Tensor:
    """Inner products of the curves of the phase over the pulses, (..., curve, curve).

    The curves are t^i / i! for i = 2, 3, ..., then phi t^i / i!, and last phi^2. Their components
    along 1 and phi are removed.
    """
    time = torch.arange(n_pulse, dtype=torch.float64, device=k.device) / prf_hz
    phi = warp(time, k)
    powers = [(time ** (i + 2) / math.factorial(i + 2)).expand_as(phi) for i in range(k.shape[-1])]
    curves = torch.stack([*powers, *(phi * power for power in powers), phi.square()], -2)
    line = phi - phi.mean(-1, keepdim=True)
    line = (line / line.square().sum(-1, keepdim=True).sqrt().clamp_min(torch.finfo(torch.float64).tiny))[..., None, :]
    for _ in range(2):  # the second pass removes rounding errors of the first
        curves = curves - curves.mean(-1, keepdim=True)
        curves = curves - (curves * line).sum(-1, keepdim=True) * line
    return curves @ curves.mT


def _standard_deviations(information: Tensor) -> Tensor:
    """Standard deviations from Fisher information (..., n, n): roots of the diagonal of its
    inverse, (..., n).

    They are infinite for unknowns with a component in an unobservable direction.
    """
    refuse_non_finite(
        information,
        "rotation_bounds: the Fisher information",
        "give finite parameters of a possible instrument",
        "elements",
    )
    size = information.diagonal(dim1=-2, dim2=-1)
    root = torch.where(size > 0, size, 1).rsqrt()
    unit = information * root[..., :, None] * root[..., None, :]
    value, vector = torch.linalg.eigh(unit.detach())
    unobservable = vector * (value < _SINGULAR)[..., None, :]
    unobservable = unobservable @ unobservable.mT
    share = unobservable.diagonal(dim1=-2, dim2=-1)
    variance = torch.linalg.inv(unit + unobservable).diagonal(dim1=-2, dim2=-1) - share
    return torch.where(share > _INVOLVED, torch.inf, variance.clamp_min(0).sqrt() * root)
