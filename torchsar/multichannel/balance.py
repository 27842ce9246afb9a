"""Estimation and correction of phase, gain and delay differences between channels.

Stationary clutter is modelled as a Gaussian process. Its covariance over channels without
differences is known at every Doppler frequency. Each Doppler band contributes the response of the
array to this band, with the power that the antenna pattern gives the band. The differences are
fitted to the data with this model by maximum likelihood. If the clutter fills fewer bands than
there are channels, the power over Doppler is taken from the data. The balanced data are then fitted
into the subspace of the responses to these bands (a noise-subspace method). Otherwise the estimate
relies on the expected power over Doppler.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.3, which requires the correction without a method; Weiss
    and Friedlander 1990 (self-calibration in subspace form).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Outcome,
    Signal,
    Stage,
    differentiable,
    fft_lines,
    refuse_non_finite_values,
    unit_level,
    unit_phasor,
)
from torchsar.multichannel.balance_assess import assessed_balance
from torchsar.multichannel.clutter_fit import ClutterModel, hann
from torchsar.multichannel.migration import envelope_phasor
from torchsar.multichannel.response import ChannelStage, ElementPattern, Prior, checked_channels, refuse_other_count
from torchsar.radar import BistaticRadar


def correct_balance(
    data: Tensor,
    radar: BistaticRadar,
    phase_rad: Tensor,
    gain_db: Tensor,
    delay_s: Tensor | None = None,
    with_range: bool = True,
) -> Tensor:
    """Remove phase, gain and delay differences between the channels.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> phase_rad, gain_db = torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3)
    >>> channels = torch.exp(1j * phase_rad)[:, None, None].expand(3, 4, 8)
    >>> multichannel.correct_balance(channels, receiver, phase_rad, gain_db)[:, 0, 0].real.round()
    tensor([1., 1., 1.], dtype=torch.float64)

    Each channel is divided by 10^(gain_db / 20) exp(j phase), and its envelope is advanced in range
    time by its delay; the delay does not change the carrier phase. Differentiable.

    Args:
        data: Channels, shape (..., channel, pulse, range), or (..., channel, pulse) if `with_range`
            is False, complex.
        radar: Radar parameters.
        phase_rad: Phases in radians, float64 (..., channel).
        gain_db: Gains in dB, float64 (..., channel).
        delay_s: Delays in seconds, float64 (..., channel), or None.
        with_range: Whether the data have a range axis.

    Returns:
        Balanced data, same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or if there is
            not one value per channel, or data without a range axis have a delay.
    """
    dims = "channel, pulse, range" if with_range else "channel, pulse"
    data = checked_channels(data, radar, "correct_balance", dims, finite=False)
    refuse_non_finite_values("correct_balance", phase_rad=phase_rad, gain_db=gain_db, delay_s=delay_s)
    refuse_other_count(
        "correct_balance", radar.channels, "channel", phase_rad=phase_rad, gain_db=gain_db, delay_s=delay_s
    )
    turn = unit_phasor(-phase_rad.to(torch.float64) / (2 * math.pi), torch.complex128)
    factor = (turn * 10 ** (-gain_db / 20)).to(data.dtype)
    delay_s = None if delay_s is None else delay_s[..., None]
    return without_errors(data, radar, factor[..., None], delay_s, with_range)


def without_errors(
    data: Tensor, radar: BistaticRadar, factor: Tensor, delay_s: Tensor | None, with_range: bool
) -> Tensor:
    """Multiply channels by a factor and advance their envelopes in range time.

    Args:
        data: Channels, shape (..., channel, pulse, range), or (..., channel, pulse), complex.
        radar: Radar parameters.
        factor: Factor, which broadcasts to (..., channel, pulse), complex.
        delay_s: Delay in seconds, as `factor`, or None.
        with_range: Whether the data have a range axis.

    Returns:
        Data of the same shape.

    Raises:
        ValueError: If data without a range axis have a delay.
    """
    if with_range:
        data = data * factor[..., None]
        phasor = None if delay_s is None else envelope_phasor(delay_s * radar.wave_speed_m_s, radar, data)
        return data if phasor is None else torch.fft.ifft(torch.fft.fft(data) * phasor)
    if delay_s is not None and bool(delay_s.any()):
        raise ValueError(
            "delay_s must be None or zero for data without a range axis, along which delays act; leave delay_s out"
        )
    return data * factor


@differentiable("no")
def estimate_balance(
    data: Tensor,
    radar: BistaticRadar,
    prior: Prior | None = None,
    bands: int | None = None,
    delays: bool = True,
    blocks: int = 16,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate phase, gain and delay of each channel from stationary clutter.

    >>> import torch
    >>> from torchsar.multichannel import estimate_balance
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> estimate_balance(torch.zeros(3, 32, 64, dtype=torch.complex64), radar).failed
    tensor(True)

    The noise level is estimated as well. Not differentiable. Where the clutter fills fewer bands
    than there are channels, prefer the prior `FlatBand(bands * PRF)`: it suits any scene, since it
    only assumes that the rest of the spectrum is empty, and the phases err by 0.02 degree instead
    of 0.3 degree (40 dB, 900 pulses by 256 range cells). A phase that grows linearly along the
    array shifts all clutter in Doppler; it is determined only by the edges of the band or the shape
    of the pattern. Clutter through a pattern that is not centred at zero Doppler, as of a beam off
    broadside, is taken for such a phase: the data cannot show it, and `ok` relies on the prior. A
    linear phase cannot be determined with a flat prior that fills as many bands as there are
    channels. Nor can the phases of channels as far apart as their elements are long, whose clutter
    is uncorrelated: the 3 channels of Table 1 need about 500 pulses by 200 range cells.

    Args:
        data: Range-compressed channels with the transmit range removed from the phase, shape (...,
            channel, pulse, range), complex, mostly stationary clutter. Clutter and noise are taken
            to have passed the same gain: noise that a channel adds behind it biases the gains, at
            10 dB by a tenth of their differences.
        radar: Radar parameters.
        prior: Expected power of the clutter over Doppler, `ElementPattern()` by default. With fewer
            bands than channels, only the bands that it fills count: the power within them is that
            of the data.
        bands: Number of Doppler bands that the clutter fills, each one PRF wide; None for all at
            which a stationary scene has echoes, 2 v / lambda for the speed v. Side lobes of a
            pattern beyond fewer bands bias the gains by more than the standard deviation says.
        delays: False to assume zero delays.
        blocks: Number of parts into which the range band is divided; within each part a delay is
            approximated by a constant phase. A delay of two samples changes the phase across one of
            16 blocks by a tenth of a cycle.
        assess: Whether standard deviations, quality and outcome are assessed.

    Returns:
        `phase_rad`, `gain_db` and `delay_s`, float64 (..., channel), relative to the channel whose
        along-track position is nearest to zero, and zero where a channel has no power. `info` holds
        `snr_db` (...,), the ratio of the highest power over Doppler to that of the noise. Standard
        deviations follow from the scatter of the gradient of the likelihood, see `balance_assess`.

        Outcomes: `EMPTY` where a channel has no power; `SINGULAR` where a phase is not determined;
        `NOISE` where its standard deviation exceeds 0.25 rad; `TOO_FEW` where fewer than three of
        32 parts of the swath hold the power, since one moving point could be most of it;
        `AMBIGUOUS` where the clutter could as well lie in another Doppler band; `MISFIT` where
        parts of the Doppler band contradict each other, as with a wrong prior; and `INEXACT` where
        the standard deviation of a phase exceeds 0.033 rad, that of a gain 0.29 dB, or that of a
        delay turns the phase by more than 0.1 rad rms over the range band.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if the radar has one
            channel, the shape of the data does not match it, `bands` is below 1, or `blocks` does
            not fit the range band.
    """
    data = checked_channels(data, radar, "estimate_balance", "channel, pulse, range")
    inside = int(data.shape[-1] * radar.pulse.bandwidth_hz / radar.sampling_hz)
    if radar.channels < 2:
        raise ValueError(
            "estimate_balance compares the channels of a radar with at least two positions in channel_m, got "
            f"channel_m={radar.channel_m}"
        )
    if not (bands is None or bands >= 1):
        raise ValueError(f"bands must be at least 1, the number of Doppler bands with clutter, got {bands}")
    if not 2 <= blocks <= inside:
        raise ValueError(
            f"blocks must be at least 2 and at most {inside}, the number of range frequencies of {data.shape[-1]} "
            f"range samples within the bandwidth of the pulse, got {blocks}"
        )
    with torch.no_grad():
        lines, frequency = _band_lines(unit_level(data, 3), radar, blocks)
        power = lines.abs().square().mean((-2, -1))
        own, no_power = power.mean(-1)[..., None, None, None], (power == 0).any(-1)
        lines = lines / torch.where(own > 0, own, 1.0).sqrt()
        bands = bands or math.ceil(2 * radar.speed_m_s / (radar.wavelength_m * radar.prf_hz))
        model = ClutterModel.of(radar, prior or ElementPattern(), data.shape[-2], bands, data.device)
        reference = min(range(radar.channels), key=lambda m: abs(radar.channel_m[m]))
        highest = frequency.abs().max()
        position = frequency / highest if delays else None
        middle = None if position is None else position.view(blocks, -1).mean(-1)
        turn = torch.zeros(*data.shape[:-3], radar.channels, dtype=torch.float64, device=data.device)
        if position is not None and middle is not None:
            products = _products(lines, blocks, no_power)
            coarse_db = 20.0  # found by trial; at 20 dB and more, the delays hardly depend on it
            by_block = model.weights(products.movedim(-3, 0), coarse_db)[0].movedim(0, -2)
            turn = _slope(by_block, middle, reference)
            products = _products(_turned(lines, turn, position), blocks, no_power)
            turn = turn + model.fit(products, coarse_db, middle).turn
            lines = _turned(lines, turn, position)
        cells = torch.fft.ifft(lines, norm="ortho")
        weight = model.homogeneous(cells, no_power)
        lines = torch.fft.fft(cells * weight.sqrt()[..., None, None, :], norm="ortho")
        products = _products(lines, blocks, no_power)
        mean = products.mean(-3)
        snr_db = model.snr_db(mean)
        weights = model.weights(mean, snr_db)[0]
        first = model, snr_db
        if bands < radar.channels:
            model = model.adapted(mean, weights, snr_db)
            snr_db = model.snr_db(mean)
        fit = model.fit(products, snr_db, middle)
        delay = (turn + fit.turn) / (2 * math.pi * highest)
        own = fit.weights[..., reference, None]
        value = {
            "phase_rad": torch.angle(fit.weights.conj() * own),
            "gain_db": 20 * torch.log10(own.abs() / fit.weights.abs()),
            "delay_s": delay - delay[..., reference, None],
        }
        value = {name: torch.where(no_power[..., None], 0.0, v).nan_to_num(0.0, 0.0, 0.0) for name, v in value.items()}
        if not assess:
            return Estimate(value, info={"snr_db": snr_db}, outcome=Outcome.NOT_ASSESSED.like(snr_db))
        lines = lines * fit.weights[..., None, None]
        if position is not None:
            lines = _turned(lines, fit.turn, position)
        lead = first[0].lead(mean, weights, first[1]) if 1 < bands < radar.channels else None
        (phase_std, log_std, turn_std), quality, outcome = assessed_balance(
            lines, weight, model, fit, snr_db, position, reference, no_power, lead
        )
        std = {
            "phase_rad": phase_std,
            "gain_db": log_std * (20 / math.log(10)),
            "delay_s": turn_std / (2 * math.pi * highest),
        }
        return Estimate(value, std, quality, outcome, {"snr_db": snr_db})


