"""Phase and time synchronisation of transmitter and receiver.

The signal of the satellite also reaches the receiver directly. Its range is known from the
ephemeris, so that the residual phase and delay after compression are the errors of the clocks.
There is one phase and one delay per pulse, common to all channels. The estimator is that of maximum
likelihood for one echo of a known band.

Without a direct path, scatterers at rest determine the phases. A channel passes nearly the places
at which another one was a pulse before. The channels therefore predict the echo of everything at
rest from pulse to pulse, whatever the scene is. The remaining phase and shift in range are the
drift of the clocks.

Reference:
    Remote Sens. 2020, 12, 1703, sections 1 and 2.1, which describe the direct-path reference
    channel, and strong islands and ships at rest as its substitute, without an estimator;
    Bellettini and Pinto 2002 (displaced phase centres, for the path of a synthetic aperture sonar).
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
    matrix_inverse,
    unit_level,
    unit_phasor,
    worst,
)
from torchsar.multichannel.balance import without_errors
from torchsar.multichannel.chip import TINY
from torchsar.multichannel.response import ChannelStage, checked_channels, refuse_other_count
from torchsar.radar import BistaticRadar


def estimate_synchronisation(direct: Tensor, radar: BistaticRadar, *, assess: bool = True) -> Estimate:
    """Estimate the clock phase and delay of each pulse from the direct path.

    The estimator is that of maximum likelihood. The direct path carries the factor exp(j phase) and
    arrives later by the delay.

    Args:
        direct: Direct path, range compressed at the sampling rate of the echoes, shape (..., pulse,
            sample), complex. Its spectrum is flat over the bandwidth of the pulse. Its peak lies at
            sample n // 2 of n when the clocks agree.
        radar: Radar parameters.
        assess: Whether quality and outcome are assessed.

    Returns:
        `phase_rad` in -pi..pi and `delay_s` in seconds, shape (..., pulse) each, with their
        standard deviations. `info` holds `snr_db` (..., pulse), the SNR of the compressed peak
        within the band. Where it is below 10 dB, phase and delay of the pulse are zero. Outcomes:
        `NOISE` where this is so in all pulses of a trial, `INEXACT` where it is so in some.

    Raises:
        ValueError: If the direct path is not complex, or has fewer than 8 samples.
    """
    if not direct.is_complex() or direct.ndim < 2 or direct.shape[-1] < 8:
        raise ValueError(
            "estimate_synchronisation works on a complex direct path (..., pulse, sample) of 8 "
            f"samples or more, got {direct.dtype} of shape {tuple(direct.shape)}"
        )
    spectrum = torch.fft.fft(torch.fft.ifftshift(direct.to(torch.complex128), dim=-1))
    frequency = radar.range_frequency_hz(direct.shape[-1], direct.device)
    inside = frequency.abs() <= radar.pulse.bandwidth_hz / 2
    band, frequency = spectrum[..., inside], frequency[inside]
    delay = _refined_delay(band, frequency, _coarse_delay(direct, radar))
    peak = (band * unit_phasor(delay[..., None] * frequency, band.dtype)).sum(-1)
    # ratio of the energy of the fitted echo to the noise of one frequency
    fitted = peak.abs().square() / len(frequency)
    noise = (band.abs().square().sum(-1) - fitted) / max(len(frequency) - 2, 1)
    snr = fitted / torch.maximum(noise, 1e-14 * fitted).clamp_min(torch.finfo(torch.float64).tiny)
    detected = snr >= 10.0  # below 10 dB, the strongest sample is often one of noise
    phase_std = (2 * snr).clamp_min(0.05).rsqrt()
    std = {"phase_rad": phase_std, "delay_s": phase_std / (2 * math.pi * frequency.square().mean().sqrt())}
    value = {"phase_rad": torch.where(detected, torch.angle(peak), 0.0), "delay_s": torch.where(detected, delay, 0.0)}
    info = {"snr_db": 10 * torch.log10(snr.clamp_min(1e-6))}
    if not assess:
        return Estimate(value, std, outcome=Outcome.NOT_ASSESSED.like(snr[..., 0]), info=info)
    quality = (1 - phase_std.square().mean(-1).sqrt()).clamp(0, 1)
    outcome = worst((Outcome.INEXACT, ~detected.all(-1)), (Outcome.NOISE, ~detected.any(-1)))
    return Estimate(value, std, quality, outcome, info)


def _coarse_delay(direct: Tensor, radar: BistaticRadar, finer: int = 4) -> Tensor:
    """Return the delay in seconds of the strongest interpolated sample, (..., pulse).

    The maximum of samples interpolated four times lies within an eighth of a sample of the peak.
    """
    n = direct.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft(direct), dim=-1)
    fine = torch.fft.ifft(torch.nn.functional.pad(spectrum, (0, (finer - 1) * n))).abs()
    return (fine.argmax(-1).to(torch.float64) / finer - n // 2) / radar.sampling_hz


def _refined_delay(band: Tensor, frequency: Tensor, start: Tensor, steps: int = 4) -> Tensor:
    """Maximise |sum_f X(f) exp(j 2 pi f delay)|^2 by Newton steps near the coarse delay.

    After four steps the error is 1e-5 of a sample at 12 dB, and less at a higher SNR.
    """
    rate, reach, delay = 2j * math.pi * frequency, 0.5 / (frequency.max() - frequency.min()), start
    for _ in range(steps):
        turned = band * unit_phasor(delay[..., None] * frequency, band.dtype)
        p, slope, bend = turned.sum(-1), (turned * rate).sum(-1), (turned * rate.square()).sum(-1)
        first, second = (p.conj() * slope).real, (p.conj() * bend).real + slope.abs().square()
        step = torch.where(second < 0, -first / torch.where(second < 0, second, -1.0), 0.0)
        delay = start + (delay + step - start).clamp(-reach, reach)
    return delay


@differentiable("no")
def clutter_synchronisation(
    data: Tensor,
    radar: BistaticRadar,
    band_hz: float,
    block_s: float = 0.25,
    snr_db: float = 30.0,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the clock phase and delay of each pulse from the echo of scatterers at rest.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(None, scene.BandLimited(1.0), scene.KSea(), snr_db=40.0)
    >>> drift = {"clock": echo.SynchronisationError(phase_rad=[0.0, 0.0, 20.0])}
    >>> sea, truth = echo.simulate_bistatic(receiver, world, 90, 64, Draws(1), impairments=drift)
    >>> found = multichannel.ClutterSynchronisation(receiver, 90.0)(sea.signal)["phase_rad"]
    >>> true = truth.values["clock.phase_rad"]
    >>> bool((found - true).std() < 0.1 * true.std())
    True

    Every range cell is weighted, in blocks of slow time, by how well each pulse predicts the next
    one. Bright places at rest, such as islands and ships at anchor, have the most weight, but a sea
    far above the noise contributes as well. Cells in which something moves are badly predicted and
    have hardly any weight. A constant phase cannot be determined, and a phase that grows linearly
    with time displaces the whole scene along track: both are left out, and so is a constant delay.
    Not differentiable. The stage follows the balance of the channels, and the stage that uses it is
    connected as `use(RemoveSynchronisation(radar), phase_rad="clock", delay_s="clock")`.

    Args:
        data: Range-compressed, balanced channels with the transmit range removed from the phase,
            shape (..., channel, pulse, range), complex.
        radar: Radar parameters.
        band_hz: Doppler bandwidth in Hz of what is at rest, about zero.
        block_s: Length in seconds of the blocks.
        snr_db: Power of what is at rest over the noise in dB, for the prediction.
        assess: Whether quality and outcome are assessed.

    Returns:
        `phase_rad` (..., pulse), whose line of least squares is zero, and `delay_s` (..., pulse),
        whose mean is zero; each with one standard deviation for all pulses, by what changes without
        each of four parts of the range cells. The delays from pulse to pulse are added up, so that
        their errors grow with the length of the record. Outcomes: `INEXACT` where the deviation of
        the phase exceeds 0.3 rad, `NOISE` where it exceeds 1 rad.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, a sample is not finite, or the channels are not those
            of the radar. Also if the radar has one channel, there are fewer than 4 pulses, or
            `band_hz` or `block_s` is not positive.
    """
    data = checked_channels(data, radar, "clutter_synchronisation", "channel, pulse, range")
    pulses = data.shape[-2]
    if radar.channels < 2 or pulses < 4:
        raise ValueError(
            "clutter_synchronisation compares channels in successive pulses, and needs at least 2 channels "
            f"and 4 pulses, got {radar.channels} and {pulses}"
        )
    if not (band_hz > 0 and block_s > 0):
        raise ValueError(
            "band_hz, the Doppler bandwidth of what is at rest, and block_s must be positive, got "
            f"{band_hz:g} Hz and {block_s:g} s"
        )
    with torch.no_grad():
        later, earlier = _predicted(unit_level(data, 3), radar, band_hz, snr_db)
        block = torch.arange(pulses - 1) // max(1, round(block_s * radar.prf_hz))
        power, fit = (_block_sums(x.abs().square().sum(-3), block) for x in (later, earlier))
        product = (later * earlier.conj()).sum(-3)
        weight, turn = 1 / power.clamp_min(TINY), product[..., 0]
        # further rounds change the phases by less than a tenth of their standard deviation
        for _ in range(6):
            turn = torch.sgn((weight[..., block, :] * product).sum(-1))
            error = power + fit - 2 * _block_sums((product * turn[..., None].conj()).real, block)
            # The weight falls with the cube of the error. Otherwise cells that move by a part of a
            # wavelength in a pulse would bias the phases.
            weight = (power - error).clamp_min(0).square() / error.clamp_min(TINY) ** 3
        each = weight[..., block, :]
        moved, slope = _moved(later * turn.conj()[..., None, :, None], earlier, radar)
        along, square = each * moved, each * slope
        value = {"phase_rad": _phase_without_line(turn), "delay_s": _delay(along.sum(-1), square.sum(-1), radar)}
        if not assess:
            return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(turn[..., 0].real))
        # standard deviations by a jackknife over four parts of the range cells: the change when a
        # part is left out, so that a part that dominates counts fully
        sums = [_part_sums(x) for x in (each * product, along, square)]
        turns, moved, slope = (x.sum(-2, keepdim=True) - x for x in sums)
        left = {"phase_rad": _phase_without_line(torch.sgn(turns)), "delay_s": _delay(moved, slope, radar)}
        off = {name: left[name] - value[name][..., None, :] for name in value}
        spread = {name: (x.square().sum(-2).mean(-1) * (1 - 1 / x.shape[-2])).sqrt() for name, x in off.items()}
        blank = (sums[0] == 0).any(-1).any(-1)
        std = {name: torch.where(blank, torch.inf, x).clamp_max(1e3) for name, x in spread.items()}
    rad = std["phase_rad"]
    outcome = worst((Outcome.INEXACT, ~(rad <= 0.3)), (Outcome.NOISE, ~(rad <= 1.0)))
    every = {name: x[..., None].expand_as(value[name]) for name, x in std.items()}
    return Estimate(value, every, (1 - rad).clamp(0, 1), outcome)


