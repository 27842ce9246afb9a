"""Echo of a stationary surface in all channels of a bistatic receiver, made from its
two-dimensional spectrum.

A scatterer at closest range R0 and along-track place y has the spectrum (stationary phase, one way;
F = carrier + f_r, f Doppler, V the receiver's speed)
    exp(-j 2 pi [ f y / V + sqrt(F^2 - (c f / V)^2) R0 / c ]),    seen under sin(look) = -c f / (F
    V):
the exponent from which omega-K focusing starts, read backwards. The channel at dx sees what the
reference saw dx / V before, exactly: exp(-j 2 pi f dx / V). So one sum over range per bin of the
full Doppler band serves every channel; only the folding to the pulse rate is a channel's own.
Source: brief 001, signal model with u_r = u_a = 0. Own code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Draws, fft_lines, linear_phasor, per_trial, real_dtype, unit_phasor
from torchsar.radar import BistaticRadar
from torchsar.scene.bistatic import BandLimited, Pattern
from torchsar.scene.sea import Sea

# sine of the look angle beyond which no surface is lit: towards 1 its range grows without bounds
_STEEPEST = 0.8
_HALF_POWER = 0.443  # of the first null, where a one-way sinc has half its power
_SKIRT = 16  # cells by which range responses reach into a frame
_BLOCK_PHASORS = 1 << 20


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
    """Range-compressed echo of a sea, (..., channel, pulse, range) on radar.axes(n_pulse, n_range);
    without n_range one line at the reference range, (..., channel, pulse).

    gate: `BandLimited(T)` lights the Doppler band |f| < V^2 T / (2 lambda R0) of the reference
    range at every range, as a beam of fixed width does; `Pattern()` weights with sinc(element
    sin(look) / lambda), up to `sea.lobes` nulls. The phase is -2 pi / lambda (R_m - reference
    range), the response in range is that of the rectangular band of the pulse: the transmit range
    and a pulse of other shape are the caller's to multiply with. A cell keeps its amplitude as long
    as it is lit; over range amplitudes fall with 1 / sqrt(R0), as the cells in the beam grow in
    number: mean power is 10^(sea.power_db / 10) in every sample, whatever the gate and the frame.
    Exact but for stationary phase, which blurs the edges of a band-limited gate by their Fresnel
    ripple. Differentiable in power_db and in images. Raises TypeError for another gate or dtype,
    ValueError for frames that begin behind the receiver and for bands wider than a look of 53
    degrees.
    """
    real_dtype(dtype)
    light = _Light.of(gate, radar, sea.lobes)
    lines = _Lines.of(radar, n_range, light.last_sin)
    bins = _Bins.of(sea, radar, n_pulse, light, lines)
    cells = sea.reflectivity(bins.azimuth_m(device), lines.offset_m(device), draws, dtype)
    spectrum = fft_lines(cells).contiguous()
    seen, power = [], torch.zeros((), dtype=torch.float64, device=device)
    for rows in bins.blocks(lines, device):
        cell = _Transfer.of(bins.doppler_hz(rows)[:, None], *lines.band(device), radar, light)
        power = power + lines.sample_power(cell, bins.times(rows))
        response = unit_phasor(lines.centre_turns(cell, radar), dtype) * cell.gain.to(real_dtype(dtype))
        pair = spectrum.index_select(-2, torch.cat([rows, -rows % bins.n])).unflatten(-2, (2, -1))
        seen.append(_sum_over_range(pair, -cell.wavenumber * lines.step_m, dtype) * response)
    scale = torch.sqrt(10 ** (per_trial(sea.power_db, 0, cells) / 10) / (power * bins.n))
    data = _to_time(_fold(bins.in_order(torch.cat(seen, -2)), bins, radar), n_pulse, lines) * bins.pulses
    data = data * scale.to(data.real.dtype)[..., None, None, None]
    return data[..., 0] if n_range is None else data


@dataclass(frozen=True)
class _Light:
    """What a gate is to a surface that stands still: an even weight over the sine of the look
    angle.

    edge_sin: of a band-limited gate, or where a pattern has half its power; last_sin: where the
    surface is cut off.
    """

    weight: Callable[[Tensor], Tensor]
    edge_sin: float
    last_sin: float

    @staticmethod
    def of(gate: BandLimited | Pattern, radar: BistaticRadar, lobes: int) -> _Light:
        """Raises TypeError for another gate, ValueError for one that no look angle has."""
        if isinstance(gate, BandLimited):
            edge = radar.speed_m_s * gate.duration_s / (2 * radar.reference_range_m)
            if edge > _STEEPEST:
                raise ValueError(
                    f"a gate of {gate.duration_s:g} s at {radar.reference_range_m:g} m ends at a look "
                    f"angle of sine {edge:.3g}, beyond {_STEEPEST}; shorten it, or use Pattern()"
                )
            return _Light(torch.ones_like, edge, edge)
        if isinstance(gate, Pattern):
            null = radar.wavelength_m / (gate.element_m or radar.element_m)
            return _Light(
                lambda sine: torch.sinc(sine / null), min(_HALF_POWER * null, _STEEPEST), min(lobes * null, _STEEPEST)
            )
        raise TypeError(f"a sea is lit by BandLimited(duration_s) or Pattern(), got {gate!r}")


@dataclass(frozen=True)
class _Lines:
    """Cells in closest range and the range frequencies they are summed at: first cell, cells, FFT
    length, samples (all relative to the middle of the frame), step (m).
    """

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
        """All cells that migrate through a frame, and an FFT in which nothing that leaves it comes
        back.
        """
        step, middle = radar.range_step_m, radar.reference_range_m
        if n_range is None:
            return _Lines(0, 1, 1, 1, step, radar.sampling_hz, radar.pulse.bandwidth_hz, middle)
        near = middle - (n_range // 2) * step
        if near <= 0:
            raise ValueError(
                f"a frame of {n_range} samples about {middle:g} m begins at a range of {near:g} m; "
                f"record at most {2 * int(middle / step)} samples"
            )
        far, cos = near + (n_range - 1) * step, math.sqrt(1 - last_sin**2)
        before = min(math.ceil(near * (1 - cos) / step) + _SKIRT, math.ceil(near / step) - 1)
        beyond = math.ceil(far * (1 / cos - 1) / step)
        length = _fast_length(n_range + 2 * _SKIRT + max(before, beyond))
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
        """Closest range of the cells less that of the middle of the scene, float64 (cell,)."""
        return self.step_m * (self.first + torch.arange(self.cells, dtype=torch.float64, device=device))

    def band(self, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
        """Range frequencies in the band of the pulse and the share of each bin that lies inside,
        float64 (frequency,), FFT order.
        """
        f = torch.fft.fftfreq(self.length, 1 / self.sampling_hz, dtype=torch.float64, device=device)
        share = ((self.band_hz / 2 - f.abs()) * self.length / self.sampling_hz + 0.5).clamp(0, 1)
        return f[share > 0], share[share > 0]

    def centre_turns(self, cell: _Transfer, radar: BistaticRadar) -> Tensor:
        """Turns of the middle cell less those of range at the reference range, formed without the
        large difference.
        """
        offset_m = (self.first + self.cells // 2) * self.step_m
        return -(cell.bend * radar.reference_range_m + cell.wavenumber * offset_m)

    def sample_power(self, cell: _Transfer, times: Tensor) -> Tensor:
        """Share of some bins in the mean power of a sample, for cells of unit power.

        times: how often each row counts.

        At a look angle, a cell of closest range is 1 / cos(look) as long on the range axis: fewer
        of them share a sample.
        """
        power = times @ cell.gain.square() if self.cells == 1 else times @ (cell.gain.square() * cell.cos)
        return power.sum() / self.length


@dataclass(frozen=True)
class _Transfer:
    """A cell in the spectrum, float64 (row, frequency), alike at Doppler f and -f: gain, cosine of
    the look angle, turns per metre of closest range, and that less F / c (`bend`).
    """

    gain: Tensor
    cos: Tensor
    wavenumber: Tensor
    bend: Tensor

    @staticmethod
    def of(doppler_hz: Tensor, frequency_hz: Tensor, share: Tensor, radar: BistaticRadar, light: _Light) -> _Transfer:
        """A cell is lit for a time per Doppler of lambda R0 / (V^2 cos^3(look)): stationary phase
        gives the square root of it as amplitude (without R0).
        """
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
    """Doppler bins of the full band: `bands` times the pulse rate wide, `pulses` bins in each, all
    of a period that holds the record.
    """

    bands: int
    pulses: int
    prf_hz: float
    speed_m_s: float

    @staticmethod
    def of(sea: Sea, radar: BistaticRadar, n_pulse: int, light: _Light, lines: _Lines) -> _Bins:
        tangent = light.edge_sin / math.sqrt(1 - light.edge_sin**2)
        margin_s = lines.far_m * tangent / radar.speed_m_s if sea.margin_s is None else sea.margin_s
        highest_hz = (
            (radar.carrier_hz + radar.pulse.bandwidth_hz / 2) * light.last_sin * radar.speed_m_s / radar.wave_speed_m_s
        )
        pulses = _fast_length(n_pulse + math.ceil(2 * margin_s * radar.prf_hz)) if margin_s else n_pulse
        return _Bins(max(1, math.ceil(2 * highest_hz / radar.prf_hz)), pulses, radar.prf_hz, radar.speed_m_s)

    @property
    def n(self) -> int:
        return self.bands * self.pulses

    def azimuth_m(self, device: torch.device | str | None) -> Tensor:
        """Along-track places of the cells in FFT order, float64 (n,)."""
        return torch.fft.fftfreq(self.n, 1 / self.n, dtype=torch.float64, device=device) * (
            self.speed_m_s / (self.prf_hz * self.bands)
        )

    def doppler_hz(self, row: Tensor) -> Tensor:
        """Doppler of rows counted from zero in either direction, float64."""
        return row.to(torch.float64) * (self.prf_hz / self.pulses)

    def times(self, row: Tensor) -> Tensor:
        """2 for rows that exist at Doppler f and at -f, else 1, float64."""
        return 2.0 - ((row == 0) | (2 * row == self.n)).to(torch.float64)

    def in_order(self, pairs: Tensor) -> Tensor:
        """All bins in FFT order (..., n, frequency) from rows 0..n // 2 at f and at -f, (..., 2,
        row, frequency).
        """
        return torch.cat([pairs[..., 0, : (self.n + 1) // 2, :], pairs[..., 1, 1 : self.n // 2 + 1, :].flip(-2)], -2)

    def blocks(self, lines: _Lines, device: torch.device | str | None) -> Iterator[Tensor]:
        """Rows 0..n // 2 worked on at once, whatever the number of trials: sums then round alike in
        batches of any size.
        """
        height = max(1, _BLOCK_PHASORS // (2 * lines.length * (1 + math.isqrt(lines.cells))))
        yield from torch.arange(self.n // 2 + 1, device=device).split(height)


def _fast_length(n: int) -> int:
    """The least FFT length >= n with no prime factor above 5."""

    def rest(k: int) -> int:
        for p in (2, 3, 5):
            while k % p == 0:
                k //= p
        return k

    return next(k for k in range(n, 2 * n + 1) if rest(k) == 1)


def _sum_over_range(cells: Tensor, turns: Tensor, dtype: torch.dtype) -> Tensor:
    """sum_j cells_j exp(2j pi turns (j - n // 2)).

    cells: (..., row, n); turns: float64 (row, frequency). Returns (..., row, frequency).

    Exact: the exponential separates into a coarse and a fine factor, which makes one small matrix
    product per row of the sum; all other dims are its columns.
    """
    n = cells.shape[-1]
    m = 2 ** round(math.log2(n) / 2)
    count = -(-n // m)
    fine, coarse = linear_phasor(turns, 0, m, dtype), linear_phasor(m * turns, -(n // 2) / m, count, dtype)
    parts = pad(cells, (0, m * count - n)).reshape(-1, cells.shape[-2], count, m)
    inner = fine @ parts.permute(1, 3, 0, 2).flatten(-2)
    return torch.einsum("fktc,fkc->tfk", inner.unflatten(-1, (-1, count)), coarse).reshape(
        *cells.shape[:-1], turns.shape[-1]
    )


def _fold(seen: Tensor, bins: _Bins, radar: BistaticRadar) -> Tensor:
    """Spectra of the channels at the pulse rate, (..., channel, pulse, frequency), from the full
    band in FFT order (..., n, frequency).
    """
    order = torch.fft.fftfreq(bins.n, 1 / bins.n, dtype=torch.float64, device=seen.device)
    delay_s = radar.channels_at(seen.device) / radar.speed_m_s
    steering = unit_phasor(-bins.doppler_hz(order) * delay_s[:, None], seen.dtype)[..., None]
    return torch.stack([(phasor * seen).unflatten(-2, (bins.bands, bins.pulses)).sum(-3) for phasor in steering], -3)


def _to_time(spectrum: Tensor, n_pulse: int, lines: _Lines) -> Tensor:
    """Samples (..., channel, pulse, range) of a frame about slow time zero and the reference range,
    from in-band spectra in FFT order.
    """
    positive = (spectrum.shape[-1] + 1) // 2
    gap = spectrum.new_zeros((*spectrum.shape[:-1], lines.length - spectrum.shape[-1]))
    data = torch.fft.ifft(torch.cat([spectrum[..., :positive], gap, spectrum[..., positive:]], -1))
    data = torch.roll(data, lines.samples // 2, -1)[..., : lines.samples]
    return torch.roll(fft_lines(data, inverse=True), n_pulse // 2, -2)[..., :n_pulse, :]
