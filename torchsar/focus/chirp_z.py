"""Chirp-z transform onto any uniform grid of frequencies, and the keystone transform.

The chirp-z transform X_i = sum_j x_j exp(-2j pi (start + i step) (j - centre)) is the spectrum of
samples x_j at the frequencies start + i step, in cycles per sample. It is computed exactly, by one
convolution with a chirp instead of interpolation. The keystone transform uses it to resample slow
time.

Reference:
    Bluestein 1970 (chirp-z); Perry, DiPietro and Fante 1999, IEEE Trans. AES 35(1) (keystone).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.core import (
    Signal,
    Stage,
    centred_fft,
    checked_samples,
    host_value,
    linear_phasor,
    per_trial,
    unit_phasor,
)
from torchsar.core.fft import smooth_length


def chirp_z(
    x: Tensor, start: Tensor | float, step: Tensor | float, n: int, dim: int = -1, centre: int | None = None
) -> Tensor:
    """Evaluate the spectrum of samples on a uniform grid of frequencies by Bluestein's convolution.

    >>> import torch
    >>> from torchsar.focus import chirp_z
    >>> samples = torch.ones(8, dtype=torch.complex128)
    >>> chirp_z(samples, start=-0.125, step=0.0625, n=5).abs().round(decimals=3)
    tensor([0.0000, 5.1260, 8.0000, 5.1260, 0.0000], dtype=torch.float64)

    The result X_i = sum_j x_j exp(-2j pi (start + i step) (j - centre)), i = 0..n-1, is exact to
    the precision of the data, since the chirps are formed from float64 phases. Differentiable in
    `x`, `start` and `step`.

    Args:
        x: Samples, shape (..., m) along `dim`, complex.
        start: First frequency in cycles per sample, a number or float64 (...,) that broadcasts
            against the dims of `x` except `dim`.
        step: Step of frequency in cycles per sample, any real number, shape as `start`.
        n: Number of frequencies.
        dim: Dimension of the samples.
        centre: Sample that the phases refer to; None for m // 2.

    Returns:
        Spectrum, shape (..., n) along `dim`, complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `n` is below 1.
    """
    x = checked_samples(x, "chirp_z", "sample", finite=False)
    if n < 1:
        raise ValueError(f"n, the number of frequencies of a chirp-z transform, must be at least 1, got n={n}")
    if dim % x.ndim != x.ndim - 1:
        return chirp_z(x.movedim(dim, -1), start, step, n, -1, centre).movedim(-1, dim)
    m = x.shape[-1]
    centre = m // 2 if centre is None else centre
    start, step = per_trial(start, 0, x), per_trial(step, 0, x)
    j = torch.arange(m, dtype=torch.float64, device=x.device) - centre
    i = torch.arange(n, dtype=torch.float64, device=x.device)
    chirped = x * unit_phasor(-start[..., None] * j - step[..., None] * j.square() / 2, x.dtype)
    # the product of the convolution is i j = (i^2 + j^2 - (i - j)^2) / 2
    lag = torch.arange(m + n - 1, dtype=torch.float64, device=x.device) - j[-1]
    length = smooth_length(m + n - 1)
    response = torch.fft.fft(unit_phasor(step[..., None] * lag.square() / 2, x.dtype), length)
    convolved = torch.fft.ifft(torch.fft.fft(chirped, length) * response)[..., m - 1 : m - 1 + n]
    return convolved * unit_phasor(-step[..., None] * i.square() / 2, x.dtype)


def keystone(data: Tensor, frequency_hz: Tensor, carrier_hz: float, ambiguity: Tensor | int = 0) -> Tensor:
    """Rescale slow time per range frequency, which removes the linear range walk of all targets.

    >>> import torch
    >>> from torchsar.focus import keystone
    >>> t, f = (torch.arange(64) - 32.0)[:, None] / 64, torch.tensor([-1e8, 0.0, 1e8])
    >>> data = torch.exp(2j * torch.pi * 20 * (1 + f / 1e9) * t)  # Doppler grows with f
    >>> [torch.fft.fft(x, dim=0).abs().argmax(0).tolist() for x in (data, keystone(data, f, 1e9))]
    [[18, 20, 22], [20, 20, 20]]

    Data s(t, f) over slow time t and range frequency f become s(t carrier / (carrier + f), f). The
    phase of a target of constant velocity is proportional to (carrier + f) t before the transform
    and to carrier t after it, so that its range becomes constant. Slow time is zero at pulse
    `n // 2` of n pulses, which does not change.

    The pulses are resampled exactly, as a periodic, band-limited signal. At every f, the true
    Doppler must differ from `ambiguity` times the pulse rate by less than half the pulse rate. For
    f < 0, the outermost pulses are taken from beyond the aperture, where the periodic signal wraps
    around. Differentiable in the data.

    Args:
        data: Pulses, shape (..., pulse, range frequency), complex.
        frequency_hz: Range frequencies f relative to the carrier in Hz, shape (range frequency,).
        carrier_hz: Carrier frequency in Hz.
        ambiguity: Number of pulse rates by which the true Doppler exceeds the sampled one, a number
            or shape (...,). If it is wrong by one, the range walk due to a Doppler of one pulse
            rate remains.

    Returns:
        Pulses of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the number of frequencies does not fit the data,
            the carrier is not positive, or a frequency is at or below minus the carrier.

    Reference:
        Perry, DiPietro and Fante 1999, IEEE Trans. AES 35(1).
    """
    data = checked_samples(data, "keystone", "pulse, range frequency", finite=False)
    n, frequency_hz = data.shape[-2], frequency_hz.to(device=data.device, dtype=torch.float64)
    if frequency_hz.shape != data.shape[-1:]:
        raise ValueError(
            f"frequency_hz must hold one frequency per range frequency of the data, shape {tuple(data.shape[-1:])}, "
            f"got shape {tuple(frequency_hz.shape)}"
        )
    if not (carrier_hz > 0 and host_value((frequency_hz > -carrier_hz).all(), True)):
        raise ValueError(
            "carrier_hz must be positive and every frequency_hz above minus the carrier, got frequencies down to "
            f"{float(frequency_hz.min()):g} Hz with a carrier of {carrier_hz:g} Hz"
        )
    scale = carrier_hz / (carrier_hz + frequency_hz)
    # sum over the Doppler bins d, with sample i at the time (i - n // 2) scale
    doppler = centred_fft(data.mT) / n
    rows = chirp_z(doppler, scale * (n // 2) / n, -scale / n, n)
    turns = (scale * per_trial(ambiguity, 1, data))[..., None]
    return (rows * linear_phasor(turns[..., 0], -(n // 2), n, data.dtype)).mT


class Keystone(Stage):
    """Stage that removes the linear range walk of all targets by the keystone transform.

    >>> import torch
    >>> from torchsar import Signal, focus, radar
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0)
    >>> t, f = (torch.arange(64.0)[:, None] - 32) / 500, (torch.arange(32.0) - 16) / 32 * 1e9
    >>> echo = torch.exp(-4j * torch.pi / 299792458 * (1e10 + f) * 7.0 * t)  # recedes at 7 m/s
    >>> profiles = Signal(radar.range_profiles(echo), isar.raw_axes(64, 32))
    >>> for signal in (profiles, focus.Keystone(isar, ambiguity=-1)(profiles)):
    ...     print(signal.data[::21].abs().argmax(-1).tolist())
    [13, 15, 17, 19]
    [16, 16, 16, 16]

    It works on range-compressed lines of any radar; see `keystone`.

    Args:
        radar: Radar of the recording: carrier and propagation speed.
        ambiguity: Number of pulse rates by which the true Doppler exceeds the sampled one, unless
            it is connected.
    """

    takes_empty = False

    def __init__(self, radar: Any, ambiguity: int = 0) -> None:
        super().__init__()
        self.radar, self.ambiguity = radar, ambiguity

    def forward(self, signal: Signal, ambiguity: Tensor | None = None) -> Signal:
        """Straighten the range history of targets of constant velocity.

        Args:
            signal: Range-compressed lines with the axes (pulse, range).
            ambiguity: Number of pulse rates; None for that of the stage.

        Returns:
            Signal of the same axes.
        """
        step_s = 2 * signal.axes[-1].step / self.radar.wave_speed_m_s
        frequency_hz = torch.fft.fftfreq(signal.axes[-1].n, step_s, dtype=torch.float64, device=signal.data.device)
        spectrum = torch.fft.fft(signal.data)
        number = self.ambiguity if ambiguity is None else ambiguity
        return signal.with_data(torch.fft.ifft(keystone(spectrum, frequency_hz, self.radar.carrier_hz, number)))
