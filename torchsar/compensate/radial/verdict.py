"""What every estimator of the radial velocity says about its own result."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, filled
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Estimate, cis, settle

# post-compression SNR of a sweep below which a peak of noise may win in single periods, or the
# gradient slip (brief 000, section 7); a product of
# sweeps needs a little more of what its squaring loss leaves
LEAST_SNR_DB, LEAST_SQUARED_DB = 14.0, 15.0


def signal_and_noise(bands: Bands, residual_m_s: Tensor) -> tuple[Tensor, Tensor]:
    """Mean power per sample of the scene and of the noise in the bands, (...,) float64 each.

    residual_m_s: (..., pulse) velocity beyond the shift of the bands. What both sweeps share once
    the motion is out is scene, the rest is noise.
    """
    inner = bands.inner
    up, down = bands.up.detach()[..., inner], bands.down.detach()[..., inner]
    turns = 4 * bands.radar.carrier_hz / bands.radar.wave_speed_m_s * residual_m_s.detach()
    still = cis((-2 * math.pi * turns[..., None] * bands.time_s[inner]).to(up.real.dtype))
    weight = bands.lit.to(torch.float64)
    weight = weight / weight.sum(-1, keepdim=True).clamp_min(1)
    shared = ((up * down.conj() * still).mean(-1).abs().to(torch.float64) * weight).sum(-1)
    total = (
        sum(((x.real.square() + x.imag.square()).mean(-1).to(torch.float64) * weight).sum(-1) for x in (up, down)) / 2
    )
    # the magnitude of a mean of noise is not zero: what noise alone would give counts as none
    chance = total / math.sqrt(min(up.shape[-1], 2 * bands.noise_lines))
    signal = torch.where(shared > 1.5 * chance, shared, 0).clamp_max(total)
    return signal, total - signal


def velocity_estimate(
    velocity_m_s: Tensor,
    bands: Bands,
    pulse: Axis,
    *,
    factor: float,
    azimuth_m: Tensor | float,
    squared: bool = False,
    floor_m_s: float = 0.0,
    window_m: tuple[float, float] | None = None,
    info: dict[str, Tensor] | None = None,
) -> Estimate:
    """The estimate of an estimator whose bound is factor * (lambda / 2)^2 / ((2 pi T)^2 g).

    velocity_m_s: (..., pulse), with the geometric velocity still in it.

    squared: the estimator multiplies the sweeps, which at low SNR costs more than the bound.
    floor_m_s: deviation that the strongest signal leaves. window_m: ranges of the scene, where the
    bands are wider. quality: share of the power in the window that both sweeps have in common. ok:
    the SNR after compression (info) reaches 14 dB; of squared ones 15 dB, less the loss of
    squaring. info["lit"] (..., pulse): False where no scatterer is lit; the velocity there is not
    estimated but interpolated between neighbours.
    """
    radar, tiny = bands.radar, torch.finfo(torch.float64).tiny
    velocity, finite = settle(filled(velocity_m_s, bands.lit), 0.0)
    signal, noise = signal_and_noise(bands, velocity - bands.shift_m_s)
    ratio = (signal / noise.clamp_min(tiny)).clamp(1e-6, 1e18)
    after = ratio * bands.noise_lines  # energy of a sweep over the noise variance of a sample
    loss = 1 + 1 / (2 * ratio) if squared else torch.ones_like(ratio)
    std = torch.hypot(
        radar.wavelength_m / 2 * torch.sqrt(factor * loss / after) / (2 * math.pi * radar.sweep_s),
        torch.tensor(floor_m_s, dtype=torch.float64, device=after.device),
    )
    snr_db = 10 * torch.log10(after)
    enough = snr_db - 10 * torch.log10(loss) >= LEAST_SQUARED_DB if squared else snr_db >= LEAST_SNR_DB
    lit = signal > 0
    centre = (bands.first + bands.lines / 2) * radar.range_step_m if window_m is None else sum(window_m) / 2
    geometric = geometric_velocity_m_s(radar, pulse, azimuth_m, centre, velocity.device)
    return Estimate(
        {"velocity_m_s": velocity - geometric},
        quality=torch.where(lit, signal / (signal + noise).clamp_min(tiny), 0),
        ok=enough & finite.all(-1) & lit & bands.lit.any(-1),
        std={"velocity_m_s": std[..., None].expand_as(velocity)},
        info={"snr_db": snr_db, "shift": bands.shift, "lit": bands.lit, **(info or {})},
    )