def _part_sums(x: Tensor, parts: int = 4) -> Tensor:
    """Add values (..., pulse, range) over parts of the range cells, (..., part, pulse).

    Neighbouring cells, which are correlated, are in the same part.
    """
    part = torch.arange(x.shape[-1], device=x.device) // 8 % parts
    sums = torch.zeros(*x.shape[:-1], parts, dtype=x.dtype, device=x.device)
    return sums.index_add(-1, part, x).movedim(-1, -2)


def _moved(later: Tensor, earlier: Tensor, radar: BistaticRadar) -> tuple[Tensor, Tensor]:
    """Compare pulses with their predictions in range, (..., channel, pulse, range) each.

    The delay of least squares between them is minus the first result over the second one, both
    summed with weights over range cells, (..., pulse, range). It is small against a range cell. The
    second result is the power of the slope without that of the noise, which is independent in both.
    """
    hertz = radar.range_frequency_hz(later.shape[-1], later.device)
    rate = torch.where(hertz.abs() <= radar.pulse.bandwidth_hz / 2, 2j * math.pi * hertz, 0).to(later.dtype)
    late, early = (torch.fft.ifft(torch.fft.fft(x) * rate) for x in (later, earlier))
    return ((later - earlier) * (late + early).conj()).real.sum(-3) / 2, (late * early.conj()).real.sum(-3)


