"""Cramer-Rao bounds for stripmap data and for phases per pulse, and a published reference curve.

The argument q is the peak signal-to-noise power ratio of a point after two-dimensional compression,
equal to the signal energy over the noise variance per sample. All functions take numbers or tensors
that broadcast, and return float64.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import check_value, host_value, linear_solve, matrix_inverse
from torchsar.radar import BistaticRadar, InverseRadar

Value = Tensor | float


def nonnegative(value: Value) -> Tensor:
    """Convert a parameter of a bound, such as an SNR, a duration or a wavelength, to float64.

    Args:
        value: Number or tensor.

    Returns:
        Tensor of the same shape.

    Raises:
        ValueError: If an element is negative.
    """
    value = torch.as_tensor(value, dtype=torch.float64)
    if value.numel():
        check_value(value.detach().nan_to_num(0.0, neginf=-math.inf).min(), _check_sign)
    return value


def _check_sign(least: float) -> None:
    if least < 0:
        raise ValueError(
            "the parameters of a bound (SNR as a power ratio, durations, wavelengths, counts) must not be negative, "
            f"got {least:g}"
        )


def range_of_point(radar: BistaticRadar, range_m: Value | None) -> Value:
    """Return the range across the track, by default that of the radar.

    Args:
        radar: Radar with the default.
        range_m: Range in metres, a number or tensor; None for the reference range of the radar.

    Returns:
        The range in metres.

    Raises:
        ValueError: If a range is not positive and finite.
    """
    if range_m is None:
        return radar.reference_range_m
    value = torch.as_tensor(range_m).detach()
    if not host_value(((value > 0) & value.isfinite()).all(), True):
        raise ValueError(f"range_m must be positive and finite, got {float(value.min()):g} m")
    return range_m


def tone_frequency_bound_hz(q: Value, duration_s: Value) -> Tensor:
    """Compute the bound of the frequency of a tone with unknown phase and amplitude.

    >>> from torchsar import metrics
    >>> round(float(metrics.tone_frequency_bound_hz(q=100.0, duration_s=2.0)), 4)  # 20 dB
    0.0195

    The bound is sqrt(6) / (2 pi T sqrt(q)) = 0.39 / (T sqrt(q)). It is also the bound of the
    Doppler frequency of one point at the middle of its aperture, once its known quadratic phase is
    removed.

    Args:
        q: Peak signal-to-noise power ratio after two-dimensional compression (not in dB).
        duration_s: Duration T in seconds.

    Returns:
        Standard deviation in Hz.
    """
    return math.sqrt(6) / (2 * math.pi * nonnegative(duration_s) * torch.sqrt(nonnegative(q)))


def reference_doppler_std_hz(q: Value, duration_s: Value) -> Tensor:
    """Compute a published curve for the error of the Doppler estimate of a point, 1 / (T sqrt(q)).

    >>> from torchsar import metrics
    >>> round(float(metrics.reference_doppler_std_hz(q=100.0, duration_s=2.0)), 4)  # 20 dB
    0.05

    It is 2.6 times the Cramer-Rao bound of a tone and applies to a point with a known position in
    the beam. The bound for the Doppler centroid of the beam, estimated from a point of unknown
    position, is `beam_centre_bound_hz`.

    Args:
        q: Peak signal-to-noise power ratio after two-dimensional compression (not in dB).
        duration_s: Coherent integration time T in seconds.

    Returns:
        Standard deviation in Hz.

    Reference:
        Tsvetkov 2017, text near Fig. 5.
    """
    return 1 / (nonnegative(duration_s) * torch.sqrt(nonnegative(q)))


def beam_centre_bound_hz(gain: Tensor, q: Value, rate_hz_s: Value, prf_hz: float) -> Tensor:
    """Compute the bound of the Doppler centroid of a beam from one point of unknown position.

    >>> import torch
    >>> from torchsar import metrics
    >>> gain = torch.cos(torch.linspace(-1.57, 1.57, 200))  # 2 s at 100 Hz
    >>> round(float(metrics.beam_centre_bound_hz(gain, q=100.0, rate_hz_s=50.0, prf_hz=100.0)), 2)
    2.23

    Only the envelope g(t) of the echo, which is the antenna gain, carries information about the
    beam centre. The bound is Ka / sqrt(2 q G), where G is the integral of g'^2 divided by that of
    g^2. For a cosine-shaped gain of length T this is about 0.2 Ka T / sqrt(q), larger than the
    bound of a tone by about half the time-bandwidth product Ka T^2. A rectangular gain has no bound
    of this kind: its edges can be located to one pulse, which is Ka / PRF in Doppler.

    Args:
        gain: Amplitude of the point over the pulses of its aperture, shape (..., pulse).
        q: Peak signal-to-noise power ratio after two-dimensional compression (not in dB).
        rate_hz_s: Doppler rate Ka in Hz/s.
        prf_hz: Pulse rate in Hz.

    Returns:
        Standard deviation in Hz, shape (...,); infinite without gain.

    Raises:
        ValueError: If the pulse rate is not positive and finite.
    """
    if not 0 < prf_hz < math.inf:
        raise ValueError(f"beam_centre_bound_hz: prf_hz must be positive and finite, got {prf_hz}")
    slope = torch.gradient(gain.to(torch.float64), spacing=1 / prf_hz, dim=-1)[0]
    energy = gain.to(torch.float64).square().sum(-1)
    information = slope.square().sum(-1) / torch.where(energy == 0, 1, energy)
    return nonnegative(rate_hz_s) / torch.sqrt(2 * nonnegative(q) * information)


def velocity_bound_m_s(q: Value, dwell_s: Value, velocity_m_s: Value, wavelength_m: Value, range_m: Value) -> Tensor:
    """Compute the bound of the effective velocity from points with unknown position and phase.

    >>> from torchsar import metrics
    >>> bound = metrics.velocity_bound_m_s(100.0, 2.0, 150.0, wavelength_m=0.03, range_m=10e3)
    >>> round(float(bound), 4)
    0.0377

    The amplitudes are unknown too, and the gain is constant over the dwell. The velocity v follows
    from the quadratic phase 2 pi v^2 t^2 / (lambda r), whose coefficient can be estimated with the
    standard deviation sqrt(180) / (T^2 sqrt(2 q)) rad/s^2.

    Args:
        q: Sum over the points of the peak signal-to-noise power ratio after two-dimensional
            compression.
        dwell_s: Time T for which a point is illuminated, in seconds.
        velocity_m_s: Effective velocity v in m/s.
        wavelength_m: Carrier wavelength in metres.
        range_m: Slant range r in metres.

    Returns:
        Standard deviation in m/s.
    """
    curvature = math.sqrt(180) / (nonnegative(dwell_s).square() * torch.sqrt(2 * nonnegative(q)))
    return curvature * nonnegative(wavelength_m) * nonnegative(range_m) / (4 * math.pi * nonnegative(velocity_m_s))


def pulse_phase_bound_rad(snr: Value, n_range: int, n_pulse: int | None = None) -> Tensor:
    """Compute the bound of the phase of one pulse where the scene is known, 1 / sqrt(2 N SNR).

    >>> from torchsar import metrics
    >>> round(float(metrics.pulse_phase_bound_rad(snr=0.5, n_range=100)), 4)
    0.1

    Args:
        snr: Mean signal power of all samples over the noise variance.
        n_range: Number N of range samples of a pulse.
        n_pulse: Number of pulses K, if the constant and the linear term of the phases over the
            pulses are left out of the error: the bound is sqrt(1 - 2 / K) as large. By default
            they count.

    Returns:
        Standard deviation in rad: infinite for an SNR of 0, and 0 for two pulses or fewer, whose
        phases are only a constant and a linear term.
    """
    bound = torch.sqrt(1 / (2 * n_range * nonnegative(snr)))
    if n_pulse is None:
        return bound
    return bound * math.sqrt(1 - 2 / n_pulse) if n_pulse > 2 else torch.zeros_like(bound)


def pulse_phase_bound_of_scene_rad(azimuth: Tensor, range_: Tensor, amplitude: Tensor, noise_std: Value) -> Tensor:
    """Compute the bound of the phase per pulse for scatterers with known positions.

    >>> import torch
    >>> from torchsar import metrics
    >>> one = torch.ones(1, dtype=torch.complex128)  # one point in one range cell
    >>> bound = metrics.pulse_phase_bound_of_scene_rad(one.expand(64, 1), one[None], one, 0.1)
    >>> round(float(bound), 3)  # nearly 0.1 / sqrt(2)
    0.07

    The complex amplitudes of the scatterers are unknown. With the phase psi_k of pulse k, the
    samples are

        s[k, n] = exp(j psi_k) sum_m azimuth[k, m] range_[m, n] amplitude[m]

    plus circular noise. The constant and the linear term of psi over the pulses are left out of the
    error, because the data do not distinguish them from a phase and a shift of the scene.
    Scatterers that the data do not separate are treated as one.

    Args:
        azimuth: Response of each scatterer m over the pulses k, shape (..., pulse, target),
            complex128.
        range_: Response of each scatterer over the range samples n, shape (..., target, range),
            complex128.
        amplitude: Complex amplitudes, shape (..., target), complex128.
        noise_std: Square root of the variance of the complex noise.

    Returns:
        Bound of the rms phase error per pulse in rad, shape (...,).
    """
    echo = (azimuth * amplitude[..., None, :]) @ range_
    gram = (azimuth.mH @ azimuth) * (range_ @ range_.mH).mT
    # A^H times the derivative with respect to each phase, without its factor j;
    # shape (..., pulse, target)
    cross = azimuth.conj() * (echo @ range_.mH)
    scale = gram.diagonal(dim1=-2, dim2=-1).real.mean(-1)[..., None, None]
    ridge = 1e-9 * scale * torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    explained = (cross.conj() @ linear_solve(gram + ridge, cross.mT)).real
    known = echo.abs().square().sum(-1)
    information = 2 * (torch.diag_embed(known) - explained) / nonnegative(noise_std).square()[..., None, None]
    n = echo.shape[-2]
    k = torch.arange(n, dtype=torch.float64, device=echo.device)
    free = torch.linalg.qr(torch.stack([torch.ones_like(k), k - k.mean()], -1), mode="complete").Q[:, 2:]
    variance = matrix_inverse(free.mT @ information @ free)
    return torch.sqrt(variance.diagonal(dim1=-2, dim2=-1).sum(-1) / n)


def turntable_responses(
    radar: InverseRadar, rotation_rad_s: float, azimuth_m: Tensor, range_m: Tensor, pulses: int, samples: int
) -> tuple[Tensor, Tensor]:
    """Compute the responses of scatterers on a turntable, over pulses and over range samples.

    The rotation changes only the phases of the echoes: every scatterer stays in its range cell.

    Args:
        radar: Instrument; its wavelength, range step and pulse rate are used.
        rotation_rad_s: Constant rotation rate in rad/s.
        azimuth_m: Cross-range positions in metres, shape (target,).
        range_m: Range positions in metres, shape (target,).
        pulses: Number of pulses, centred on time zero.
        samples: Number of range samples, centred on range zero.

    Returns:
        Phasors over pulses, shape (pulse, target), and range responses, shape (target, range),
        complex128, as `pulse_phase_bound_of_scene_rad` takes them.
    """
    theta = rotation_rad_s * (torch.arange(pulses, dtype=torch.float64) - pulses // 2) / radar.prf_hz
    ranges = azimuth_m * torch.sin(theta)[:, None] + range_m * (torch.cos(theta)[:, None] - 1)
    phasors = torch.polar(torch.ones_like(ranges), -4 * math.pi / radar.wavelength_m * ranges)
    cells = torch.arange(samples, dtype=torch.float64) - samples // 2
    shifts = -2 * math.pi / samples * (range_m / radar.range_step_m)[:, None] * cells
    back = 2 * math.pi / samples * cells[:, None] * cells
    responses = torch.polar(torch.ones_like(shifts), shifts) @ torch.polar(torch.ones_like(back), back) / samples
    return phasors, responses
