"""Simulation of an airborne multichannel receiver with a distant transmitter."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Truth, gathered_checks, per_trial, unit_phasor
from torchsar.core.fft import smooth_length
from torchsar.echo.recorded import Impairment, noise, recorded
from torchsar.echo.sea import sea_echo
from torchsar.echo.sums import blocks, echo_spectrum
from torchsar.radar import BistaticRadar
from torchsar.scene import BandLimited, BistaticWorld, ExactRange
from torchsar.scene.bistatic import Gate, ReceiveRange, TransmitRange
from torchsar.scene.movers import Movers
from torchsar.scene.trials import refuse_other_trials, with_dims

Kind = Literal["compressed", "full"]
_EXACT = ExactRange()


def bistatic_echo(
    movers: Movers,
    radar: BistaticRadar,
    n_pulse: int,
    n_range: int | None = None,
    *,
    gate: Gate,
    receive: ReceiveRange = _EXACT,
    transmit: TransmitRange | None = None,
    kind: Kind = "compressed",
    dtype: torch.dtype = torch.complex64,
) -> Tensor:
    """Return the echo of moving points without noise.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 1e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> movers = scene.MovingPoints([0], [0], [0], [6 * sar.range_step_m]).movers(sar, Draws(1))
    >>> lines = echo.bistatic_echo(movers, sar, 4, 32, gate=scene.BandLimited(1.0))
    >>> lines.shape, lines[1].abs().argmax(-1)  # sample 16 is the reference range
    (torch.Size([3, 4, 32]), tensor([22, 22, 22, 22]))

    R_T(t) is the range from the transmitter to the scene, and R_m(t) the range from a target to
    receive channel m, at slow time t. The phase of the echo is -2 pi / lambda (R_T(t) - R_T(0) +
    R_m(t) - radar.reference_range_m). Where a target moves towards the transmitter (`movers.bend`),
    the change of its own range to the transmitter is added to R_m. Ranges are constant during a
    pulse.

    The receive window follows the range from the transmitter that `radar.transmit_range` predicts.
    The envelope of the echo therefore lies at R_m plus the error of this prediction, the true
    R_T(t) - R_T(0) minus the predicted one. What lies outside the range axis is cut off; only range
    side lobes below -35 dB may wrap round, with the kind "compressed". Differentiable in speeds,
    positions and amplitudes.

    Args:
        movers: Targets, shape (..., target).
        radar: Radar parameters.
        n_pulse: Number of pulses.
        n_range: Number of range samples; None for one sample per pulse, in which every target
            contributes the peak of its range response.
        gate: Receive gain.
        receive: Model of the range to the receiver.
        transmit: True range to the transmitter, None for that of radar.transmit_range.
        kind: "compressed" for the range response of a rectangular band as wide as that of the
            pulse, with the peak 1 for a target of amplitude 1. "full" for the sampled pulse itself,
            whose leading edge lies at R_m; `focus.RangeCompress` compresses it.
        dtype: Complex dtype of the result.

    Returns:
        Echo, shape (..., channel, pulse, range), or (..., channel, pulse) without n_range.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (1), (4), (15).
    """
    time_s = radar.pulse_axis(n_pulse).values(movers.u_r_m_s.device)
    if n_range is None:
        parts = [
            _Lines.of(movers, radar, time_s[pulses], gate, receive, transmit).peaks(dtype)
            for pulses in blocks(n_pulse, 16 * radar.channels * movers.amplitude.numel())
        ]
        return torch.cat(parts, -1)
    grid = _Grid.of(radar, n_range, kind)
    spectrum = torch.fft.fftshift(grid.spectrum(radar, time_s.device)).to(dtype)
    parts = []
    for pulses in blocks(n_pulse, 16 * radar.channels * max(grid.n_fft, movers.amplitude.shape[-1])):
        block = _Lines.of(movers, radar, time_s[pulses], gate, receive, transmit).spectrum(grid, radar, dtype)
        parts.append(torch.fft.ifft(torch.fft.ifftshift(block * spectrum, dim=-1))[..., :n_range])
    return torch.cat(parts, -2)


@dataclass(frozen=True)
class _Lines:
    """Envelope range, carrier cycles and weight of targets, (..., channel, pulse, target)."""

    envelope_m: Tensor
    turns: Tensor
    weight: Tensor

    @staticmethod
    def of(
        movers: Movers,
        radar: BistaticRadar,
        time_s: Tensor,
        gate: Gate,
        receive: ReceiveRange,
        transmit: TransmitRange | None,
    ) -> _Lines:
        """Compute ranges and weights of targets at some pulses."""
        range_m = receive.range_m(movers, time_s, radar)
        if movers.bend is not None:
            range_m = range_m + movers.bend.transmit_m(time_s)
        known = radar.transmit_range_m(time_s)
        true = known if transmit is None else transmit.range_m(time_s)
        weight = gate.weight(movers, time_s, radar) * movers.amplitude[..., None, None, :]
        late_m, true = (x[..., None, :, None] for x in (true - known, true))
        return _Lines(range_m + late_m, (range_m + true) / radar.wavelength_m, weight)

    def peaks(self, dtype: torch.dtype) -> Tensor:
        """Sum over targets as if all were in the one recorded range line, (..., channel, pulse)."""
        return (unit_phasor(-self.turns, dtype) * self.weight.to(dtype)).sum(-1)

    def spectrum(self, grid: _Grid, radar: BistaticRadar, dtype: torch.dtype) -> Tensor:
        """Sum over targets in range frequency, in rising order, (..., channel, pulse, n_fft)."""
        samples = self.envelope_m / radar.range_step_m + grid.n_range // 2
        inside = (samples > -grid.margin) & (samples < grid.n_range + grid.margin)
        weight = self.weight * inside
        return echo_spectrum(
            samples / radar.sampling_hz, self.turns, weight, grid.n_fft, radar.sampling_hz / grid.n_fft, dtype
        )


@dataclass(frozen=True)
class _Grid:
    """FFT length of recorded lines. margin: number of samples beyond a line whose echoes reach into
    the line.
    """

    n_range: int
    n_fft: int
    margin: int
    kind: Kind

    @staticmethod
    def of(radar: BistaticRadar, n_range: int, kind: Kind) -> _Grid:
        """Choose the shortest fast FFT in which echoes do not wrap."""
        margin = max(32, n_range // 8) if kind == "compressed" else radar.pulse.n_samples(radar.sampling_hz)
        return _Grid(n_range, smooth_length(n_range + 2 * margin), margin, kind)

    def spectrum(self, radar: BistaticRadar, device: torch.device) -> Tensor:
        """Spectrum of the pulse, or of its compressed response, (n_fft,) in FFT order."""
        if self.kind == "full":
            return radar.pulse.spectrum(self.n_fft, radar.sampling_hz, device)
        return radar.band_weights(self.n_fft, device).to(torch.complex128)


@gathered_checks()
def simulate_bistatic(
    radar: BistaticRadar,
    world: BistaticWorld,
    n_pulse: int,
    n_range: int | None,
    draws: Draws,
    *,
    kind: Kind = "compressed",
    impairments: Mapping[str, Impairment] | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str | None = None,
) -> tuple[Recording, Truth]:
    """Simulate a recording of moving targets and a sea, batched over the trials of the draws.

    >>> from torchsar import Draws, echo, radar, scene
    >>> sar = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 1e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> world = scene.BistaticWorld(scene.MovingPoints([5], [0], [0], [0]), scene.BandLimited(1.0))
    >>> recording, truth = echo.simulate_bistatic(sar, world, 4, 32, Draws(1))
    >>> recording.signal.data.shape, truth.values["u_r_m_s"]  # three channels
    (torch.Size([3, 4, 32]), tensor([5.], dtype=torch.float64))

    Warns of targets that the receive gain (`world.gate`) suppresses at every pulse, so that the
    recording does not contain them.

    Args:
        radar: Radar parameters.
        world: Targets, receive gain, sea, range models and noise.
        n_pulse: Number of pulses.
        n_range: Number of range samples, None for azimuth-only data, in which every target lies on
            the one recorded line.
        draws: Random draws.
        kind: "compressed" for range-compressed echoes, "full" for echoes of the uncompressed pulse.
            Azimuth-only data are always compressed.
        impairments: Impairments by name, applied in order.
        dtype: Complex dtype of the recording.
        device: Device of the recording.

    Returns:
        The recording, shape (..., channel, pulse, range) or (..., channel, pulse), and the truth.
        The truth holds, per target, shape (..., target): the closing slant-range speed `u_r_m_s`,
        the along-track speed `u_a_m_s`, the along-track position `y0_m` at slow time zero (also as
        `azimuth_m`), the closest range `range_m`, `amplitude`, and the closing speed towards the
        transmitter `u_t_m_s` where the scene gives it. It further holds `transmit_range_m`, the
        true change R_T(t) - R_T(0) of the range R_T to the transmitter, shape (..., pulse);
        `noise_std`, the standard deviation of the noise of a recorded sample, shape (...,); and the
        values of each impairment under "<impairment>.<name>". `clean` is the recording without
        noise and impairments.

    Raises:
        TypeError: If radar, world or draws has the wrong type.
        ValueError: If a target is as fast as the receiver or far outside the range axis, there are
            no pulses, range lines are shorter than the pulse, or a parameter per trial has another
            length than the trials.
    """
    _refuse_impossible(radar, world, n_pulse, n_range, kind, draws)
    movers = _movers(radar, world, n_range, draws, device)
    _warn_of_unlit(movers, radar, world.gate, n_pulse)
    axes = radar.axes(n_pulse, n_range)
    time_s = axes[1].values(device)
    transmit_m = radar.transmit_range_m(time_s) if world.transmit is None else world.transmit.range_m(time_s)
    echo = bistatic_echo(
        movers,
        radar,
        n_pulse,
        n_range,
        gate=world.gate,
        receive=world.receive,
        transmit=world.transmit,
        kind=kind,
        dtype=dtype,
    )
    if world.sea is not None:
        gate: Any = world.gate  # `sea_echo` rejects other gates
        sea = sea_echo(world.sea, radar, n_pulse, n_range, gate, draws.part("sea"), dtype, device)
        lines = _received(sea[..., None] if n_range is None else sea, transmit_m, radar, kind)
        echo = echo + (lines[..., 0] if n_range is None else lines)
    std = _noise_std(radar, world, kind, echo)
    noisy = echo
    if world.snr_db is not None:
        noisy = echo + noise(draws, "echo.bistatic.noise", [axis.n for axis in axes], std, dtype, echo.device)
    values = _truths(movers, radar, transmit_m, std)
    return recorded(noisy, echo, axes, radar, values, impairments, draws, count_lines=False)


def _movers(
    radar: BistaticRadar, world: BistaticWorld, n_range: int | None, draws: Draws, device: torch.device | str | None
) -> Movers:
    """Targets on the device, after a check against the receiver and the range axis."""
    if world.scene is None:
        none = torch.zeros(0, dtype=torch.float64, device=device)
        return Movers(none, none, none, none, none.to(torch.complex128))
    movers = world.scene.movers(radar, draws).each(lambda x: x.to(device))
    if not movers.u_r_m_s.shape[-1]:
        raise ValueError("the scene holds no target; give it at least one, or scene=None for the sea alone")
    slowest = float(radar.speed_m_s - movers.u_a_m_s.detach().max())
    nearest = float(movers.closest_m(radar).detach().min())
    if not slowest > 0:
        raise ValueError(
            f"a target moves along track at {radar.speed_m_s - slowest:g} m/s, as fast as the "
            f"receiver ({radar.speed_m_s:g} m/s) or faster; give u_a_m_s below that"
        )
    if not nearest > 0:
        raise ValueError(
            f"a target lies at a closest range of {nearest:g} m; range_m counts from the "
            f"reference range of {radar.reference_range_m:g} m and must leave a positive range"
        )
    off, width = movers.range_m.detach().abs(), (n_range or 0) * radar.range_step_m
    off = off.flatten(0, -2).amin(0) if off.ndim > 1 else off
    outside = (off > 1.5 * width).nonzero()[:, 0].tolist()
    if n_range is not None and outside:
        raise ValueError(
            f"range_m of a target, which counts from the reference range, must lie within 1.5 times the length of "
            f"the range axis of {width:g} m, got target {', '.join(map(str, outside))} (counted from 0) with "
            f"{float(off.max()):g} m; correct it, or record longer range lines (n_range)"
        )
    return movers


def _warn_of_unlit(movers: Movers, radar: BistaticRadar, gate: Gate, n_pulse: int) -> None:
    """Warn of targets that a band-limited gate does not pass at any pulse of the record."""
    if not isinstance(gate, BandLimited):
        return
    closest_s = (movers.y0_m / (radar.speed_m_s - movers.u_a_m_s)).detach().abs()
    unlit = closest_s > (n_pulse // 2) / radar.prf_hz + with_dims(gate.duration_s, 1, closest_s) / 2
    if bool(unlit.any()):
        last = float(closest_s.max())
        when = f"one is closest {last:.3g} s from the middle of a record of {n_pulse / radar.prf_hz:.3g} s"
        warnings.warn(
            f"{int(unlit.sum())} of {unlit.numel()} targets are received in no pulse: {when}; record longer, "
            "or move them",
            stacklevel=3,
        )


def _refuse_impossible(
    radar: BistaticRadar, world: BistaticWorld, n_pulse: int, n_range: int | None, kind: str, draws: Draws
) -> None:
    """Raise an error for arguments that allow no simulation."""
    if not isinstance(radar, BistaticRadar) or not isinstance(world, BistaticWorld) or not isinstance(draws, Draws):
        raise TypeError(
            "a bistatic recording is simulated from a BistaticRadar, a BistaticWorld and Draws, "
            f"got {type(radar).__name__}, {type(world).__name__} and {type(draws).__name__}"
        )
    if not (isinstance(n_pulse, int) and n_pulse >= 1) or not (
        n_range is None or (isinstance(n_range, int) and n_range >= 1)
    ):
        raise ValueError(
            "n_pulse and n_range must be whole numbers of 1 or more (n_range None for azimuth-only data), got "
            f"n_pulse={n_pulse} and n_range={n_range}"
        )
    if kind not in get_args(Kind):
        raise ValueError(f"kind must be one of {', '.join(get_args(Kind))}, got {kind!r}")
    refuse_other_trials(world, draws)
    samples = radar.pulse.n_samples(radar.sampling_hz)
    if kind == "full" and (n_range is None or n_range < samples):
        raise ValueError(
            f"n_range must be at least the {samples} samples of the pulse for kind='full', got "
            f"{n_range}; record longer lines, shorten the pulse, or take kind='compressed'"
        )


def _received(sea: Tensor, transmit_m: Tensor, radar: BistaticRadar, kind: Kind) -> Tensor:
    """Echo of the sea with the carrier phase of the range to the transmitter. Full echoes are
    spread by the pulse.
    """
    if kind == "full":
        n_range = sea.shape[-1]
        n_fft = _Grid.of(radar, n_range, kind).n_fft
        spread = (
            radar.pulse.spectrum(n_fft, radar.sampling_hz, sea.device) * radar.pulse.bandwidth_hz / radar.sampling_hz
        )
        sea = torch.fft.ifft(torch.fft.fft(sea, n_fft) * spread.to(sea.dtype))[..., :n_range]
    return sea * unit_phasor(-transmit_m / radar.wavelength_m, sea.dtype)[..., None, :, None]


def _noise_std(radar: BistaticRadar, world: BistaticWorld, kind: Kind, like: Tensor) -> Tensor:
    """Standard deviation of the complex noise of a sample, (...,)."""
    if world.snr_db is None:
        return torch.zeros((), dtype=torch.float64, device=like.device)
    # compression raises the signal-to-noise ratio by the number of samples of the pulse
    gain = radar.pulse.n_samples(radar.sampling_hz) if kind == "full" else 1
    return torch.sqrt(gain * 10 ** (-per_trial(world.snr_db, 0, like) / 10))


def _truths(movers: Movers, radar: BistaticRadar, transmit_m: Tensor, noise_std: Tensor) -> dict[str, Tensor]:
    """True values by name."""
    values = {
        "u_r_m_s": movers.u_r_m_s,
        "u_a_m_s": movers.u_a_m_s,
        "y0_m": movers.y0_m,
        "azimuth_m": movers.y0_m,
        "range_m": movers.closest_m(radar),
        "amplitude": movers.amplitude,
        "transmit_range_m": transmit_m,
        "noise_std": noise_std,
    }
    return values if movers.bend is None else {**values, "u_t_m_s": movers.bend.transmit_m_s}