def _delay(moved: Tensor, slope: Tensor, radar: BistaticRadar) -> Tensor:
    """Add up the delays from pulse to pulse, each at most a range cell, and remove their mean,
    (..., pulse) in s.
    """
    step = -(moved / torch.maximum(slope, moved.abs() * radar.pulse.bandwidth_hz + TINY)).to(torch.float64)
    delay = torch.nn.functional.pad(step.cumsum(-1), (1, 0))
    return delay - delay.mean(-1, keepdim=True)


def _phase_without_line(turn: Tensor) -> Tensor:
    """Add up the steps of the phase from phasors (..., pulse - 1) to phases (..., pulse), and
    remove their line.
    """
    step = torch.angle(turn * torch.sgn(turn.sum(-1, keepdim=True)).conj())
    phase = torch.nn.functional.pad(step.to(torch.float64).cumsum(-1), (1, 0))
    time = torch.linspace(-1, 1, phase.shape[-1], dtype=torch.float64, device=turn.device)
    slope = (phase * time).sum(-1, keepdim=True) / time.square().sum()
    return phase - phase.mean(-1, keepdim=True) - slope * time


def _predicted(data: Tensor, radar: BistaticRadar, band_hz: float, snr_db: float) -> tuple[Tensor, Tensor]:
    """Return pulses and their predictions from the pulse before, whitened.

    Both have the shape (..., channel, n - 1, range). The covariance of two channels is that of a
    flat Doppler spectrum at the distance of the places at which they receive. The channel at dx
    lies dx behind, and all channels move on with the receiver from pulse to pulse.
    """
    at, per_pulse_m = radar.channels_at(data.device), radar.speed_m_s / radar.prf_hz
    apart_m = at - at[:, None]
    same, next_ = (torch.sinc(band_hz * x / radar.speed_m_s) for x in (apart_m, apart_m + per_pulse_m))
    eye = torch.eye(len(at), dtype=torch.float64, device=data.device)
    linear = next_ @ matrix_inverse(same + 10 ** (-snr_db / 10) * eye)
    left = same + 10 ** (-snr_db / 10) * eye - linear @ next_.mT
    whiten = torch.linalg.cholesky(matrix_inverse(left)).mT
    by_pulse = data.movedim(-3, -2)
    later, earlier = (
        whiten.to(data.dtype) @ by_pulse[..., 1:, :, :],
        (whiten @ linear).to(data.dtype) @ by_pulse[..., :-1, :, :],
    )
    return later.movedim(-2, -3), earlier.movedim(-2, -3)


