"""Gain and phase imbalance of channels that record the lines in turn.

Channel c of C channels records the lines i with i mod C = c and multiplies them by g_c exp(j
phi_c). The product of a line with the conjugate of the line before, averaged over a recording, has
the phase phi_c - phi_(c-1) + rho, where rho is the phase increment from line to line that belongs
to the Doppler centroid. In the sum over all channels the phi cancel, so that the C products give
rho and every phi_c - phi_0. Gains follow from the powers of the lines.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    checked_samples,
    cis,
    real_dtype,
    refuse_non_finite_values,
    unit_level,
)


def lag_products(x: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """Compute products of successive lines and powers, averaged for each channel.

    Channel c of C channels recorded the lines i with i mod C = c. Powers are compared with those of
    channel 0 interpolated to the same lines, so that a slow change of the scene is not taken for a
    gain.

    Args:
        x: Raw lines, shape (..., pulse, range), complex.
        channels: Number of channels C.

    Returns:
        The product s[i] conj(s[i - 1]) of the samples s of successive lines, averaged over range
        and over the lines i of each channel and divided by the power of the strongest line, shape
        (..., C), complex128; and ln(power / power of channel 0), shape (..., C), float64.
    """
    lines = x.shape[-2]
    product = (x[..., 1:, :] * x[..., :-1, :].conj()).mean(-1).to(torch.complex128)
    power = x.abs().square().mean(-1).to(torch.float64)
    scale = power.amax(-1, keepdim=True).clamp_min(1e-300)
    channel = torch.arange(lines, device=x.device) % channels
    lag = torch.stack([(product[..., channel[1:] == c] / scale).mean(-1) for c in range(channels)], -1)
    return lag, _relative_log_power(power / scale, channels)


def _relative_log_power(power: Tensor, channels: int) -> Tensor:
    """Logarithm of each channel's power over that of channel 0 at the same lines, (..., C)."""
    last = (power.shape[-1] - 1) // channels
    reference, after = power[..., : last * channels : channels], power[..., channels : last * channels + 1 : channels]
    ratios = [torch.zeros_like(power[..., 0])]
    for c in range(1, channels):
        expected = (1 - c / channels) * reference + c / channels * after
        own = power[..., c : last * channels : channels]
        ratios.append(torch.log(own.sum(-1).clamp_min(1e-300) / expected.sum(-1).clamp_min(1e-300)))
    return torch.stack(ratios, -1)


def estimate_imbalance(x: Tensor, channels: int = 2, doppler_cycles: Tensor | float | None = None) -> Estimate:
    """Estimate gain and phase of every channel relative to channel 0, which records the first line.

    The C channels record the lines in turn. The products of neighbouring lines give the phase
    increment from line to line only modulo 2 pi / C, and the phases of the channels are ambiguous
    accordingly. For two channels, the phases phi and phi + pi cannot be distinguished; they
    correspond to Doppler spectra that are displaced by PRF / 2.

    Args:
        x: Raw lines, shape (..., pulse, range), complex.
        channels: Number of channels C.
        doppler_cycles: Baseband Doppler centroid over PRF, shape (...,), accurate to 1 / (2 C);
            resolves the ambiguity. If it is None, the set of phases with the smallest mean square
            is taken: for two channels, the phase within 90 degrees.

    Returns:
        Estimate with `gain` of shape (..., C), 1 for channel 0, and `phase_rad` of shape (..., C)
        in radians, 0 for channel 0, which `correct_imbalance` removes. Standard deviations assume a
        Gaussian scene and independent lines. `quality` is the coherence of neighbouring lines. `ok`
        is False where a channel has no power (gain outside 1e-3..1e3), or the coherence is below 5
        / sqrt(range samples x lines per channel) and may be due to chance; gains are then 1 and
        phases 0.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples or a sample is not finite, or if there are fewer than
            two channels or fewer than 2 C + 1 lines.
    """
    x = checked_samples(x, "estimate_imbalance", "pulse, range")
    if channels < 2 or x.shape[-2] < 2 * channels + 1:
        raise ValueError(
            "estimate_imbalance needs 2 or more channels and more than twice as many lines as channels, "
            f"got {channels} channels and {x.shape[-2]} lines"
        )
    x = unit_level(x)
    lag, log_power = lag_products(x, channels)
    angle = torch.angle(lag)
    turns = torch.arange(channels, dtype=torch.float64, device=x.device) / channels
    rho = torch.angle(torch.polar(torch.ones_like(angle), angle).prod(-1))[..., None] / channels + 2 * math.pi * turns
    increments = angle[..., None, 1:] - rho[..., None]
    phases = torch.nn.functional.pad(torch.cumsum(increments, -1), (1, 0))
    phases = torch.remainder(phases + math.pi, 2 * math.pi) - math.pi
    if doppler_cycles is None:
        cost = phases.square().sum(-1)
    else:
        expected = 2 * math.pi * torch.as_tensor(doppler_cycles, dtype=torch.float64, device=x.device)
        cost = -torch.cos(rho - expected[..., None])
    branch = cost.argmin(-1)[..., None, None].expand(*cost.shape[:-1], 1, channels)
    phase = torch.gather(phases, -2, branch)[..., 0, :]
    gain = torch.exp(log_power / 2)
    return _assess(x, lag, phase, gain)


