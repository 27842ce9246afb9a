"""What no estimator of uneven rotation can beat: the Cramer-Rao bound of the motion that all scatterers of a turning target share (brief 003)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import legendre, per_trial
from torchsar.core.warp import warp

_SINGULAR = 1e-13  # eigenvalues of a correlation matrix below it are rounding
_TOUCHED = 1e-12  # squared share of an unknown in a direction that nothing is known about


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
    """Least standard deviations of omega_rad_s, k1_per_s, k2_per_s2, ... and, with free_centre, yc_m: float64 (...,) each, infinite where the data tell nothing.

    cross_range_m, range_m, amplitude: (..., target), places (m) and amplitudes of resolved scatterers in range-compressed data, an amplitude being that of a sample at the
    peak of the range response; range_m counts from where the processor takes the centre to be, so that range_m + yc_m is the distance from the rotation centre (the
    `lever` of `echo.turntable_echo`). noise_std: of the complex noise, noise power = noise_std^2 a sample. warp_k: (..., order - 1) of any order, see `core.warp`. Trials broadcast.

    Noise known; complex amplitude and cross range of every scatterer unknown and its range known: what is left of phase derivatives once a constant and a line in
    the warp phi are taken out tells about the motion, J_ij = (2 / noise_std^2) sum_p |s_p|^2 <P d_i, P d_j>, c4 = 4 pi / wavelength,
    d_Om = c4 y Om phi^2, d_ki = c4 (-x Om + y Om^2 phi) t^(i+1) / (i+1)!, d_yc = (c4 / 2) Om^2 phi^2.
    Neighbours that overlap only raise it. All scatterers at one range leave Om (and a free yc) infinite, k finite. Falls as 10^(-SNR / 20). Differentiable.
    Raises ValueError for shapes that do not fit, and for fewer pulses than the warp has terms.
    """
    _refuse(cross_range_m, range_m, amplitude, warp_k, n_pulse)
    x, k = cross_range_m.to(torch.float64), warp_k.to(torch.float64)
    omega, yc = per_trial(omega_rad_s, 1, x), per_trial(yc_m, 1, x)
    slopes = _slopes(x, range_m.to(torch.float64) + yc, omega, k.shape[-1], 4 * math.pi / wavelength_m, free_centre)
    weight = slopes * amplitude.abs().to(torch.float64)[..., None, :]
    gram = (weight[..., :, None, :, None, :] * weight[..., None, :, None, :, :]).sum(-1)  # (..., unknown, unknown, base, base)
    information = (gram * _products(k, n_pulse, prf_hz)[..., None, None, :, :]).sum((-2, -1))
    return _named(_deviations(information), per_trial(noise_std, 0, x) / math.sqrt(2), free_centre)