def _block_sums(x: Tensor, block: Tensor) -> Tensor:
    """Add values (..., pulse, range) over the pulses of each block, float64 (..., block, range)."""
    sums = torch.zeros(*x.shape[:-2], int(block[-1]) + 1, x.shape[-1], dtype=torch.float64, device=x.device)
    return sums.index_add(-2, block.to(x.device), x.to(torch.float64))


def remove_synchronisation(
    data: Tensor, radar: BistaticRadar, phase_rad: Tensor, delay_s: Tensor | None = None, with_range: bool = True
) -> Tensor:
    """Remove the phase and the delay of the clocks from every pulse of all channels.

    Each pulse is multiplied by exp(-j phase), and its envelope is advanced in range time by the
    delay; the delay does not change the carrier phase. Differentiable.

    Args:
        data: Channels, shape (..., channel, pulse, range), or (..., channel, pulse) if `with_range`
            is False, complex.
        radar: Radar parameters.
        phase_rad: Phase in radians, float64 (..., pulse).
        delay_s: Delay in seconds, float64 (..., pulse), or None.
        with_range: Whether the data have a range axis.

    Returns:
        Corrected data, same shape.

    Raises:
        ValueError: If there is not one value per pulse, or data without a range axis have a delay.
    """
    pulses = data.shape[-2] if with_range else data.shape[-1]
    refuse_other_count("remove_synchronisation", pulses, "pulse", phase_rad=phase_rad, delay_s=delay_s)
    turn = unit_phasor(-phase_rad.to(torch.float64) / (2 * math.pi), data.dtype)[..., None, :]
    return without_errors(data, radar, turn, None if delay_s is None else delay_s[..., None, :], with_range)


