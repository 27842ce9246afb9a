"""How channels along track see the Doppler bands of a moving point, and the weights that tell the
bands apart.

One channel samples at the pulse rate, so that at each alias frequency its spectrum is a sum over
Doppler bands that lie one pulse rate apart. Channel m is, but for a constant phase, the reference
delayed by dx_m / v_e: its share of band b differs by exp(-j 2 pi b PRF dx_m / v_e) from channel to
channel, which is what weights undo. Source: Remote Sens. 2020, 12, 1703, Eqs. (25)-(26), (34)-(36),
with the corrections of brief 001.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchsar.core import linear_phasor, unit_phasor
from torchsar.multichannel.motion import PointMotion
from torchsar.radar import BistaticRadar

# condition numbers: refused in float64, in single precision, warned of
SINGULAR, SINGULAR_SINGLE, POOR = 1e6, 1e4, 5.0
_TINY = SINGULAR**-2  # of the largest eigenvalue of the normal matrix


def first_bin(n_pulse: int, bands: int) -> int:
    """Index of the lowest Doppler bin against the centre: bins run over bands * n_pulse from here,
    PRF / n_pulse apart.
    """
    return -(bands * n_pulse // 2)


def doppler_offsets(n_pulse: int, bands: int, prf_hz: float, device: torch.device | str | None = None) -> Tensor:
    """Doppler of all bins of a rebuilt spectrum against its centre (Hz), rising, float64 (bands *
    n_pulse,).
    """
    return (torch.arange(bands * n_pulse, dtype=torch.float64, device=device) + first_bin(n_pulse, bands)) * (
        prf_hz / n_pulse
    )


def band_matrix(radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """exp(-j 2 pi b PRF dx_m / v_e), b counted from the lowest band, complex128 (..., channel,
    band): H of Eq. (34) without what all bands share.
    """
    band = torch.arange(bands, dtype=torch.float64, device=motion.u_r_m_s.device)
    delay = radar.channels_at(band.device)[:, None] / motion.effective_m_s[..., None, None]
    return unit_phasor(-radar.prf_hz * band * delay, torch.complex128)


def shared_response(
    radar: BistaticRadar, motion: PointMotion, n_pulse: int, bands: int, dtype: torch.dtype, left_k1_m_s: float = 0.0
) -> Tensor:
    """What the bands share of H (34) in the lowest of them: exp(-j 2 pi (f dx_m / v_e + C_m / (2 R0
    lambda))), (..., channel, n_pulse) of `dtype`.

    Data are demodulated by the Doppler centre first, f counts from there. C_m = dx^2 - (v dx^2 + 2
    R0 u_r dx) / v_e + 2 y0 dx u_r^2 / V^2, Eq. (7) with y0. left_k1_m_s: transmit range rate that
    stays in the data, Eq. (34); zero once the transmit range is removed.
    """
    dx = radar.channels_at(motion.u_r_m_s.device)
    m = motion.each(lambda value: value[..., None])
    constant = (
        dx.square()
        - (m.along_m_s * dx.square() + 2 * m.range_m * m.u_r_m_s * dx) / m.effective_m_s
        + 2 * m.y0_m * dx * m.u_r_m_s.square() / m.square_m2_s2
    )
    delay = dx / m.effective_m_s
    centre_hz = doppler_centre_hz(radar, m, left_k1_m_s)
    fixed = -centre_hz * delay - (constant / (2 * m.range_m) + left_k1_m_s * delay) / radar.wavelength_m
    return unit_phasor(fixed, dtype)[..., None] * linear_phasor(
        -delay * (radar.prf_hz / n_pulse), first_bin(n_pulse, bands), n_pulse, dtype
    )


def doppler_centre_hz(radar: BistaticRadar, motion: PointMotion, left_k1_m_s: float = 0.0) -> Tensor:
    """Doppler of a point as the beam meets it abeam, (u_r - k1) / lambda, with k1 only where the
    transmit range stays in the data (brief 001, erratum 9).
    """
    return (motion.u_r_m_s - left_k1_m_s) / radar.wavelength_m


class Prior(Protocol):
    """Expected power over Doppler offsets from the centre, relative to its peak."""

    def power(self, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion) -> Tensor: ...


@dataclass(frozen=True)
class ElementPattern:
    """One-way power pattern of a channel's aperture, sinc^2(element sin(look) / lambda), over
    Doppler: sin(look) = -lambda offset / v.
    """

    def power(self, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion) -> Tensor:
        return torch.sinc(radar.element_m * offset_hz / motion.along_m_s[(...,) + (None,) * offset_hz.ndim]).square()


@dataclass(frozen=True)
class FlatBand:
    """Equal power within a band of bandwidth_hz about the centre, none beyond."""

    bandwidth_hz: float

    def __post_init__(self) -> None:
        if not self.bandwidth_hz > 0:
            raise ValueError(f"bandwidth_hz of a flat band must be positive, got {self.bandwidth_hz}")

    def power(self, offset_hz: Tensor, radar: BistaticRadar, motion: PointMotion) -> Tensor:
        return (offset_hz.abs() <= self.bandwidth_hz / 2).to(torch.float64)


class Rebuild(Protocol):
    """A way to tell bands apart: how many there are, and weights (..., band, channel), or (...,
    n_pulse, band, channel) where they differ from bin to bin.
    """

    @property
    def bands(self) -> int: ...

    def weights(self, radar: BistaticRadar, motion: PointMotion, n_pulse: int) -> Tensor: ...

    def refusal(self, channels: int) -> str | None: ...


def _refuse_no_bands(bands: int) -> None:
    if not (isinstance(bands, int) and bands >= 1):
        raise ValueError(f"a reconstruction needs a whole number of Doppler bands, at least one, got bands={bands}")


@dataclass(frozen=True)
class LeastSquares:
    """Pseudo-inverse of the band matrix, Eq.

    (36) for any number of channels (brief 001, erratum 8): the inverse where there are as many
    bands as channels.

    Singular values below 1e-6 of the largest are damped, so that weights stay finite where two
    channels sample the same places.
    """

    bands: int = 2

    def __post_init__(self) -> None:
        _refuse_no_bands(self.bands)

    def weights(self, radar: BistaticRadar, motion: PointMotion, n_pulse: int) -> Tensor:
        matrix = band_matrix(radar, motion, self.bands)
        normal = matrix.mH @ matrix
        floor = _TINY * self.bands * radar.channels
        return torch.linalg.solve(
            normal + floor * torch.eye(self.bands, dtype=normal.dtype, device=normal.device), matrix.mH
        )

    def refusal(self, channels: int) -> str | None:
        """Why it cannot work with so many channels, or None."""
        few = (
            f"{self.bands} Doppler bands cannot be told apart by {channels} "
            f"channel{'s' if channels > 1 else ''}; rebuild at most {channels}, or give a prior "
            "(MinimumMeanSquare)"
        )
        return few if self.bands > channels else None


@dataclass(frozen=True)
class MinimumMeanSquare:
    """The linear estimate of least mean square error, A G^H (G A G^H + I / snr)^-1, for bands of
    the expected power A: works for more bands than channels.

    snr_db: of the strongest expected power over the noise of a sample.
    """

    bands: int = 5
    snr_db: float = 40.0
    prior: Prior = ElementPattern()

    def __post_init__(self) -> None:
        _refuse_no_bands(self.bands)
        if not abs(self.snr_db) <= 120:
            raise ValueError(
                f"snr_db of a least-mean-square reconstruction must lie within +-120 dB, got {self.snr_db}"
            )

    def weights(self, radar: BistaticRadar, motion: PointMotion, n_pulse: int) -> Tensor:
        offset = doppler_offsets(n_pulse, self.bands, radar.prf_hz, motion.u_r_m_s.device).view(self.bands, n_pulse).T
        matrix = band_matrix(radar, motion, self.bands)[..., None, :, :]
        weighted = matrix * self.prior.power(offset, radar, motion)[..., None, :].to(matrix.dtype)
        noise = 10 ** (-self.snr_db / 10) * torch.eye(radar.channels, dtype=matrix.dtype, device=matrix.device)
        return torch.linalg.solve(weighted @ matrix.mH + noise, weighted).mH

    def refusal(self, channels: int) -> str | None:
        """None: a prior tells any number of bands apart."""
        return None


def condition_number(radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """Ratio of the largest to the least singular value of the band matrix, (...,), infinite where
    it is singular. Not differentiable where two are equal.
    """
    values = torch.linalg.svdvals(band_matrix(radar, motion, bands).detach())
    if bands > radar.channels:
        return torch.full_like(values[..., 0], math.inf)
    least = values[..., -1]
    return torch.where(
        least > 1e-13 * values[..., 0], values[..., 0] / least.clamp_min(torch.finfo(least.dtype).tiny), math.inf
    )


def noise_gain_db(radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, n_pulse: int = 64) -> Tensor:
    """Noise power of a rebuilt bin against that of ideal uniform sampling by as many channels, M /
    N trace(W W^H), in dB, mean over bins, (...,).

    Infinite where an inverse is singular, although its damped weights are finite: they lose bands
    instead.
    """
    weights = rebuild.weights(radar, motion, n_pulse)
    power = weights.abs().square().sum((-2, -1)) * (radar.channels / rebuild.bands)
    gain = 10 * torch.log10(power.mean(-1) if power.ndim > motion.trial_dims else power)
    if not isinstance(rebuild, LeastSquares):
        return gain
    return torch.where(condition_number(radar, motion, rebuild.bands) > SINGULAR, torch.inf, gain)
