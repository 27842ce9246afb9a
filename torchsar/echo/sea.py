"""Echo of a stationary surface in all channels of a bistatic receiver.

The echo is formed from its two-dimensional spectrum. By the principle of stationary phase, a
scatterer at the closest range R0 and the along-track position y has the one-way spectrum

    exp(-j 2 pi [ f y / V + sqrt(F^2 - (c f / V)^2) R0 / c ]),    sin(look) = -c f / (F V).

Here f is the Doppler frequency, F the carrier plus the range frequency, V the speed of the
receiver, c the propagation speed, and look the angle of the line of sight from broadside.

The channel with the along-track offset dx receives at the time t what the reference channel
received at t - dx / V. Its spectrum is therefore exactly that of the reference channel times
exp(-j 2 pi f dx / V). The spectrum of the reference channel, a sum over range in every bin of the
full Doppler band, is computed once. For each channel it is multiplied by the factor of the channel
and folded to the PRF.

Reference:
    Remote Sens. 2020, 12, 1703, Eqs. (1), (4), with zero target velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Draws, fft_lines, per_trial, real_dtype, unit_phasor
from torchsar.core.fft import smooth_length
from torchsar.echo.sums import line_tables
from torchsar.radar import BistaticRadar
from torchsar.scene.bistatic import BandLimited, Pattern
from torchsar.scene.sea import Sea
from torchsar.scene.trials import refuse_other_trials

# largest sine of the look angle that is illuminated, by choice: towards 1 the range grows without
# bounds
_STEEPEST = 0.8
# number of cells beyond a frame whose range responses are included, by choice; there a sinc has
# fallen to -34 dB
_SKIRT = 16


def sea_echo(
    sea: Sea,
    radar: BistaticRadar,
    n_pulse: int,
    n_range: int | None,
    gate: BandLimited | Pattern,
    draws: Draws,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Return the range-compressed echo of a sea without noise.

    The sea consists of cells. A cell has the phase -2 pi / lambda (R_m - reference range), where
    R_m is its range to channel m of the receiver. Its range response is that of a pulse with a
    rectangular spectrum. The transmit path and other pulse shapes are left to the caller.

    A cell keeps its amplitude while it is illuminated. The amplitude falls with the closest range
    R0 as 1 / sqrt(R0), because the number of cells in the beam grows with R0. The mean power of
    every sample is therefore 10^(power_db / 10), for every gate and every size of the record. The
    principle of stationary phase is the only approximation; it blurs the edges of a `BandLimited`
    gate by Fresnel ripple. Differentiable in `sea.power_db` and, for a sea made from an image, in
    the image.

    Args:
        sea: Sea surface.
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples; None for azimuth data at the reference range only.
        gate: Illumination. `BandLimited` of duration T illuminates the Doppler band |f| < V^2 T /
            (2 lambda R0) at every range, as a beam of fixed width does. Here V is the speed of the
            receiver and R0 the reference range. `Pattern` weights with sinc(element_m sin(look) /
            lambda) up to null number `sea.lobes` on either side, with the look angle from
            broadside. duration_s or element_m must be one number for all trials.
        draws: Random draws.
        dtype: Complex dtype of the result.
        device: Device of the result.

    Returns:
        Echo on radar.axes(n_pulse, n_range), shape (..., channel, pulse, range), or (..., channel,
        pulse) without n_range.

    Raises:
        TypeError: If the gate is neither `BandLimited` nor `Pattern`, or the dtype is not complex.
        ValueError: If the first range sample does not lie at a positive range, the gate reaches a
            look angle above 53 degrees or differs between trials, or `sea.power_db` has another
            length than the number of trials.
    """
    real_dtype(dtype)
    refuse_other_trials(sea, draws)
    light = _Light.of(gate, radar, sea.lobes)
    lines = _Lines.of(radar, n_range, light.last_sin)
    bins = _Bins.of(sea, radar, n_pulse, light, lines)
    cells = sea.reflectivity(bins.azimuth_m(device), lines.offset_m(device), draws, dtype)
    spectrum = fft_lines(cells).contiguous()
    spectra, power = [], torch.zeros((), dtype=torch.float64, device=device)
    for rows in bins.blocks(lines, device):
        cell = _Transfer.of(bins.doppler_hz(rows)[:, None], *lines.band(device), radar, light)
        power = power + lines.sample_power(cell, bins.times(rows))
        response = unit_phasor(lines.centre_turns(cell, radar), dtype) * cell.gain.to(real_dtype(dtype))
        pair = spectrum.index_select(-2, torch.cat([rows, -rows % bins.n])).unflatten(-2, (2, -1))
        spectra.append(_sum_over_range(pair, -cell.wavenumber * lines.step_m, dtype) * response)
    scale = torch.sqrt(10 ** (per_trial(sea.power_db, 0, cells) / 10) / (power * bins.n))
    data = _to_time(_fold(bins.in_order(torch.cat(spectra, -2)), bins, radar), n_pulse, lines) * bins.pulses
    data = data * scale.to(data.real.dtype)[..., None, None, None]
    return data[..., 0] if n_range is None else data