class EstimateSynchronisation(ChannelStage):
    """Stage that estimates the clock phase and delay of each pulse from a recorded direct path.

    >>> import torch
    >>> from torchsar import Signal, multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> direct = 1j * torch.sinc((torch.arange(64) - 32) / 1.2).expand(2, 64)  # at 90 degrees
    >>> channels = Signal(torch.ones(3, 2, dtype=torch.complex64), receiver.axes(2))
    >>> multichannel.EstimateSynchronisation(receiver)(channels, direct)["phase_rad"].rad2deg()
    tensor([90., 90.], dtype=torch.float64)

    See `estimate_synchronisation`. Where the direct path is side data of the recording, connect it
    as `use(EstimateSynchronisation(radar), direct_path="aux.direct_path")`. The signal is not
    changed.

    Args:
        radar: Radar parameters.
        assess: Whether quality and outcome are assessed.
    """

    provides = ("phase_rad", "delay_s")
    neutral = {"phase_rad": 0.0, "delay_s": 0.0}
    takes_empty = False
    differentiable = "no"

    def __init__(self, radar: BistaticRadar, *, assess: bool = True) -> None:
        super().__init__(radar)
        self.assess = assess

    def forward(self, signal: Signal, direct_path: Tensor) -> Estimate:
        """Estimate the clock phase and delay of each pulse from the direct path.

        Args:
            signal: Channels, whose number of pulses the direct path must have.
            direct_path: Range-compressed direct path, shape (..., pulse, sample), complex.

        Returns:
            `phase_rad` and `delay_s` of shape (..., pulse), see `estimate_synchronisation`.

        Raises:
            ValueError: If the direct path does not have one line per pulse, is not complex, or has
                fewer than 8 samples.
        """
        if direct_path.shape[-2:-1] != (signal.axis("pulse").n,):
            raise ValueError(
                f"direct_path (..., pulse, sample) needs a line for each of the {signal.axis('pulse').n} pulses, got "
                f"shape {tuple(direct_path.shape)}"
            )
        return estimate_synchronisation(direct_path, self.radar, assess=self.assess)


ClutterSynchronisation = Stage.of(
    clutter_synchronisation,
    works_on=("channel", "pulse", "range"),
    provides=("phase_rad", "delay_s"),
    neutral={"phase_rad": 0.0, "delay_s": 0.0},
)


class RemoveSynchronisation(ChannelStage):
    """Stage that removes estimated or known clock phases and delays from every pulse.

    >>> import torch
    >>> from torchsar import Signal, multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> phase_rad = torch.tensor([0.0, 1.0, 3.0, 2.0])  # of each pulse
    >>> channels = Signal(torch.polar(torch.ones(3, 4), phase_rad.expand(3, 4)), receiver.axes(4))
    >>> multichannel.RemoveSynchronisation(receiver)(channels, phase_rad).data[0].real.round()
    tensor([1., 1., 1., 1.])

    See `remove_synchronisation`.

    Args:
        radar: Radar parameters.
    """

    def forward(self, signal: Signal, phase_rad: Tensor, delay_s: Tensor | None = None) -> Signal:
        """Remove clock phases and delays (..., pulse) from channels (channel, pulse[, range])."""
        return signal.with_data(
            remove_synchronisation(signal.data, self.radar, phase_rad, delay_s, "range" in signal.names)
        )
