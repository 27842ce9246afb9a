"""Spectra on any uniform grid of frequencies by the chirp-z transform, and the keystone transform
that stands on it.

Both are exact sums, not interpolations: X_i = sum_j x_j exp(-2j pi (start + i step) (j - j0)), as
one convolution with a chirp. Source: Bluestein 1970 (chirp-z); Perry, DiPietro and Fante 1999, IEEE
Trans. AES 35(1) (keystone). Own code.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import centred_fft, linear_phasor, per_trial, unit_phasor
from torchsar.focus.nufft import smooth_length


def chirp_z(
    x: Tensor, start: Tensor | float, step: Tensor | float, n: int, dim: int = -1, centre: int | None = None
) -> Tensor:
    """X_i = sum_j x_j exp(-2j pi (start + i step) (j - centre)), i = 0..n-1, by Bluestein's
    convolution.

    x: complex (..., m) along dim; start, step: cycles per sample, any real numbers, float64 (...,)
    to broadcast against the dims of x but `dim`. centre: sample that phases refer to, m // 2 by
    default. Exact to the precision of the data: chirps are float64 phases. Differentiable in all
    three. Raises ValueError for n < 1.
    """
    if n < 1:
        raise ValueError(f"a chirp-z transform gives at least one frequency, got n={n}")
    if dim % x.ndim != x.ndim - 1:
        return chirp_z(x.movedim(dim, -1), start, step, n, -1, centre).movedim(-1, dim)
    m = x.shape[-1]
    centre = m // 2 if centre is None else centre
    start, step = per_trial(start, 0, x), per_trial(step, 0, x)
    j = torch.arange(m, dtype=torch.float64, device=x.device) - centre
    i = torch.arange(n, dtype=torch.float64, device=x.device)
    chirped = x * unit_phasor(-start[..., None] * j - step[..., None] * j.square() / 2, x.dtype)
    # i j = (i^2 + j^2 - (i - j)^2) / 2
    lag = torch.arange(m + n - 1, dtype=torch.float64, device=x.device) - j[-1]
    length = smooth_length(m + n - 1)
    response = torch.fft.fft(unit_phasor(step[..., None] * lag.square() / 2, x.dtype), length)
    convolved = torch.fft.ifft(torch.fft.fft(chirped, length) * response)[..., m - 1 : m - 1 + n]
    return convolved * unit_phasor(-step[..., None] * i.square() / 2, x.dtype)


def keystone(data: Tensor, frequency_hz: Tensor, carrier_hz: float, ambiguity: Tensor | int = 0) -> Tensor:
    """Slow time rescaled per range frequency, s(t carrier / (carrier + f), f), which takes out the
    range walk of every target at once.

    data: complex (..., pulse, range frequency); frequency_hz: f, float64 (range frequency,),
    relative to the carrier. A target that moves by v has the phase (carrier + f) v t: afterwards
    carrier * v * t, and its range stands still. Slow time is zero at pulse `n // 2`, where nothing
    moves. ambiguity: whole pulse rates (...,) by which the true Doppler exceeds the sampled one;
    with a wrong number the walk of that many pulse rates stays. The Doppler of the whole band must
    lie within half a pulse rate of that: it grows with carrier + f. Evaluated exactly as the
    periodic band-limited signal through the pulses: where the scale exceeds one (f < 0), the
    outermost pulses are read from beyond the aperture and wrap around. Differentiable in the data.
    Raises ValueError where frequencies do not fit the data or reach minus the carrier.
    """
    n, frequency_hz = data.shape[-2], frequency_hz.to(device=data.device, dtype=torch.float64)
    if frequency_hz.shape != data.shape[-1:]:
        raise ValueError(
            f"keystone needs one frequency per range frequency of the data {tuple(data.shape)}, "
            f"got {tuple(frequency_hz.shape)}"
        )
    if not (carrier_hz > 0 and bool((frequency_hz > -carrier_hz).all())):
        raise ValueError(
            f"keystone needs frequencies above minus the carrier of {carrier_hz:g} Hz, got down "
            f"to {float(frequency_hz.min()):g} Hz"
        )
    scale = carrier_hz / (carrier_hz + frequency_hz)
    # the sum over Doppler bins d, sample i at (i - n // 2) scale
    doppler = centred_fft(data.mT) / n
    rows = chirp_z(doppler, scale * (n // 2) / n, -scale / n, n)
    turns = (scale * per_trial(ambiguity, 1, data))[..., None]
    return (rows * linear_phasor(turns[..., 0], -(n // 2), n, data.dtype)).mT