def _assess(x: Tensor, lag: Tensor, phase: Tensor, gain: Tensor) -> Estimate:
    """Estimate with standard deviations, coherence and reliability."""
    channels, lines = gain.shape[-1], x.shape[-2]
    power = x.abs().square().mean((-2, -1)).to(torch.float64)
    mean_gain = gain.square().mean(-1)
    level = power / x.abs().square().mean(-1).amax(-1).to(torch.float64).clamp_min(1e-300)
    product = gain * torch.roll(gain, 1, -1) / mean_gain[..., None]
    coherence = (lag.abs() / (level[..., None] * product).clamp_min(1e-300)).mean(-1).clamp(0, 1)
    looks = x.shape[-1] * lines / channels
    single_std = torch.sqrt((1 - coherence.square()).clamp_min(0) / (2 * looks * coherence.square().clamp_min(1e-12)))
    order = torch.arange(channels, dtype=torch.float64, device=x.device)
    phase_std = single_std[..., None] * torch.sqrt(order * (channels - order) / channels)
    gain_std = (gain * math.sqrt(0.5 / looks)) * (order > 0)
    ok = (
        torch.isfinite(gain).all(-1)
        & (power > 0)
        & (gain > 1e-3).all(-1)
        & (gain < 1e3).all(-1)
        & (coherence > 5 / math.sqrt(looks))
    )
    value = {"gain": torch.where(ok[..., None], gain, 1), "phase_rad": torch.where(ok[..., None], phase, 0)}
    return Estimate(value, torch.where(ok, coherence, 0), ok, {"gain": gain_std, "phase_rad": phase_std})


def correct_imbalance(x: Tensor, gain: Tensor, phase_rad: Tensor) -> Tensor:
    """Divide the lines of channel c by gain[c] exp(j phase[c]).

    Channel c of C channels recorded the lines i with i mod C = c. Differentiable.

    Args:
        x: Raw lines, shape (..., pulse, range), complex.
        gain: Gains, shape (..., C), float64.
        phase_rad: Phases in radians, shape (..., C), float64.

    Returns:
        Lines of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if gains and phases differ in shape.
    """
    x = checked_samples(x, "correct_imbalance", "pulse, range", finite=False)
    if gain.shape != phase_rad.shape:
        raise ValueError(
            "gain and phase_rad must have the same shape (..., channel), got the shapes "
            f"{tuple(gain.shape)} and {tuple(phase_rad.shape)}"
        )
    refuse_non_finite_values("correct_imbalance", gain=gain, phase_rad=phase_rad)
    real = real_dtype(x.dtype)
    factor = cis(-phase_rad.to(real)) / gain.to(real)
    channel = torch.arange(x.shape[-2], device=x.device) % gain.shape[-1]
    return x * factor[..., channel, None]


class EstimateImbalance(Stage):
    """Estimator of the imbalance of channels that record the lines in turn.

    The lines must be on a regular grid (see `LineIntegrity`).

    Args:
        channels: Number of channels.
    """

    provides = ("gain", "phase_rad")
    neutral = {"gain": 1.0, "phase_rad": 0.0}

    def __init__(self, channels: int = 2) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None) -> Estimate:
        """Estimate gain and phase of every channel; see `estimate_imbalance`.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            doppler_hz: Baseband Doppler centroid in Hz, shape (...,); resolves the ambiguity of the
                phases.

        Returns:
            Estimate with `gain` and `phase_rad`, shape (..., channel) each.
        """
        cycles = None if doppler_hz is None else doppler_hz * signal.axis("pulse").step
        return estimate_imbalance(signal.data, self.channels, cycles)


class CorrectImbalance(Stage):
    """Correction of the imbalance of channels that record the lines in turn.

    In a chain, after a stage of the name "imbalance" that estimates gains and phases:
    `use(CorrectImbalance(), gain="imbalance", phase_rad="imbalance")`.
    """

    def forward(self, signal: Signal, gain: Tensor, phase_rad: Tensor) -> Signal:
        """Remove from each line the gain and phase of its channel; see `correct_imbalance`.

        Args:
            signal: Raw lines, shape (..., pulse, range).
            gain: Gain of each channel, shape (..., channel).
            phase_rad: Phase of each channel in radians, shape (..., channel).

        Returns:
            Signal with corrected lines.
        """
        return signal.with_data(correct_imbalance(signal.data, gain, phase_rad))