def _band_lines(data: Tensor, radar: BistaticRadar, blocks: int) -> tuple[Tensor, Tensor]:
    """Return spectra (..., channel, Doppler bin, range frequency) in the band, and frequencies.

    The pulses of each channel are Hann weighted, see `hann`.
    """
    n = data.shape[-1]
    width = int(n * radar.pulse.bandwidth_hz / radar.sampling_hz) // blocks * blocks
    inside = slice(n // 2 - width // 2, n // 2 - width // 2 + width)
    taper = hann(radar, data.shape[-2], data.device)[..., None]
    band = torch.fft.fftshift(torch.fft.fft(data.to(torch.complex128)), dim=-1)[..., inside]
    return fft_lines(band * taper), torch.fft.fftshift(radar.range_frequency_hz(n, data.device))[inside]


def _products(lines: Tensor, blocks: int, no_power: Tensor) -> Tensor:
    """Return channel covariances per block, complex128 (..., bin, block, channel, channel).

    Trials in which a channel has no power (...,) get the covariance of white noise.
    """
    by_bin = lines.unflatten(-1, (blocks, -1)).movedim(-4, -2)
    products = by_bin @ by_bin.mH / by_bin.shape[-1]
    noise = torch.eye(products.shape[-1], dtype=products.dtype, device=products.device)
    return torch.where(no_power[..., None, None, None, None], noise, products)


def _turned(lines: Tensor, turn: Tensor, position: Tensor) -> Tensor:
    """Turn the phases of lines (..., channel, bin, frequency) by `turn` (..., channel) at the end
    of the band.
    """
    return lines * unit_phasor(turn[..., None, None] * (position / (2 * math.pi)), lines.dtype)


def _slope(weights: Tensor, position: Tensor, reference: int) -> Tensor:
    """Return the phase slopes, (..., channel), of weights (..., block, channel) over the position.

    Blocks whose phase is far from the line have no weight.
    """
    turn = weights * weights[..., reference, None].conj()
    step = position[1] - position[0]
    coarse = torch.angle((turn[..., 1:, :] * turn[..., :-1, :].conj()).sum(-2)) / step
    turn = turn * unit_phasor(-coarse[..., None, :] * position[:, None] / (2 * math.pi), turn.dtype)
    angle = torch.angle(turn * turn.sum(-2, keepdim=True).conj())
    f, counts = position[:, None] - position.mean(), 1 + torch.cos(angle)
    return coarse + (counts * angle * f).sum(-2) / (counts * f.square()).sum(-2)


EstimateBalance = Stage.of(
    estimate_balance,
    works_on=("channel", "pulse", "range"),
    provides=("phase_rad", "gain_db", "delay_s"),
    neutral={"phase_rad": 0.0, "gain_db": 0.0, "delay_s": 0.0},
)


class CorrectBalance(ChannelStage):
    """Stage that removes estimated or measured phases, gains and delays of the channels.

    See `correct_balance`. After a stage "balance" that estimates the values, connect it as
    `use(CorrectBalance(radar), phase_rad="balance", gain_db="balance", delay_s="balance")`.

    Args:
        radar: Radar parameters.
    """

    def forward(self, signal: Signal, phase_rad: Tensor, gain_db: Tensor, delay_s: Tensor | None = None) -> Signal:
        """Remove phase, gain and delay of each channel.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            phase_rad: Phases in radians, shape (..., channel).
            gain_db: Gains in dB, shape (..., channel).
            delay_s: Delays in seconds, shape (..., channel), or None. Without a range axis they
                must be None or zero.

        Returns:
            Balanced channels on the same axes.
        """
        return signal.with_data(
            correct_balance(signal.data, self.radar, phase_rad, gain_db, delay_s, "range" in signal.names)
        )