@dataclass(frozen=True)
class _Light:
    """Gain of a gate as a function of the sine of the look angle, its edge (half power) and its
    end.
    """

    weight: Callable[[Tensor], Tensor]
    edge_sin: float  # end of a band-limited gate, or half power of a pattern
    last_sin: float  # nothing is illuminated beyond this sine

    @staticmethod
    def of(gate: BandLimited | Pattern, radar: BistaticRadar, lobes: int) -> _Light:
        """Describe the gain of a gate. Raises TypeError or ValueError for an unsuitable gate."""
        if isinstance(gate, BandLimited):
            duration_s = _of_all_trials(gate.duration_s, "duration_s")
            edge = radar.speed_m_s * duration_s / (2 * radar.reference_range_m)
            if edge > _STEEPEST:
                raise ValueError(
                    f"duration_s of the gate of a sea must keep the sine of the look angle at or below {_STEEPEST}, "
                    f"got {duration_s:g} s, which reaches a sine of {edge:.3g} at the reference range of "
                    f"{radar.reference_range_m:g} m; shorten it, or use Pattern()"
                )
            return _Light(torch.ones_like, edge, edge)
        if isinstance(gate, Pattern):
            element = radar.element_m if gate.element_m is None else _of_all_trials(gate.element_m, "element_m")
            null = radar.wavelength_m / element
            # in units of the first null, half power is at 0.443: sinc^2(0.443) = 1/2
            edge, last = (min(share * null, _STEEPEST) for share in (0.443, lobes))
            return _Light(lambda sine: torch.sinc(sine / null), edge, last)
        raise TypeError(f"gate of a sea must be BandLimited(duration_s) or Pattern(), got {gate!r}")


def _of_all_trials(value: Tensor | float, name: str) -> float:
    """Number that a gate has for all trials. Raises ValueError for a value per trial, because the
    value determines the size of the grid.
    """
    if isinstance(value, Tensor) and value.numel() != 1:
        raise ValueError(
            f"{name} of the gate of a sea must be one number, since it decides how many cells there are, "
            f"got shape {tuple(value.shape)}; simulate one value at a time"
        )
    return float(value)


