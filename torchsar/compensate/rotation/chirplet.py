"""Adaptive chirplet imaging in the manner of CLEAN, for comparison with other estimators.

Every range cell is modelled as a sum of chirps, which are found and removed one by one, the
strongest first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import (
    Axis,
    Signal,
    Stage,
    checked_samples,
    differentiable,
    level_of,
    linear_phasor,
    power_of,
    real_dtype,
    take,
    unit_phasor,
)
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.optim.scalar import vertex
from torchsar.radar import InverseRadar

# _PARTS: samples of a segment in the fine search, a compromise between reach and time found by
# trial.
# _PAD: zero-padding of the transforms, with which a peak between two bins loses little power.
_PARTS, _PAD = 4, 2


@dataclass(frozen=True)
class Chirplets:
    """Chirps found in every range cell, in the order in which they were found, and their image.

    Args:
        image: Image of the chirps that are less than `floor_db` below the strongest one (see
            `chirplet_clean`), shape (..., lines, range), complex.
        doppler_hz: Frequency f in Hz in the middle of the aperture, shape (..., atom, range);
            positive where the phase falls, as in exp(-2j pi f t).
        rate_hz_s: Rate in Hz/s, with the same sign convention, shape (..., atom, range).
        amplitude: Amplitude, shape (..., atom, range), complex.
        residual_share: Energy that the chirps do not explain, over the energy of the data, shape
            (...,).
    """

    image: Tensor
    doppler_hz: Tensor
    rate_hz_s: Tensor
    amplitude: Tensor
    residual_share: Tensor


@differentiable("no")
def chirplet_clean(
    data: Tensor,
    prf_hz: float,
    *,
    atoms: int = 16,
    sweep: float = 0.25,
    floor_db: float = 40.0,
    oversampling: float = 2.0,
    lines: int | None = None,
) -> Chirplets:
    """Form the image of the chirps that make up range-compressed pulses.

    >>> import torch
    >>> from torchsar.compensate import chirplet_clean
    >>> pulses = torch.ones(32, 2, dtype=torch.complex64)  # a tone at zero Doppler in each cell
    >>> chirplet_clean(pulses, 1e3, atoms=1).image.abs().argmax(0)
    tensor([32, 32])

    In each range cell the chirp a exp(-2j pi (f t + r t^2 / 2)) of most energy is found and
    removed, where a is its complex amplitude, f its frequency, r its rate, and t the time from the
    middle of the aperture. This is repeated `atoms` times. The image is formed by
    `torchsar.focus.matched_fourier` from the chirps without their rates, that is from the tones
    a exp(-2j pi f t). Not differentiable.

    The method is a baseline for comparison. It needs no model of the rotation and does not estimate
    the rotation. A chirp has no cubic phase: if the rotation rate has a second derivative, strong
    scatterers leave residuals, further chirps are spent on these residuals, and weak scatterers are
    missing from the image.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        prf_hz: Pulse repetition frequency in Hz.
        atoms: Number of chirps per range cell.
        sweep: Largest |r| that is searched, given by the band that a chirp sweeps during the
            aperture, as a fraction of the pulse rate, 0..1.
        floor_db: Chirps this far below the strongest one of their trial are left out of the image.
        oversampling: Image lines per Doppler cell.
        lines: Number of image lines about zero Doppler; by default all that the pulse rate holds.

    Returns:
        The chirps and their image.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If there are no samples or a sample is not finite, or if the data are not finite
            or hold fewer than 16 pulses, or an option is invalid.

    Reference:
        Remote Sens. 2025, 17, 3447, Fig. 6 (the adaptive chirplet algorithm, ACL). The search
        differs: rates are first found from segments without their phases, then on the whole
        aperture.
    """
    data = checked_samples(data, "chirplet_clean", "pulse, range")
    if data.shape[-2] < 16:
        raise ValueError(
            "chirplet_clean: data must have at least 16 pulses and one range cell, shape (..., pulse, range), got "
            f"shape {tuple(data.shape)}"
        )
    if not (prf_hz > 0 and atoms >= 1 and 0 < sweep <= 1 and floor_db > 0):
        raise ValueError(
            "chirplet_clean: prf_hz and floor_db must be positive, atoms 1 or more, and sweep above 0 and at most 1, "
            f"got prf_hz {prf_hz}, floor_db {floor_db}, atoms {atoms} and sweep {sweep}"
        )
    n, level = data.shape[-2], level_of(data.detach())
    rows = (data.detach() / level).mT.contiguous()
    time = torch.arange(n, dtype=torch.float64, device=rows.device) - (n - 1) / 2
    energy, tones, found = power_of(rows).sum((-2, -1)), torch.zeros_like(rows), []
    peak = torch.zeros(rows.shape[:-2], dtype=real_dtype(rows.dtype), device=rows.device)
    for _ in range(atoms):
        frequency, rate = _coarse(rows, time, sweep)
        frequency, rate = _fine(rows * _chirp(frequency, rate, time, rows.dtype).conj(), frequency, rate)
        chirp = _chirp(frequency, rate, time, rows.dtype)
        amplitude = (rows * chirp.conj()).mean(-1)
        rows = rows - amplitude[..., None] * chirp
        peak = torch.maximum(peak, amplitude.abs().amax(-1))
        found.append((frequency, rate, amplitude))
    frequency, rate, amplitude = (torch.stack(parts, -2) for parts in zip(*found, strict=True))
    shown = torch.where(amplitude.abs() > peak[..., None, None] * 10 ** (-floor_db / 20), amplitude, 0)
    for f, a in zip(frequency.unbind(-2), shown.unbind(-2), strict=True):
        tones = tones + a[..., None] * linear_phasor(-f, -(n - 1) / 2, n, rows.dtype)
    even = torch.zeros(0, dtype=torch.float64, device=rows.device)
    image = matched_fourier(tones.mT.contiguous(), even, prf_hz, lines=DopplerLines(oversampling, lines))
    return Chirplets(
        image * level,
        frequency * prf_hz,
        rate * prf_hz**2,
        amplitude * level,
        power_of(rows).sum((-2, -1)) / torch.where(energy > 0, energy, 1),
    )


# In the functions below frequencies are in cycles per pulse, rates in cycles per pulse squared, and
# times are counted in pulses from the middle of the aperture.


def _chirp(frequency: Tensor, rate: Tensor, time: Tensor, dtype: torch.dtype) -> Tensor:
    """Chirps exp(-2j pi (f t + r t^2 / 2)), (..., pulse)."""
    return unit_phasor(-(frequency[..., None] * time + rate[..., None] * (0.5 * time.square())), dtype)


def _segments(n: int) -> tuple[int, int]:
    """Number of segments into which n pulses are divided, and number of pulses that are summed to
    one sample; a segment has `_PARTS` samples.
    """
    segments = max(4, 2 ** round(math.log2(n) / 2))
    return segments, -(-n // (_PARTS * segments))


def _coarse(rows: Tensor, time: Tensor, sweep: float) -> tuple[Tensor, Tensor]:
    """Find the frequency and the rate of the strongest chirp on a grid. The power spectra of the
    segments are added without their phases.
    """
    n = rows.shape[-1]
    segments, part = _segments(n)
    # a chirp half of a step away drifts by half a Doppler cell of the segments
    step, bins = segments / n**2, _PAD * _PARTS * part
    count = math.ceil(sweep / n / step)
    best = torch.full(rows.shape[:-1], -1.0, dtype=real_dtype(rows.dtype), device=rows.device)
    frequency, rate = torch.zeros_like(best, dtype=torch.float64), torch.zeros_like(best, dtype=torch.float64)
    for value in step * torch.arange(-count, count + 1, dtype=torch.float64, device=rows.device):
        turned = rows * _chirp(torch.zeros_like(value), value, time, rows.dtype).conj()
        parts = torch.nn.functional.pad(turned, (0, segments * _PARTS * part - n)).unflatten(-1, (segments, -1))
        power, index = power_of(torch.fft.ifft(parts, bins, norm="forward")).sum(-2).max(-1)
        better = power > best
        best = torch.where(better, power, best)
        frequency = torch.where(better, ((index + bins // 2) % bins - bins // 2).double() / bins, frequency)
        rate = torch.where(better, value, rate)
    return frequency, rate


def _fine(rows: Tensor, frequency: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
    """Correct the coarse frequency and rate by the strongest of a grid of chirps.

    The coarse chirp is removed from the rows, which are decimated. The chirps of the grid span the
    whole aperture. The maximum is interpolated by a parabola.
    """
    n = rows.shape[-1]
    segments, part = _segments(n)
    count = _PARTS * segments
    thin = torch.nn.functional.pad(rows, (0, count * part - n)).unflatten(-1, (count, -1)).sum(-1)
    t = (torch.arange(count, dtype=torch.float64, device=rows.device) + 0.5) * part - n / 2
    width, bins = math.ceil(0.375 * segments), 2 * _PAD * count
    rates = (2.0 / n**2) * torch.arange(-width, width + 1, dtype=torch.float64, device=rows.device)
    turned = thin[..., None, :] * unit_phasor(rates[:, None] * (0.5 * t.square()), rows.dtype)
    power = power_of(torch.fft.ifft(turned, bins, norm="forward"))
    flat = power.flatten(-2).argmax(-1)
    row, column = flat // bins, flat % bins
    along_f, along_r = take(power, row, -2), take(power.mT, column, -2)
    f = ((column + bins // 2) % bins - bins // 2 + _vertex(along_f, column, True)) / (bins * part)
    return frequency + f, rate + rates[row] + _vertex(along_r, row, False) * (2.0 / n**2)


def _vertex(values: Tensor, index: Tensor, circular: bool) -> Tensor:
    """Position -0.5 to 0.5 of the vertex of the parabola through a maximum of values (..., n) and
    its neighbours.

    It is 0 at an end of an axis that is not circular.
    """
    n = values.shape[-1]
    near = ((index + i) % n if circular else (index + i).clamp(0, n - 1) for i in (-1, 0, 1))
    offset = vertex(*(take(values, at).to(torch.float64) for at in near)).clamp(-0.5, 0.5)
    return offset if circular else torch.where((index > 0) & (index < n - 1), offset, 0)


class ChirpletClean(Stage):
    """Image formation by adaptive chirplets; see `chirplet_clean`.

    Forms an image of axes (azimuth, range) with the Doppler in the middle of the aperture, in Hz,
    along azimuth.

    Args:
        radar: Radar parameters.
        atoms: Number of chirps per range cell.
        sweep: Largest chirp rate that is searched, given by the band that a chirp sweeps during the
            aperture, as a fraction of the pulse rate, 0..1.
        floor_db: Chirps this far below the strongest one of their trial are left out of the image.
        oversampling: Image lines per Doppler cell.
        lines: Number of image lines about zero Doppler; by default all that the pulse rate holds.
    """

    differentiable = "no"

    def __init__(
        self,
        radar: InverseRadar,
        atoms: int = 16,
        sweep: float = 0.25,
        floor_db: float = 40.0,
        oversampling: float = 2.0,
        lines: int | None = None,
    ) -> None:
        super().__init__()
        self.radar, self.oversampling = radar, oversampling
        self.options = {"atoms": atoms, "sweep": sweep, "floor_db": floor_db, "lines": lines}

    def forward(self, signal: Signal) -> Signal:
        """Form the image of a signal of axes (pulse, range).

        Returns:
            The image of axes (azimuth, range), with the Doppler in Hz along azimuth.
        """
        image = chirplet_clean(signal.data, self.radar.prf_hz, oversampling=self.oversampling, **self.options).image
        pulse, range_ = signal.axes
        step = 1 / (self.oversampling * pulse.n * pulse.step)
        return Signal(image, (Axis("azimuth", image.shape[-2], -(image.shape[-2] // 2) * step, step, "Hz"), range_))
