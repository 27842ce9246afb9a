"""What no unbiased estimator can beat: Cramer-Rao bounds, beside the published reference curve of
system 004.

q is everywhere the peak signal-to-noise power ratio of a point after two-dimensional compression,
equal to (signal energy) / (noise variance per sample). All functions take numbers or tensors that
broadcast and return float64.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

Value = Tensor | float


def _double(value: Value) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def tone_frequency_bound_hz(q: Value, duration_s: Value) -> Tensor:
    """Cramer-Rao bound of the frequency of a tone of unknown phase and amplitude: sqrt(6) / (2 pi T
    sqrt(q)) = 0.39 / (T sqrt(q)).

    Also that of the Doppler of one point at the middle of its aperture, after its known quadratic
    phase is taken out.
    """
    return math.sqrt(6) / (2 * math.pi * _double(duration_s) * torch.sqrt(_double(q)))


def reference_doppler_std_hz(q: Value, duration_s: Value) -> Tensor:
    """The curve of Tsvetkov 2017 (text after Fig.

    5), 1 / (T sqrt(q)): 2.6 times the bound of a tone.

    It speaks of a point whose place in the beam is known. The centroid of the beam itself, seen
    through one point, obeys `beam_centre_bound_hz`.
    """
    return 1 / (_double(duration_s) * torch.sqrt(_double(q)))


def beam_centre_bound_hz(gain: Tensor, q: Value, rate_hz_s: Value, prf_hz: float) -> Tensor:
    """Bound of the Doppler centroid of a beam seen through one point whose own place is not known.

    gain: amplitude of the point over the lines of its aperture, (..., pulse). Only the envelope
    tells where the beam's centre is: Ka / sqrt(2 q int g'^2 / int g^2); about 0.2 Ka T / sqrt(q)
    for a cosine-shaped gain of length T, larger than the tone's bound by about half the
    time-bandwidth product Ka T^2. A rectangular gain has no bound of this kind (its edges are lost
    in the line grid, Ka / prf).
    """
    slope = torch.gradient(gain.to(torch.float64), spacing=1 / prf_hz, dim=-1)[0]
    information = slope.square().sum(-1) / gain.to(torch.float64).square().sum(-1)
    return _double(rate_hz_s) / torch.sqrt(2 * _double(q) * information)


def velocity_bound_m_s(q: Value, dwell_s: Value, velocity_m_s: Value, wavelength_m: Value, range_m: Value) -> Tensor:
    """Bound of the effective velocity from points of total q, each with unknown place, phase and
    amplitude, constant gain over the dwell.

    The phase 2 pi v^2 t^2 / (lambda r) is known to its quadratic coefficient with sqrt(180) / (T^2
    sqrt(2 q)) rad/s^2.
    """
    curvature = math.sqrt(180) / (_double(dwell_s).square() * torch.sqrt(2 * _double(q)))
    return curvature * wavelength_m * range_m / (4 * math.pi * _double(velocity_m_s))


def pulse_phase_bound_rad(snr: Value, n_range: int) -> Tensor:
    """Bound of the phase of one pulse where the scene is known: 1 / sqrt(2 N SNR), SNR the mean
    power of all samples over the noise variance.
    """
    return 1 / torch.sqrt(2 * n_range * _double(snr))


def pulse_phase_bound_of_scene_rad(azimuth: Tensor, range_: Tensor, amplitude: Tensor, noise_std: Value) -> Tensor:
    """Bound of the rms phase error per pulse where the places of the scatterers are known and their
    complex amplitudes are not, (...,).

    Samples s[k, n] = exp(j psi_k) sum_m azimuth[k, m] range_[m, n] amplitude[m] plus circular noise
    of variance noise_std^2. azimuth: (..., pulse, target), range_: (..., target, range), amplitude:
    (..., target), complex128. The constant and the linear term of psi, which no data tell from a
    turn and a shift of the scene, are left out. Amplitudes that the data cannot tell apart count as
    one.
    """
    echo = (azimuth * amplitude[..., None, :]) @ range_
    gram = (azimuth.mH @ azimuth) * (range_ @ range_.mH).mT
    cross = azimuth.conj() * (
        echo @ range_.mH
    )  # A^H of the derivative by each phase, (..., pulse, target), but for a factor j
    scale = gram.diagonal(dim1=-2, dim2=-1).real.mean(-1)[..., None, None]
    ridge = 1e-9 * scale * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    explained = (cross.conj() @ torch.linalg.solve(gram + ridge, cross.mT)).real
    known = echo.abs().square().sum(-1)
    information = 2 * (torch.diag_embed(known) - explained) / _double(noise_std).square()[..., None, None]
    n = echo.shape[-2]
    k = torch.arange(n, dtype=torch.float64, device=echo.device)
    free = torch.linalg.qr(torch.stack([torch.ones_like(k), k - k.mean()], -1), mode="complete").Q[:, 2:]
    variance = torch.linalg.inv(free.mT @ information @ free)
    return torch.sqrt(variance.diagonal(dim1=-2, dim2=-1).sum(-1) / n)
