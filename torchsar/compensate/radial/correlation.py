"""Radial velocity from the lag between the envelopes of up and down spectra: the reference method
of the paper.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.radial.bands import Bands, bands_of, refuse_other_sweeps
from torchsar.compensate.radial.blocks import by_trials
from torchsar.compensate.radial.peak import from_beats
from torchsar.compensate.radial.verdict import velocity_estimate
from torchsar.core import Axis, Estimate
from torchsar.radar import TriangularLadar

_REACH = 4


def spectrum_correlation(
    sweeps: Tensor,
    radar: TriangularLadar,
    pulse: Axis,
    *,
    upsampling: int = 20,
    window_m: tuple[float, float] | None = None,
    azimuth_m: Tensor | float = 0.0,
) -> Estimate:
    """Radial velocity at the turning points, value["velocity_m_s"] (..., pulse), from
    cross-correlated range envelopes (paper, section 2.3.2; its reference [17]).

    The lag that aligns |S+(f)| with the mirrored |S-(-f)| is 2 fd. It is found on a grid of 1 /
    (upsampling T): however strong the signal, an error of lambda / (4 upsampling T sqrt(12)) stays,
    0.70 mm/s for the paper's system at 20, and slow motion dwells on one step of it. sweeps: (...,
    2, pulse, N). window_m: relative ranges (low, high) m, None for the whole band. azimuth_m: x of
    the scene's centre. Not differentiable: its values lie on a grid. Raises TypeError or ValueError
    for other sweeps, a window that is none, or upsampling below 1.
    """
    refuse_other_sweeps(sweeps, radar, "spectrum_correlation", pulse)
    if not (isinstance(upsampling, int) and 1 <= upsampling <= 64):
        raise ValueError(f"upsampling must be a whole number of 1..64, got {upsampling}")

    floor = radar.wavelength_m / (4 * upsampling * radar.sweep_s * math.sqrt(12))

    def estimator(sweeps: Tensor, azimuth_m: Tensor | float) -> Estimate:
        bands = bands_of(sweeps, radar, window_m, taper=0.0)
        doppler = envelope_lag(bands, upsampling) / (2 * radar.sweep_s)
        return velocity_estimate(
            from_beats(doppler, -doppler, bands), bands, pulse, factor=3.0, azimuth_m=azimuth_m, floor_m_s=floor
        )

    return by_trials(estimator, sweeps, azimuth_m)


@torch.no_grad()
def envelope_lag(bands: Bands, upsampling: int) -> Tensor:
    """Lag of the up envelope behind the mirrored down envelope in bins of 1 / T, (..., pulse)
    float64: 2 fd T of what the shift has left.

    Only lags within 4 bins of the shift are looked at; the shift itself is known to a bin or two.
    """
    m = bands.time_s.shape[-1]
    n = upsampling * m
    both = torch.stack([bands.up, bands.down], -3)
    envelope = torch.fft.fft(both, n).abs()
    envelope = envelope - envelope.mean(-1, keepdim=True)
    spectrum = torch.fft.rfft(envelope)
    met = torch.fft.irfft(spectrum[..., 0, :, :] * spectrum[..., 1, :, :].conj(), n)
    reach = min(_REACH * upsampling, n // 2 - 1)
    near = torch.cat([met[..., -reach:], met[..., : reach + 1]], -1)
    return (near.argmax(-1) - reach).to(torch.float64) / upsampling