@dataclass(frozen=True)
class _Lines:
    """Range cells and range frequencies of a frame. Sample numbers are relative to its middle."""

    first: int
    cells: int
    length: int
    samples: int
    step_m: float
    sampling_hz: float
    band_hz: float
    far_m: float

    @staticmethod
    def of(radar: BistaticRadar, n_range: int | None, last_sin: float) -> _Lines:
        """Choose all cells that migrate through a frame, and an FFT in which they do not wrap into
        it.
        """
        step, middle = radar.range_step_m, radar.reference_range_m
        if n_range is None:
            return _Lines(0, 1, 1, 1, step, radar.sampling_hz, radar.pulse.bandwidth_hz, middle)
        near = middle - (n_range // 2) * step
        if near <= 0:
            raise ValueError(
                f"n_range must be so small that the frame begins at a positive range, got {n_range} samples about "
                f"the reference range of {middle:g} m, which begin at {near:g} m; record at most "
                f"{2 * int(middle / step)} samples"
            )
        far, cos = near + (n_range - 1) * step, math.sqrt(1 - last_sin**2)
        before = min(math.ceil(near * (1 - cos) / step) + _SKIRT, math.ceil(near / step) - 1)
        beyond = math.ceil(far * (1 / cos - 1) / step)
        length = smooth_length(n_range + 2 * _SKIRT + max(before, beyond))
        return _Lines(
            -(n_range // 2) - before,
            before + n_range + _SKIRT,
            length,
            n_range,
            step,
            radar.sampling_hz,
            radar.pulse.bandwidth_hz,
            far,
        )

    def offset_m(self, device: torch.device | str | None) -> Tensor:
        """Closest range of the cells relative to the middle of the scene in metres, (cell,)."""
        return self.step_m * (self.first + torch.arange(self.cells, dtype=torch.float64, device=device))

    def band(self, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
        """Return the range frequencies in the band and the fraction of each bin in it."""
        f = torch.fft.fftfreq(self.length, 1 / self.sampling_hz, dtype=torch.float64, device=device)
        share = ((self.band_hz / 2 - f.abs()) * self.length / self.sampling_hz + 0.5).clamp(0, 1)
        return f[share > 0], share[share > 0]

    def centre_turns(self, cell: _Transfer, radar: BistaticRadar) -> Tensor:
        """Phase of the middle cell in cycles relative to the reference range, computed without
        differences of large numbers.
        """
        offset_m = (self.first + self.cells // 2) * self.step_m
        return -(cell.bend * radar.reference_range_m + cell.wavenumber * offset_m)

    def sample_power(self, cell: _Transfer, times: Tensor) -> Tensor:
        """Mean power of a sample due to some Doppler bins, for cells of unit power."""
        # A cell of closest range extends over 1 / cos(look) as much on the range axis, so that
        # fewer cells contribute to a sample. `times` is the number of bins of each row.
        power = times @ cell.gain.square() if self.cells == 1 else times @ (cell.gain.square() * cell.cos)
        return power.sum() / self.length


@dataclass(frozen=True)
class _Transfer:
    """Spectrum of a cell, which is equal at Doppler f and -f, (row, frequency), float64."""

    gain: Tensor
    cos: Tensor  # cosine of the look angle
    wavenumber: Tensor  # cycles per metre of closest range
    bend: Tensor  # difference `wavenumber` - F / c

    @staticmethod
    def of(doppler_hz: Tensor, frequency_hz: Tensor, share: Tensor, radar: BistaticRadar, light: _Light) -> _Transfer:
        """Compute the spectrum of a cell by stationary phase, without the factor of its range."""
        # A cell is illuminated for lambda R0 / (V^2 cos^3(look)) per Doppler interval. The root of
        # it is the amplitude by stationary phase.
        f = radar.carrier_hz + frequency_hz
        sine = -radar.wave_speed_m_s * doppler_hz / (f * radar.speed_m_s)
        lit = sine.abs() <= light.last_sin * (1 + 1e-12)
        sine = sine.clamp(-light.last_sin, light.last_sin)
        cos = torch.sqrt(1 - sine.square())
        per_metre = f / radar.wave_speed_m_s
        gain = light.weight(sine) * share * torch.sqrt(radar.carrier_hz / (f * cos**3))
        return _Transfer(torch.where(lit, gain, 0), cos, per_metre * cos, -per_metre * sine.square() / (1 + cos))


@dataclass(frozen=True)
class _Bins:
    """Doppler bins that cover `bands` pulse rates, with `pulses` bins in each."""

    bands: int
    pulses: int
    prf_hz: float
    speed_m_s: float

    @staticmethod
    def of(sea: Sea, radar: BistaticRadar, n_pulse: int, light: _Light, lines: _Lines) -> _Bins:
        """Choose the Doppler bins of a record with its margins."""
        tangent = light.edge_sin / math.sqrt(1 - light.edge_sin**2)
        margin_s = lines.far_m * tangent / radar.speed_m_s if sea.margin_s is None else sea.margin_s
        highest_hz = (
            (radar.carrier_hz + radar.pulse.bandwidth_hz / 2) * light.last_sin * radar.speed_m_s / radar.wave_speed_m_s
        )
        pulses = smooth_length(n_pulse + math.ceil(2 * margin_s * radar.prf_hz)) if margin_s else n_pulse
        return _Bins(max(1, math.ceil(2 * highest_hz / radar.prf_hz)), pulses, radar.prf_hz, radar.speed_m_s)

    @property
    def n(self) -> int:
        """Number of bins."""
        return self.bands * self.pulses

    def azimuth_m(self, device: torch.device | str | None) -> Tensor:
        """Along-track positions of the cells in FFT order in metres, (n,)."""
        return torch.fft.fftfreq(self.n, 1 / self.n, dtype=torch.float64, device=device) * (
            self.speed_m_s / (self.prf_hz * self.bands)
        )

    def doppler_hz(self, row: Tensor) -> Tensor:
        """Doppler frequency of rows, which are numbered from zero Doppler in either direction."""
        return row.to(torch.float64) * (self.prf_hz / self.pulses)

    def times(self, row: Tensor) -> Tensor:
        """Number of bins of a row: 2 for rows that exist at Doppler f and -f, otherwise 1."""
        return 2.0 - ((row == 0) | (2 * row == self.n)).to(torch.float64)

    def in_order(self, pairs: Tensor) -> Tensor:
        """Arrange bins in FFT order (..., n, frequency), from rows at f and -f, (..., 2, row,
        frequency).
        """
        return torch.cat([pairs[..., 0, : (self.n + 1) // 2, :], pairs[..., 1, 1 : self.n // 2 + 1, :].flip(-2)], -2)

    def blocks(self, lines: _Lines, device: torch.device | str | None) -> Iterator[Tensor]:
        """Blocks of rows. Their size does not depend on the number of trials, so that sums are
        rounded alike.
        """
        # phasors of a block take 16 MB in complex128
        size = 2 * lines.length * (1 + math.isqrt(lines.cells))
        yield from torch.arange(self.n // 2 + 1, device=device).split(max(1, (1 << 20) // size))


def _sum_over_range(cells: Tensor, turns: Tensor, dtype: torch.dtype) -> Tensor:
    """Sums over range sum_j cells_j exp(2j pi turns (j - n // 2)), (..., 2, row, frequency), of
    cells (..., 2, row, n).

    Trials are processed one after the other, so that sums are rounded alike in batches of any size.
    """
    n = cells.shape[-1]
    coarse, fine = line_tables(turns, n, -(n // 2), dtype)
    count, m = coarse.shape[-1], fine.shape[-1]
    sums = []
    for pair in pad(cells, (0, m * count - n)).reshape(-1, *cells.shape[-3:-1], count, m):
        inner = (fine @ pair.permute(1, 3, 0, 2).flatten(-2)).unflatten(-1, (-1, count))
        sums.append(torch.einsum("fktc,fkc->tfk", inner, coarse))
    return torch.stack(sums).reshape(*cells.shape[:-1], turns.shape[-1])


def _fold(spectra: Tensor, bins: _Bins, radar: BistaticRadar) -> Tensor:
    """Spectra of the channels, folded to the pulse rate, (..., channel, pulse, frequency)."""
    order = torch.fft.fftfreq(bins.n, 1 / bins.n, dtype=torch.float64, device=spectra.device)
    delay_s = radar.channels_at(spectra.device) / radar.speed_m_s
    steering = unit_phasor(-bins.doppler_hz(order) * delay_s[:, None], spectra.dtype)[..., None]
    return torch.stack([(phasor * spectra).unflatten(-2, (bins.bands, bins.pulses)).sum(-3) for phasor in steering], -3)


def _to_time(spectrum: Tensor, n_pulse: int, lines: _Lines) -> Tensor:
    """Samples of a frame around slow time zero and the reference range, from spectra within the
    band.
    """
    positive = (spectrum.shape[-1] + 1) // 2
    gap = spectrum.new_zeros((*spectrum.shape[:-1], lines.length - spectrum.shape[-1]))
    data = torch.fft.ifft(torch.cat([spectrum[..., :positive], gap, spectrum[..., positive:]], -1))
    data = torch.roll(data, lines.samples // 2, -1)[..., : lines.samples]
    return torch.roll(fft_lines(data, inverse=True), n_pulse // 2, -2)[..., :n_pulse, :]
